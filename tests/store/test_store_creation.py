"""Where and as what a recording may begin, and what a beginning that is refused leaves behind."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import pytest
import zarr
from store_helpers import check_rows, fill, make_spec

from acquire.errors import StoreError, UsageError
from acquire.store import RecordingWriter, RunCondition, open_recording
from acquire.store.files import check_new_path


@pytest.fixture
def path(tmp_path):
    return tmp_path / "r.zarr"


def test_nothing_is_overwritten_or_half_created(path, tmp_path):
    spec = make_spec()
    path.mkdir()
    with pytest.raises(UsageError, match="exists already"):
        RecordingWriter.create(path, spec)
    assert not list(path.iterdir())
    with pytest.raises(UsageError, match="does not exist"):
        RecordingWriter.create(tmp_path / "no" / "r.zarr", spec)
    dangling = tmp_path / "link.zarr"
    dangling.symlink_to(tmp_path / "nowhere")
    with pytest.raises(UsageError, match="exists already"):
        RecordingWriter.create(dangling, spec)
    (tmp_path / "file").touch()
    for below in ("r.zarr", "more/r.zarr"):  # none can be created there
        with pytest.raises(
            UsageError, match=r"/file is a file and not a directory; try: a path in a directory"
        ):
            RecordingWriter.create(tmp_path / "file" / below, spec)
    with pytest.raises(UsageError, match=r"link\.zarr is a link to .*nowhere, which does not exist"):
        RecordingWriter.create(dangling / "r.zarr", spec)
    with pytest.raises(UsageError, match=r"/null is something else and not a directory"):
        check_new_path(Path("/dev/null/r.zarr"))


@pytest.mark.parametrize("name", ["x" * 300, "nul\0.zarr", "\ud800.zarr"])
def test_what_cannot_be_a_path_is_refused(tmp_path, name):
    with pytest.raises(UsageError, match="cannot be a path") as caught:
        RecordingWriter.create(tmp_path / name, make_spec())
    assert str(caught.value).encode()  # can be printed
    assert not any(tmp_path.iterdir())


def test_nothing_is_created_within_a_recording_but_beside_it_and_within_other_groups(path, tmp_path):
    """A video that was written into its recording went with every copy of it, and with its deletion."""
    writer = RecordingWriter.create(path, make_spec())
    writer.seal(RunCondition.GOOD, "stopped", {})
    (tmp_path / "link").symlink_to(path / "a")
    for inner in (path / "v.zarr", path / "a" / "v.zarr", tmp_path / "link" / "v.zarr"):
        with pytest.raises(
            UsageError, match=r"would be a part of .*; possible: a path outside.*; try: .*v\.zarr"
        ):
            check_new_path(inner)
    zarr.create_group(tmp_path / "mine.zarr", zarr_format=3, attributes={"format": "mine"})
    for beside in (tmp_path / "v.zarr", tmp_path / "mine.zarr" / "v.zarr"):
        check_new_path(beside)


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (errno.EROFS, UsageError),
        (errno.EPERM, UsageError),
        (errno.ENOENT, UsageError),
        (errno.ENOSPC, StoreError),
    ],
)
def test_a_place_that_takes_no_directory_is_not_a_disk_that_fails(path, monkeypatch, number, kind):
    def refuse(*_, **__):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(type(path), "mkdir", refuse)
    with pytest.raises(kind, match="cannot be created"):
        RecordingWriter.create(path, make_spec())


def test_the_first_line_may_be_chosen_when_all_else_is_ready(path):
    writer = RecordingWriter.prepare(path, make_spec())
    assert not (path / "zarr.json").exists()
    writer.begin(777)
    assert open_recording(path).first_line == 777
    fill(writer, 40)
    writer.seal(RunCondition.GOOD, "stopped", {})
    recording = open_recording(path)
    assert (recording.first_line, recording.lines) == (777, 40)
    root = zarr.open_group(path, mode="r")
    assert root["b"].attrs["first_line"] == 777
    check_rows(root, make_spec(first_line=777), 40)


def test_a_disk_that_refuses_the_beginning_leaves_nothing_behind(path):
    writer = RecordingWriter.prepare(path, make_spec())
    shutil.rmtree(path / "a")
    with pytest.raises(StoreError, match="creating the recording"):
        writer.begin(5)
    assert not path.exists()


@pytest.mark.parametrize(
    "wrong",
    [
        {"dtype": "float32"},
        {"codec": "gzip"},
        {"fsync": "never"},
        {"shard_chunks": 256},
        {"tag_chunks": 3},  # no part of the 4 chunks of a file
        {"tag_chunks": 0},
        {"chunk_lines": 0},
        {"chunk_lines": 2**29},
        {"chunk_lines": 2**26 // 16 + 1},  # a little more than a chunk may take of the memory
        {"substeps": 9},
        {"first_line": -1},
        {"extra": {"format": "mine"}},
        {"extra": {"x": float("nan")}},
        {"config": {"path": object()}},
        {"cameras": {"a": {"white_dn": 1}, "b": {}}},
        {"code": {"kind": "morse"}},
    ],
)
def test_specs_that_cannot_be_recorded_are_refused(wrong):
    with pytest.raises(UsageError):
        make_spec(**wrong)


def test_a_chunk_of_tags_that_no_reader_would_take_is_refused():
    """255 chunks of 2**20 lines: 2 GB of ticks in one piece, of which no line was readable before all."""
    with pytest.raises(UsageError, match=r"tag_chunks = 252 of 1048576 lines; possible: 1 to 8: 8388608 lin"):
        make_spec(chunk_lines=2**20, shard_chunks=252, tag_chunks=252)
    make_spec(chunk_lines=2**20, shard_chunks=248, tag_chunks=8)
