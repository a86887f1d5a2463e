"""``acquire ls | info | cut`` on recordings written by the real writer."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from small_recordings import FIRST, M, S, block, spec, write

from acquire.cli.recording_page import CELL_CHARACTERS
from acquire.lines import ARMS
from acquire.store import RecordingWriter, Retention, RunCondition, open_recording, write_video
from acquire.store.suspect import DOUBTFUL, VERIFIED

Cli = Callable[..., Any]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write(tmp_path / "one.zarr")


def test_info_says_why_lines_are_in_doubt(cli: Cli, recording: Path, tmp_path: Path) -> None:
    doubts = {"tag_mismatches": 2, "incomplete_a": 100, "unconfirmed_b": 7, "missed_trigger_b": 1}
    with RecordingWriter.create(tmp_path / "two.zarr", spec()) as writer:
        for arm in ARMS:
            writer.append(block(arm, range(0)))
        writer.seal(RunCondition.TAINTED, "stopped", {"tainted_by": doubts})
    assert (
        "tainted by tag mismatches: 2, arm a: 100 lines that arrived damaged, "
        "arm b: 7 lines that no tag of the trigger confirmed, missed trigger b: 1"
    ) in " ".join(cli("info", tmp_path / "two.zarr").out.split())
    assert "tainted by" not in cli("info", recording).out


def test_ls(cli: Cli, recording: Path) -> None:
    (recording.parent / "broken.zarr").mkdir()
    (recording.parent / "note.txt").write_text("x")
    answer = cli("ls", recording.parent)
    assert answer.code == 0
    title, broken, good = answer.out.splitlines()
    assert title.split()[:2] == ["recording", "lines"]
    assert broken.startswith("broken.zarr")
    assert "is not a recording" in broken
    assert good.split()[:2] == ["one.zarr", "64"]
    assert "GOOD" in good
    listed = cli("ls", recording.parent, "--json").json
    assert [Path(item["path"]).name for item in listed] == ["broken.zarr", "one.zarr"]
    assert "error" in listed[0]
    assert listed[1]["lines"] == 64


def test_ls_survives_recordings_that_cannot_be_described(cli: Cli, recording: Path) -> None:
    for name, before, after in (
        ("stages", f'"stages":{M}', '"stages":-1'),
        ("clock", '"clock_hz":90000000', '"clock_hz":0'),
        ("code", '"degree":15', '"grade":15'),
        ("versions", '"acquire":', '"acquired":'),
        ("text", '"run_id"', "\n" * 50 + '"run_id'),
    ):
        damaged = write(recording.parent / f"{name}.zarr") / "zarr.json"
        text = json.dumps(json.loads(damaged.read_text()), separators=(",", ":"))
        assert before in text
        damaged.write_text(text.replace(before, after))
    answer = cli("ls", recording.parent)
    assert answer.code == 0
    title, *rows = answer.out.splitlines()
    assert [row.split()[0] for row in rows] == [
        "clock.zarr", "code.zarr", "one.zarr", "stages.zarr", "text.zarr", "versions.zarr"
    ]  # fmt: skip
    assert max(map(len, (title, *rows))) < 160
    assert sum("damaged" in row for row in rows) == 5
    listed = cli("ls", recording.parent, "--json").json
    assert sum("error" in item for item in listed) == 5
    assert max(len(item.get("error", "")) for item in listed) > CELL_CHARACTERS


def test_ls_lists_a_recording_of_any_name(cli: Cli, recording: Path) -> None:
    write(recording.parent / "take 3")
    (recording.parent / "older").mkdir()
    listed = cli("ls", recording.parent, "--json").json
    assert [Path(item["path"]).name for item in listed] == ["one.zarr", "take 3"]


def test_ls_leaves_videos_out(cli: Cli, recording: Path) -> None:
    video, times = np.zeros((2, 4, 4), np.float32), np.arange(2, dtype=np.int64)
    write_video(
        recording.parent / "a-video.zarr", video, times, pixel_size=1.0, frame_interval_ns=1e4, provenance={}
    )
    assert [Path(item["path"]).name for item in cli("ls", recording.parent, "--json").json] == ["one.zarr"]


def test_ls_says_what_else_there_is_and_what_shows_it(cli: Cli, tmp_path: Path) -> None:
    """It said that there were no recordings "in" a video, and listed a calibration as a damaged recording."""
    video, times = np.zeros((2, 4, 4), np.float32), np.arange(2, dtype=np.int64)
    for name in ("one.zarr", "two.zarr"):
        write_video(tmp_path / name, video, times, pixel_size=1.0, frame_interval_ns=1e4, provenance={})
    zarr.create_group(tmp_path / "c.zarr", zarr_format=3, attributes={"format": "acquire-calibration/1"})
    listed = cli("ls", tmp_path)
    assert (listed.code, listed.out) == (
        0,
        f"there are no recordings in {tmp_path}, but 1 calibration, 2 videos\n",
    )
    assert cli("ls", tmp_path, "--json").json == []
    for name, kind, shows in (
        ("one.zarr", "video", "acquire render, which shows videos"),
        ("c.zarr", "calibration", "acquire calibrate show, which shows calibrations"),
    ):
        for command in ("ls", "info", "verify", "diagnose"):
            answer = cli(command, tmp_path / name)
            assert answer.code == 2
            assert f"{name} is a {kind}, but not a recording" in answer.err
            assert f"try: {shows}" in answer.err


def test_ls_of_a_link_to_nowhere_and_of_a_recording_itself(cli: Cli, recording: Path) -> None:
    (recording.parent / "away.zarr").symlink_to("/nowhere/away.zarr")
    away, good = cli("ls", recording.parent, "--json").json
    assert "a link to /nowhere/away.zarr, which does not exist" in away["error"]
    assert cli("ls", recording, "--json").json == [good]
    (recording / "zarr.json").write_text("{")
    (damaged,) = cli("ls", recording, "--json").json
    assert "damaged" in damaged["error"]


def test_ls_of_nothing(cli: Cli, tmp_path: Path) -> None:
    assert cli("ls", tmp_path).out == f"there are no recordings in {tmp_path}\n"
    assert cli("ls", tmp_path, "--json").json == []
    assert cli("ls", tmp_path / "absent").code == 2


def test_info(cli: Cli, tmp_path: Path) -> None:
    path = write(tmp_path / "gap.zarr", lost=range(110, 115))
    answer = cli("info", path)
    assert answer.code == 0
    assert "64 (100 to 163)" in answer.out
    assert "a 0, b 5" in answer.out
    assert answer.out.splitlines()[-1].split() == ["b", "110", "5", "ring_full"]
    facts = cli("info", path, "--json").json
    assert facts["gap_list"] == [{"arm": "b", "first_line": 110, "count": 5, "cause": "ring_full"}]
    assert facts["run_condition"] == "INCOMPLETE"


def test_a_recording_whose_writer_was_killed_is_not_shown_as_if_it_grew(cli: Cli, tmp_path: Path) -> None:
    path = tmp_path / "left.zarr"
    with RecordingWriter.create(path, spec()) as writer:
        for arm in ARMS:
            writer.append(block(arm, range(0)))
        writer.commit()
        growing = cli("info", path)
        assert "full in" in growing.out
        assert "acquire recover" not in growing.out
        assert cli("info", path, "--json").json["written"] is True
        assert "not sealed" not in cli("ls", tmp_path).out
    left = cli("info", path)  # closed without a seal, as by a kill
    assert "recording, no condition yet; no process writes it any more: acquire recover" in left.out
    assert "full in" not in left.out
    assert cli("info", path, "--json").json["disk"] is None
    assert "recording, not sealed" in cli("ls", tmp_path).out
    assert cli("recover", path).code == 0
    assert "acquire recover" not in cli("info", path).out


def test_a_code_without_a_seed_is_shown_without_one(cli: Cli, recording: Path) -> None:
    """Recordings of format 1 call the register's state the seed, and a rig may give that state itself."""
    root = recording / "zarr.json"
    document = json.loads(root.read_bytes())
    attributes = document["attributes"]
    attributes["format"] = "acquire-recording/1"
    attributes["code"]["seed"] = attributes["code"].pop("state")
    root.write_text(json.dumps(document))
    (shown,) = [line for line in cli("info", recording).out.splitlines() if line.lstrip().startswith("code")]
    assert "state 0x4d" in shown
    assert "None" not in cli("info", recording).out


