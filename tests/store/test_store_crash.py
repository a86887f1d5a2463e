"""What happens to a recording when its writer is killed, its disk is full, or somebody reads meanwhile."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import xarray
import zarr
from store_helpers import Truth, check_rows
from writer_process import SPEC

from acquire.store import open_recording, recover, verify

SCRIPT = Path(__file__).with_name("writer_process.py")
WAIT_S = 300.0


@contextmanager
def writer_process(path: Path, lines: int, file_limit: int = 0):
    """The writer's process, begun; killed at the end if it still runs."""
    command = [sys.executable, "-W", "error", str(SCRIPT), str(path), str(lines), str(file_limit)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == "ready 0\n"
            yield process
        finally:
            process.kill()


def words(output: str) -> list[tuple[str, int]]:
    """Whole lines of output as (what, number); a line that a kill cut short says nothing."""
    lines = output[: output.rfind("\n") + 1].splitlines()
    return [(line.rsplit(" ", 1)[0], int(line.rsplit(" ", 1)[1])) for line in lines]


@pytest.mark.parametrize("seed", range(8))
def test_kill_leaves_everything_that_was_acknowledged(tmp_path, seed):
    path = tmp_path / "r.zarr"
    moment = random.Random(seed)
    commits = moment.choice([0, 1, 5, 20, 60])
    with writer_process(path, 10**9) as process:
        acknowledged = 0
        for _ in range(commits):
            ((_, acknowledged),) = words(process.stdout.readline())
        time.sleep(moment.uniform(0, 0.01))  # the moment of the kill itself, anywhere in a commit
        process.kill()
        last = words(process.stdout.read())
    acknowledged = last[-1][1] if last else acknowledged
    if not (path / "zarr.json").exists():
        assert commits == 0
        return
    root = zarr.open_group(path, mode="r")
    rows = root["a/lines"].shape[0]
    assert rows >= acknowledged
    assert rows % (SPEC.chunk_lines * SPEC.tag_chunks) == 0
    check_rows(root, SPEC, rows)
    for arm in "ab":
        with xarray.open_zarr(path, group=arm, chunks=None) as dataset:
            assert dataset.sizes["line"] >= rows
            assert (dataset["lines"].values > 0).all()
        assert (zarr.open_array(path / arm / "lines", mode="r")[:] > 0).all()
    recording = open_recording(path)
    assert (recording.state, recording.lines) == ("recording", rows)
    if rows:
        assert recording.cut(SPEC.first_line, rows).mask.all()
    recovered = recover(path)
    assert recovered.lines >= rows
    assert not recovered.damage
    check_rows(zarr.open_group(path, mode="r"), SPEC, recovered.lines)
    assert verify(path).intact
    assert not recover(path).changed


def test_reader_of_a_growing_recording_never_sees_a_line_that_is_not_there(tmp_path):
    path = tmp_path / "r.zarr"
    steps, seen = 0, 0
    with writer_process(path, 24 * 6 * 200) as process:
        deadline = time.monotonic() + WAIT_S
        while not (path / "zarr.json").exists():
            assert time.monotonic() < deadline
        while (recording := open_recording(path)).state == "recording":
            assert time.monotonic() < deadline
            rows = recording.lines
            assert rows >= seen
            if rows > seen:
                check_growth(recording, path, seen)
                steps, seen = steps + 1, rows
        assert words(process.stdout.read())[-1] == ("sealed", 24 * 6 * 200)
    assert steps >= 3
    check_rows(zarr.open_group(path, mode="r"), SPEC, 24 * 6 * 200)


def check_growth(recording, path, seen):
    """The new lines are right: by our reader, by zarr-python, and by xarray."""
    first, new = SPEC.first_line + seen, recording.lines - seen
    truth = Truth(SPEC).block("b", first, new)
    np.testing.assert_array_equal(recording.cut(first, new).lines[1], truth.pixels)
    tail = slice(seen, recording.lines)
    np.testing.assert_array_equal(zarr.open_group(path, mode="r")["b/lines"][tail], truth.pixels)
    with xarray.open_zarr(path, group="b", chunks=None) as arm:
        np.testing.assert_array_equal(arm["lines"][tail], truth.pixels)
        assert (arm["lines"][-1] > 0).all()


@pytest.mark.parametrize("file_limit", [40_000, 100_000, 270_000])
def test_a_full_disk_is_reported_and_nothing_false_is_acknowledged(tmp_path, file_limit):
    """The kernel refuses to let a file grow beyond the limit, in the midst of a chunk."""
    path = tmp_path / "r.zarr"
    with writer_process(path, 10_000, file_limit) as process:
        said = words(process.stdout.read())
        assert process.wait(WAIT_S) == 0
    *commits, (error, at_error), (sealed, rows) = said
    assert sealed == "sealed"
    assert "the disk failed while writing lines of arm" in error
    assert "File too large" in error
    assert f"{at_error} lines of each arm are committed" in error
    assert "try: a disk whose file system holds larger files" in error
    assert at_error == (commits[-1][1] if commits else 0)
    root = zarr.open_group(path, mode="r")
    assert rows >= at_error
    check_rows(root, SPEC, rows)
    assert root.attrs["run_condition"] == "ABORTED"
    assert root.attrs["ledger"]["store"]["disk_error"].endswith("File too large")
    assert root.attrs["ledger"]["store"]["lines_left_out"]["a"] > 0
