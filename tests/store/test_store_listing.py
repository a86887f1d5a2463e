"""Recordings of any name are found by what they hold, and nothing else is looked into."""

from __future__ import annotations

import json
import os
from pathlib import Path

from store_helpers import fill, make_spec

from acquire.store import RecordingWriter, RunCondition
from acquire.store.listing import candidates, is_ours


def write(path: Path) -> Path:
    with RecordingWriter.create(path, make_spec()) as writer:
        fill(writer, 64)
        writer.seal(RunCondition.GOOD, "stopped", {})
    return path


def names(directory: Path) -> list[str]:
    return [path.name for path in candidates(directory)]


def test_recordings_of_any_name_are_found(tmp_path: Path) -> None:
    for name in ("a.zarr", "b", "take 3.2026", "ünï"):
        write(tmp_path / name)
    (write(tmp_path / "no root") / "zarr.json").unlink()
    (tmp_path / "damaged.zarr").mkdir()
    (tmp_path / "nowhere.zarr").symlink_to(tmp_path / "none")
    assert names(tmp_path) == ["a.zarr", "b", "damaged.zarr", "no root", "nowhere.zarr", "take 3.2026", "ünï"]
    assert [path.name for path in tmp_path.iterdir() if not is_ours(path)] == ["nowhere.zarr"]


def test_whatever_else_lies_there_is_left_out(tmp_path: Path) -> None:
    """Files, links, pipes, other people's groups, and directories of recordings."""
    run = write(tmp_path / "run.zarr")
    (tmp_path / "note.txt").write_text("x")
    (tmp_path / "latest").symlink_to(run)
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "older").mkdir()
    write(tmp_path / "older" / "x.zarr")
    write(tmp_path / ".hidden")
    for name, text in (
        ("theirs", json.dumps({"attributes": {"format": "theirs/1"}})),
        ("torn", "{"),
        ("deep", "[" * 100_000),
        ("number", json.dumps({"attributes": {"format": 7}})),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "zarr.json").write_text(text)
    (tmp_path / "odd").mkdir()
    os.mkfifo(tmp_path / "odd" / "zarr.json")
    (tmp_path / "led away").mkdir()
    (tmp_path / "led away" / "zarr.json").symlink_to(run / "zarr.json")
    os.mkdir(os.fsencode(tmp_path) + b"/\xff\xfe")  # noqa: PTH102
    assert names(tmp_path) == ["run.zarr"]
