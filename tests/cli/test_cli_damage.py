"""`acquire ls`, `verify`, `replay` and `recover` of recordings that are damaged or unfinished."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from small_recordings import block, spec, write

from acquire.lines import ARMS
from acquire.store import RecordingWriter

Cli = Callable[..., Any]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write(tmp_path / "one.zarr")


def test_verify_names_lost_lines_and_exits_with_6(cli: Cli, recording: Path) -> None:
    answer = cli("verify", recording)
    assert (answer.code, answer.out.split("; ")[0]) == (0, f"{recording}: intact")
    (recording / "b" / "tick" / "c" / "0").unlink()
    answer = cli("verify", recording)
    assert answer.code == 6
    assert "not intact on disk: b/tick: lines 100 to 163: it is not on disk" in answer.out
    found = cli("verify", recording, "--json")
    assert (found.code, found.json["damage"][0]["count"]) == (6, 64)


def test_damage_is_named_with_what_to_try(cli: Cli, tmp_path: Path) -> None:
    """`ls` said no more than DAMAGED, and a file that could not be read was "gone or cut short"."""
    whole, gone, short, unread, rootless = (
        write(tmp_path / f"{name}.zarr") for name in ("whole", "gone", "short", "unread", "rootless")
    )
    shutil.rmtree(gone / "b")
    with (short / "b" / "lines" / "c" / "0" / "0").open("r+b") as file:
        file.truncate(5000)
    (unread / "b" / "lines" / "c" / "0" / "0").unlink()
    (unread / "b" / "lines" / "c" / "0" / "0").mkdir()
    (rootless / "zarr.json").unlink()
    answer = cli("ls", tmp_path)
    assert len(answer.out.splitlines()) == 6
    said = " ".join(answer.err.split())
    repair = "try: acquire verify {0}, which lists all damage; acquire recover {0}, which flags what is lost"
    assert f"{gone}: b/lines: lines 100 to 163: it is not on disk; {repair.format(gone)}" in said
    assert f"its file is cut short; {repair.format(short)}" in said
    assert f"{unread}: b/lines: lines 100 to 163: its file cannot be read: " in said
    assert f"try: the disk, and the permissions of the files; acquire verify {unread}, which" in said
    assert f"try: acquire recover {rootless}" in said
    assert str(whole) not in said
    # Lines that may come back are not to be flagged as missing.
    for path, advised in ((gone, True), (short, True), (unread, False)):
        assert (f"acquire recover {path}" in cli("verify", path).out) == advised
        refused = cli("replay", path, "--out", tmp_path / "again.zarr")
        assert refused.code == 6
        assert (f"acquire recover {path}" in refused.err) == advised, refused.err
    assert cli("recover", short).code == 0
    assert str(short) not in cli("ls", tmp_path).err


def test_recover_seals_an_unfinished_recording(cli: Cli, tmp_path: Path) -> None:
    path = tmp_path / "left.zarr"
    with RecordingWriter.create(path, spec()) as writer:
        for arm in ARMS:
            writer.append(block(arm, range(0)))
    answer = cli("recover", path)
    assert (answer.code, answer.err) == (0, "")
    assert "64 lines, recovered and sealed; 64 lines were on disk that no commit listed" in answer.out
    assert cli("recover", path).out == f"{path}: 64 lines, nothing to recover\n"
    assert cli("recover", path, "--json").json["changed"] is False
    assert "INTERRUPTED" in cli("info", path).out
    assert cli("verify", path).code == 0