def test_cut_is_the_segment(cli: Cli, recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "cut.npz"
    answer = cli("cut", recording, "--first-line", 110, "--lines", 20, "--out", out, "--json")
    assert answer.json == {"path": str(out), "first_line": 110, "lines": 20, "bytes": out.stat().st_size}
    segment = open_recording(recording).cut(110, 20)
    with np.load(out) as saved:
        for name in ("lines", "mask", "code", "time_ns"):
            assert np.array_equal(saved[name], getattr(segment, name))
        assert (int(saved["stages"]), int(saved["substeps"]), int(saved["first_line"])) == (M, S, 110)
        assert float(saved["substep_ns"]) == pytest.approx(10_000)
        assert (float(saved["black_level_dn"]), float(saved["responsivity_dn"])) == (1.0, 2.0)
    assert {path.name for path in tmp_path.iterdir()} == {"cut.npz", "one.zarr"}


@pytest.mark.parametrize("name", ["cut.npz.part", ".cut.npz.{pid}.partial"])
def test_cut_leaves_files_that_are_not_its_own(cli: Cli, recording: Path, tmp_path: Path, name: str) -> None:
    other = tmp_path / name.format(pid=os.getpid())
    other.write_text("precious")
    cli("cut", recording, "--first-line", 110, "--lines", 20, "--out", tmp_path / "cut.npz")
    assert other.read_text() == "precious"


def test_cut_does_not_replace_a_file_created_in_the_meantime(
    cli: Cli, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, savez = tmp_path / "cut.npz", np.savez

    def meanwhile(*words: Any, **arrays: Any) -> None:
        savez(*words, **arrays)
        out.write_text("precious")

    monkeypatch.setattr(np, "savez", meanwhile)
    answer = cli("cut", recording, "--first-line", 110, "--lines", 20, "--out", out)
    assert (answer.code, out.read_text()) == (2, "precious")
    assert {path.name for path in tmp_path.iterdir()} == {"cut.npz", "one.zarr"}


def test_cut_that_the_disk_refuses_leaves_nothing(
    cli: Cli, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    answer = cli("cut", recording, "--first-line", 110, "--lines", 20, "--out", tmp_path / "cut.npz")
    assert answer.code == 5
    assert "No space left" in answer.err
    assert {path.name for path in tmp_path.iterdir()} == {"one.zarr"}


def test_cut_overwrites_nothing(cli: Cli, recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "cut.npz"
    out.write_text("precious")
    answer = cli("cut", recording, "--first-line", 110, "--lines", 20, "--out", out)
    assert (answer.code, out.read_text()) == (2, "precious")
    answer = cli("cut", recording, "--first-line", 110, "--lines", 20, "--out", tmp_path / "no" / "c.npz")
    assert answer.code == 2


def test_cut_outside_names_the_available_lines(cli: Cli, recording: Path, tmp_path: Path) -> None:
    answer = cli("cut", recording, "--first-line", 160, "--lines", 20, "--out", tmp_path / "c.npz")
    assert answer.code == 2
    assert "possible: lines 100 to 163" in answer.err
    assert not (tmp_path / "c.npz").exists()


def test_info_states_what_can_be_lost(cli: Cli, recording: Path) -> None:
    assert (
        "kill -9: at most 16 lines; power loss: all that the system has not written to disk"
        in cli("info", recording).out
    )


def test_hold_keeps_lines_of_a_recording_that_grows(cli: Cli, tmp_path: Path) -> None:
    path = tmp_path / "endless.zarr"
    policy = Retention(max_age_lines=16, margin_lines=4)
    with RecordingWriter.create(path, replace(spec(), retention=policy, shard_chunks=1)) as writer:
        answer = cli("hold", path, "--first-line", FIRST, "--lines", 10, "--why", "flash")
        assert answer.out == f"{path}: lines {FIRST} to {FIRST + 9} are held\n"
        for arm in ARMS:
            writer.append(block(arm, range(0)))
        writer.commit()
        shown = cli("info", path).out
        assert "116 to 147" in shown
        assert f"{FIRST} to {FIRST + 9}" in shown
        answer = cli("hold", path, "--first-line", 120, "--lines", 1)
        assert (answer.code, "gone already" in answer.err) == (6, True)
        assert cli("cut", path, "--first-line", 120, "--lines", 5, "--out", tmp_path / "c.npz").code == 6
        assert cli("cut", path, "--first-line", FIRST, "--lines", 5, "--out", tmp_path / "c.npz").code == 0


def test_a_held_recording_beyond_its_limit_says_so(cli: Cli, tmp_path: Path) -> None:
    path, limit = tmp_path / "endless.zarr", {"recording": {"retention": {"max_gb": 2e-6}}}
    policy = Retention(max_bytes=2000, margin_lines=4)
    small = replace(spec(), config=limit, retention=policy, shard_chunks=1)
    with RecordingWriter.create(path, small) as writer:
        assert "max_gb" not in cli("info", path).out  # nothing is held
        cli("hold", path, "--first-line", FIRST, "--lines", 10)
        for arm in ARMS:
            writer.append(block(arm, range(0)))
        writer.commit()
        assert "more than recording.retention.max_gb allows (2 kB): lines are held" in cli("info", path).out


def test_an_export_begins_with_the_first_line_that_is_left(cli: Cli, tmp_path: Path) -> None:
    path = tmp_path / "endless.zarr"
    policy = Retention(max_age_lines=16, margin_lines=4)
    with RecordingWriter.create(path, replace(spec(), retention=policy, shard_chunks=1)) as writer:
        for arm in ARMS:
            writer.append(block(arm, range(0)))
        writer.commit()
    left = FIRST + 64 - open_recording(path).first_available_line
    assert left < 64
    for number, options in enumerate(((), ("--to", f"L{FIRST + 64}"))):
        out = tmp_path / f"{number}.npy"
        answer = cli("export", path, out, *options)
        assert (answer.code, np.load(out).shape[1]) == (0, left), answer.err
    answer = cli("export", path, tmp_path / "a.npy", "--all-frames")
    assert (answer.code, "a recording has no frames" in answer.err) == (2, True)


def test_lines_that_a_copy_needs_are_held_without_an_end(cli: Cli, tmp_path: Path) -> None:
    path = tmp_path / "endless.zarr"
    policy = Retention(max_age_lines=16, margin_lines=4, copied_to=f"memory://{tmp_path.name}")
    with RecordingWriter.create(path, replace(spec(), retention=policy, shard_chunks=1)) as writer:
        for arm in ARMS:
            writer.append(block(arm, range(0)))
        writer.commit()
        assert f"held        {FIRST} on\n" in cli("info", path).out


def test_recordings_at_urls(cli: Cli, recording: Path, tmp_path: Path) -> None:
    url = f"memory://{tmp_path.name}/one.zarr"
    answer = cli("upload", recording, url)
    assert (answer.code, "64 lines, sealed" in answer.out) == (0, True)
    assert cli("upload", recording, url, "--json").json["shards"] == 0
    assert url in cli("info", url).out
    assert cli("verify", url).code == 0
    out = tmp_path / "far.npz"
    assert cli("cut", url, "--first-line", 110, "--lines", 20, "--out", out).code == 0
    with np.load(out) as saved:
        assert np.array_equal(saved["lines"], open_recording(recording).cut(110, 20).lines)


def test_lines_that_do_not_follow_the_code_are_named(tmp_path: Path, cli: Cli) -> None:
    """Each range of each arm is listed, the last one up to the end; overlapping doubts form one range."""
    path = tmp_path / "r.zarr"
    with RecordingWriter.create(path, spec()) as writer:
        for arm in ARMS:
            writer.append(block(arm, range(0)))
        for kind, line, text in (
            (VERIFIED["a"], 100, "verified"),
            (DOUBTFUL["a"], 110, "inverted"),
            (DOUBTFUL["a"], 115, "dark"),
            (VERIFIED["a"], 120, "verified"),
            (DOUBTFUL["b"], 150, "shifted by +3 sub-steps"),
            (DOUBTFUL["a"], 130, "dark"),
            (VERIFIED["a"], 130, "verified"),
        ):
            writer.add_event(kind, 0, line, text)
        writer.seal(RunCondition.TAINTED, "stopped", {})
    stretches = [("a", 110, 10, "inverted"), ("b", 150, 14, "shifted by +3 sub-steps")]
    suspect = cli("info", path, "--json").json["suspect"]
    assert [tuple(one.values()) for one in suspect] == stretches
    assert "a 110 to 119 (inverted), b 150 to 163 (shifted by +3 sub-steps)" in cli("info", path).out
    verified = cli("verify", path)
    assert verified.code == 0  # they are there, and as they were recorded
    assert "b: lines 150 to 163 do not follow the light's code: shifted by +3 sub-steps" in verified.out


HOSTILE = "\x1b[2J\x9b31m\u202eDOOG\n/d/forged.zarr: intact\udcff"


def test_foreign_text_is_escaped_before_it_reaches_a_terminal(cli: Cli, recording: Path) -> None:
    root = recording / "zarr.json"
    meta = json.loads(root.read_text())
    meta["attributes"] |= {"end_reason": HOSTILE, "run_id": HOSTILE}
    meta["attributes"]["code"]["note"] = HOSTILE
    root.write_text(json.dumps(meta))
    odd = recording.rename(recording.with_name("\x1b[31mone\n.zarr"))
    for words in (("info", odd), ("verify", odd), ("ls", recording.parent), ("recover", odd)):
        for form in ((), ("--json",)):
            answer = cli(*words, *form)
            assert all(c.isprintable() for c in (answer.out + answer.err).replace("\n", ""))
            assert "\n/d/forged" not in answer.out + answer.err
    answer = cli("info", odd, "--json")
    assert answer.code == 0, answer.err
    assert answer.json["end_reason"] == HOSTILE


def test_a_path_as_the_target_of_an_upload_is_refused_with_its_url(
    cli: Cli, recording: Path, tmp_path: Path
) -> None:
    """The advice was to install a package for the protocol ./copy.zarr."""
    answer = cli("upload", recording, str(tmp_path / "copy.zarr"))
    assert answer.code == 2
    assert "copy.zarr is not a URL; possible: file:///" in answer.err.replace("\n  ", "; ")
    assert f"try: file://{tmp_path}/copy.zarr" in answer.err


@pytest.mark.parametrize("name", ["segment.txt", "segment", "segment.npy", "."])
def test_a_cut_is_named_as_the_archive_that_it_is(
    cli: Cli, recording: Path, tmp_path: Path, name: str
) -> None:
    """NAME.txt held a NumPy archive, which no program for texts opens."""
    answer = cli("cut", recording, "--lines", 20, "--out", f"{tmp_path}/{name}")
    assert answer.code == 2
    assert "possible: NAME.npz" in answer.err
    assert not list(tmp_path.glob("*segment*"))


def test_a_directory_that_may_not_be_entered_is_not_called_a_wrong_name(
    cli: Cli, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The advice was another name, with which it fails in the same way."""
    lstat, locked = os.lstat, tmp_path / "locked"

    def refuse(path: Any, **options: Any) -> Any:
        if Path(path).parent == locked:
            raise PermissionError(errno.EACCES, "Permission denied")
        return lstat(path, **options)

    monkeypatch.setattr(os, "lstat", refuse)
    answer = cli("cut", recording, "--lines", 20, "--out", locked / "cut.npz")
    assert answer.code == 2
    assert f"the directory {locked} may not be entered" in answer.err
    assert "another directory, or the permissions" in answer.err
