"""``acquire replay``: recorded lines through devices, rings and disk again, and every array is the same."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from live_daemon import Daemon, acquire
from s3_server import S3Server

from acquire.cli import replay
from acquire.clock import ClockFit
from acquire.codes import PrbsCode
from acquire.errors import DataError
from acquire.lines import ARMS, LineFlag, LineTable, TaggedBlock
from acquire.store import RecordingSpec, RecordingWriter, RunCondition, open_recording, recover

M, S, FIRST, LINES, PERIOD = 8, 2, 1001, 3000, 9000
CODE = PrbsCode(23, 77)
LOST = {
    "a": [(0, 3), (700, 1), (1500, 400), (2990, 10)],
    "b": [(1600, 40), (2995, 5)],
}
"""Rows at the beginning, in between, in both arms at once, and at the end."""


def hard_recording(
    path: Path, lost: dict[str, list[tuple[int, int]]] = LOST, *, seal: bool = True, wrong: bool = False
) -> Path:
    """Lines of noise with gaps and flags of every kind, from a line number and a clock of their own on.

    ``wrong``: of arm b one line's tick and another's code are not what they must be.
    """
    camera = {"white_dn": 4095, "black_level_dn": 1.0, "responsivity_dn": 2.0}
    clock = ClockFit(90_000_000, 1_700_000_000_123_456_789, 100)
    spec = RecordingSpec(
        run_id="hard",
        stages=M,
        substeps=S,
        pixels=M,
        dtype="uint16",
        first_line=FIRST,
        clock=clock,
        code=CODE.to_attrs(),
        substep_ticks=PERIOD // S,
        trigger={"model": "test"},
        cameras=dict.fromkeys(ARMS, camera),
        config={"recorded": "by an instrument that this version does not know"},
        chunk_lines=256,
        shard_chunks=4,
    )
    line = np.arange(FIRST, FIRST + LINES, dtype=np.uint64)
    bits = CODE.bits(S * FIRST, S * LINES).reshape(LINES, S)
    tick = PERIOD * line + 5_000_000
    with RecordingWriter.create(path, spec) as writer:
        for number, arm in enumerate(ARMS):
            pixels = np.random.default_rng(number).integers(0, 4000, (LINES, M), np.uint16)
            flags = np.zeros(LINES, np.uint16)
            flags[100:110] |= np.uint16(LineFlag.INCOMPLETE)
            flags[200:900] |= np.uint16(LineFlag.CODE_UNVERIFIED)
            flags[2000:2100] |= np.uint16(LineFlag.TIME_ESTIMATED)
            flags[50] |= np.uint16(LineFlag.SATURATED)
            pixels[50, 3] = 4095
            for begin, count in lost[arm]:
                flags[begin : begin + count] = LineFlag.MISSING
                writer.add_gap(arm, FIRST + begin, count, "camera")
            code = np.packbits(bits, axis=1, bitorder="little")[:, 0]
            ticks = tick.copy()
            if wrong and arm == "b":
                code[400] ^= 1
                ticks[500] += np.uint64(1)
            writer.append(
                TaggedBlock(FIRST, pixels, flags, arm, LineTable(S * line, code, ticks, clock.time_ns(tick)))
            )
        if seal:
            writer.seal(RunCondition.INCOMPLETE, "stopped", {})
        else:
            writer.commit()
    return path


def replayed(*words: object, socket: Path | None = None) -> dict[str, object]:
    """The facts of a replay that must be identical; ``socket`` is in the environment."""
    answer = acquire("replay", *words, "--json", socket=socket)
    assert answer.code == 0, answer.err + answer.out
    assert answer.json["identical"] is True
    return dict(answer.json)


def test_a_daemons_recording_is_replayed_and_recorded_again_identically(
    tmp_path: Path,
) -> None:
    daemon = Daemon(tmp_path)
    try:
        with daemon.client() as client:
            client.arm(force=True)
            client.start(tmp_path / "first.zarr", lines=2500)
            client.wait({"idle", "armed"}, 60)
    finally:
        daemon.close()
    first = open_recording(tmp_path / "first.zarr")
    facts = replayed(tmp_path / "first.zarr", "--out", tmp_path / "again.zarr", "--speed", 10)
    assert facts["lines"] == 2500
    again = open_recording(tmp_path / "again.zarr")
    assert (again.lines, again.first_line) == (2500, 0)
    old, new = first.cut(first.first_line + 100, 300), again.cut(100, 300)
    np.testing.assert_array_equal(old.lines, new.lines)
    np.testing.assert_array_equal(old.code, new.code)
    assert again.attrs["replayed"]["run_id"] == first.attrs["run_id"]


def test_gaps_and_flags_come_back_as_they_were_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a recording whose rig this version does not know, with an environment that is in the way."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "nowhere"))
    long = tmp_path / ("long" * 30)
    long.mkdir()
    monkeypatch.setenv("TMPDIR", str(long))
    hard_recording(tmp_path / "hard.zarr")
    again_at = ("--out", tmp_path / "again.zarr", "--speed", 0.7)
    replayed(tmp_path / "hard.zarr", *again_at, socket=tmp_path / "no.sock")
    again = open_recording(tmp_path / "again.zarr")
    flags = again.camera("a").read("flags", 0, LINES)
    assert {int(flag) for flag in flags} == {0, 1, 2, 4, 8, 16}
    assert [(rows.start, len(rows)) for rows in again.lost_rows("a")] == LOST["a"]
    assert not any(long.iterdir())


def test_a_recovered_recording_is_replayed_with_its_remaining_lines(tmp_path: Path) -> None:
    path = hard_recording(tmp_path / "hard.zarr", {"a": [], "b": []}, seal=False)
    shard = path / "b" / "lines" / "c" / "1" / "0"
    data = bytearray(shard.read_bytes())
    data[4096 + 20] ^= 1
    shard.write_bytes(data)
    refused = acquire("replay", path, "--out", tmp_path / "none.zarr")
    assert (
        refused.code,
        f"try: acquire stop, if it is being written, or acquire recover {path}" in refused.err,
    ) == (
        2,
        True,
    )
    assert recover(path).damage
    replayed(path, "--out", tmp_path / "again.zarr", "--speed", 0)
    assert open_recording(tmp_path / "again.zarr").lost_rows("b") == open_recording(path).lost_rows("b") != []


def test_a_recording_without_an_arm_is_refused_at_once_and_replayed_once_it_is_recovered(
    tmp_path: Path,
) -> None:
    """It was tried at four speeds, each slower than the last, and lost lines at all of them."""
    path = hard_recording(tmp_path / "hard.zarr", {"a": [], "b": []})
    shutil.rmtree(path / "b")
    for words in (("--out", tmp_path / "none.zarr"), ()):
        refused = acquire("replay", path, *words)
        assert refused.code == 6
        assert "cannot be replayed: b/lines: lines 1001 to 2024: it is not on disk" in " ".join(
            refused.err.split()
        )
        said = " ".join(refused.err.split())
        assert (
            f"try: acquire verify {path}, which lists all damage; acquire recover {path}, which flags" in said
        )
    assert sorted(one.name for one in tmp_path.iterdir()) == ["hard.zarr"]
    assert recover(path).damage
    replayed(path, "--out", tmp_path / "again.zarr", "--speed", 0)
    assert open_recording(tmp_path / "again.zarr").lost_rows("b") == [range(LINES)]


def test_damage_that_only_reading_shows_ends_a_replay_at_the_first_speed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored, out, paces = hard_recording(tmp_path / "run.zarr"), tmp_path / "again.zarr", []
    shard = stored / "b" / "lines" / "c" / "1" / "0"
    data = bytearray(shard.read_bytes())
    data[4096 + 20] ^= 1
    shard.write_bytes(data)

    def record(_: object, path: Path, pace: float) -> str | None:
        paces.append(pace)
        hard_recording(path)
        return "grabber b: lines cannot be read"

    monkeypatch.setattr(replay, "_record", record)
    with pytest.raises(DataError, match=r"run\.zarr cannot be replayed: b/lines: lines .* checksum is wrong"):
        replay._replay_without_loss(open_recording(stored), out, 8.0)
    assert paces == [8.0]
    assert [path.name for path in tmp_path.iterdir()] == ["run.zarr"]


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[S3Server]:
    made = S3Server()
    made.start()
    try:
        for name, value in made.environment.items():
            monkeypatch.setenv(name, value)
        made.create_bucket()
        yield made
    finally:
        made.stop()


def test_a_recording_in_a_bucket_is_replayed(tmp_path: Path, server: S3Server) -> None:
    path = hard_recording(tmp_path / "hard.zarr")
    url = f"s3://recordings/{os.getpid()}-hard.zarr"
    copied = acquire("upload", path, url)
    assert copied.code == 0, copied.err
    replayed(url, "--out", tmp_path / "again.zarr", "--speed", 0)


def test_differences_of_an_inconsistent_recording_are_listed_by_array(
    tmp_path: Path,
) -> None:
    path = hard_recording(tmp_path / "wrong.zarr", wrong=True)
    answer = acquire("replay", path, "--out", tmp_path / "again.zarr", "--speed", 10, "--json")
    assert answer.code == 6, answer.err
    found = {one["array"]: (one["rows"], one["row"]) for one in answer.json["differences"]}
    assert found == {"b/code": (1, 400), "b/tick": (1, 500), "b/time": (1, 500)}
    assert "differs from" in json.loads(answer.err.splitlines()[-1])["error"]["message"]


def test_an_attempt_that_is_repeated_leaves_no_segment_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The devices are left out: a disk that is too slow in the first attempt only is none of this machine."""
    stored, out, paces = hard_recording(tmp_path / "run.zarr"), tmp_path / "again.zarr", []

    def record(_: object, path: Path, pace: float) -> str | None:
        paces.append(pace)
        hard_recording(path)
        if len(paces) > 1:
            return None
        hard_recording(path.with_name("again-2.zarr"))
        document = json.loads((path / "zarr.json").read_text())
        document["attributes"]["segments"] = ["again-2.zarr"]
        (path / "zarr.json").write_text(json.dumps(document))
        return "the rings were full"

    monkeypatch.setattr(replay, "_record", record)
    pace, _ = replay._replay_without_loss(open_recording(stored), out, 8.0)
    assert paces == [8.0, pace]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again.zarr", "run.zarr"]


def test_impossible_replays_are_refused_before_anything_is_created(tmp_path: Path) -> None:
    path = hard_recording(tmp_path / "hard.zarr")
    for words, reason in (
        (("--loop",), "never end"),
        (("--speed", "nan"), "--speed nan is out of range"),
    ):
        refused = acquire("replay", f"file://{path}", "--out", tmp_path / "none.zarr", *words)
        assert (refused.code, reason in refused.err) == (2, True), refused.err
        assert not (tmp_path / "none.zarr").exists()
