"""The overview beside a recording's lines: what it shows, and that it never stands in a recording's way."""

from __future__ import annotations

import errno
import json
from pathlib import Path

import numpy as np
import pytest
import xarray
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from store_helpers import Truth, make_spec

from acquire.errors import DataError
from acquire.lines import ARMS, LineFlag, TaggedBlock
from acquire.store import Recording, RecordingWriter, RunCondition, mirror, open_recording, recover, verify
from acquire.store.files import DISK, Disk
from acquire.store.overview import AVERAGED, CHUNKS, FIRST_STEP, MOST_ROWS, NAME, PassingOverview

SPEC = make_spec(chunk_lines=64, shard_chunks=8)


def missing(block: TaggedBlock, lost: frozenset[int]) -> TaggedBlock:
    gone = np.isin(block.first_line + np.arange(len(block.flags)), list(lost))
    block.pixels[gone] = 0
    block.flags[gone] |= np.uint16(LineFlag.MISSING)
    return block


def record(path: Path, lines: int, lost: frozenset[int] = frozenset(), disk: Disk = DISK) -> Recording:
    """Arm b lacks lines, which are listed as they must be."""
    with RecordingWriter.create(path, SPEC, disk) as writer:
        for line in sorted(lost):
            writer.add_gap("b", line, 1, "ring_full")
        for start in range(SPEC.first_line, SPEC.first_line + lines, 100):
            count = min(100, SPEC.first_line + lines - start)
            for arm in ARMS:
                block = Truth(SPEC).block(arm, start, count)
                writer.append(missing(block, lost) if arm == "b" else block)
        writer.seal(RunCondition.GOOD, "done", {})
    return open_recording(path)


def expected(arm: str, rows: int, step: int, lost: frozenset[int] = frozenset()) -> np.ndarray:
    """By its definition, from every line alone."""
    found = np.zeros((rows, SPEC.pixels), SPEC.dtype)
    for row in range(rows):
        line = SPEC.first_line + row * step + np.arange(AVERAGED)
        there = np.isin(line, list(lost), invert=True) if arm == "b" else np.ones(AVERAGED, bool)
        if there.any():
            found[row] = np.rint(Truth(SPEC).pixels(arm, line)[there].mean(axis=0))
    return found


@settings(max_examples=30, deadline=None)
@given(lines=st.integers(0, 700), block_lines=st.integers(1, 300), rows=st.sampled_from([2, 4, 1024]))
def test_rows_are_means_however_lines_come(lines, block_lines, rows):
    passing = PassingOverview(SPEC.pixels)
    passing._sums, passing._counts = passing._sums[:rows], passing._counts[:rows]
    for start in range(0, lines, block_lines):
        passing.add(Truth(SPEC).block("a", 1000 + start, min(block_lines, lines - start)), 1000)
    found = passing.rows(lines, SPEC.dtype)
    assert len(found) == len(range(0, lines - AVERAGED + 1, passing.step)) <= rows
    assert passing.step == FIRST_STEP or lines > rows * passing.step / 2
    np.testing.assert_array_equal(found, expected("a", len(found), passing.step))


def test_other_programs_see_it(tmp_path):
    lost = frozenset([*range(1064, 1072), 1130, 1131])
    recording = record(tmp_path / "r.zarr", 300, lost=lost)
    for arm in ARMS:
        overview = recording.overview(arm)
        assert (overview.first_line, overview.lines_per_row) == (1000, 64)
        np.testing.assert_array_equal(overview.rows, expected(arm, 5, 64, lost))
        np.testing.assert_array_equal(zarr.open_group(recording.path)[f"overview/{arm}"][:], overview.rows)
    with xarray.open_zarr(recording.path, group="overview") as seen:
        assert seen["line"].values.tolist() == [1000, 1064, 1128, 1192, 1256]
        assert seen["b"].sel(line=1064).values.max() == 0
        assert seen.attrs["lines_per_row"] == 64
    assert verify(recording.path).intact


def test_it_stays_small(tmp_path, monkeypatch):
    assert len(PassingOverview(2**16)._counts) == 64
    assert len(PassingOverview(192)._counts) == MOST_ROWS
    monkeypatch.setattr("acquire.store.overview.MOST_ROWS", 4)
    recording = record(tmp_path / "r.zarr", 1500)
    overview = recording.overview("b")
    assert (len(overview.rows), overview.lines_per_row) == (3, 512)
    np.testing.assert_array_equal(overview.rows, expected("b", 3, 512))


def test_too_short_for_a_row(tmp_path):
    recording = record(tmp_path / "r.zarr", AVERAGED - 1)
    assert recording.overview("a") is None
    assert verify(recording.path).intact


class FullDisk(Disk):
    """Takes no overview, as one that is full to the last byte."""

    def make_directory(self, path, *, parents=False):
        if NAME in path.parts and path.parts[-1] == "c" and "line" in path.parts:
            raise OSError(errno.ENOSPC, "No space left on device")
        super().make_directory(path, parents=parents)


class NearlyFullDisk(Disk):
    """Room enough for what a recording's end needs."""

    def free_bytes(self, path):
        return 2**22


@pytest.mark.parametrize(
    ("disk", "why"), [(FullDisk(), "No space left"), (NearlyFullDisk(), "room for the recording's end alone")]
)
def test_a_recording_is_sealed_without_one(tmp_path, disk, why):
    recording = record(tmp_path / "r.zarr", 300, disk=disk)
    assert (recording.state, recording.lines, recording.overview("a")) == ("sealed", 300, None)
    assert why in recording.attrs["ledger"]["store"]["no_overview"]
    assert not [path for path in (recording.path / NAME).rglob("*") if path.is_file()]
    assert verify(recording.path).intact


def test_verify_reports_an_overview_that_contradicts_the_lines(tmp_path):
    recording = record(tmp_path / "r.zarr", 300)
    array = zarr.open_group(recording.path, mode="r+")["overview/b"]
    array[1:3] += 1
    told = "b: 2 rows of the overview are not the mean of the lines"
    assert verify(recording.path).contradictions == (told,)
    file = recording.path / CHUNKS[0]
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(DataError, match="overview cannot be read: the checksum is wrong"):
        recording.overview("a")
    assert "overview cannot be read" in verify(recording.path).contradictions[0]
    assert recording.cut(1000, 64).mask.any()  # the lines are not concerned


@pytest.mark.parametrize("damage", ["no array", "no step", "other pixels", "no group"])
def test_a_root_that_says_nonsense_of_it(tmp_path, damage):
    recording = record(tmp_path / "r.zarr", 300)
    document = json.loads((recording.path / "zarr.json").read_text())
    nodes = document["consolidated_metadata"]["metadata"]
    if damage == "no array":
        del nodes["overview/a"]
    if damage == "no step":
        nodes["overview"]["attributes"]["lines_per_row"] = 0
    if damage == "other pixels":
        nodes["overview/a"]["shape"] = [5, 2**40]
    if damage == "no group":
        del nodes["overview"]
    (recording.path / "zarr.json").write_text(json.dumps(document))
    again = open_recording(recording.path)
    if damage == "no group":
        assert again.overview("a") is None
    else:
        with pytest.raises(DataError, match="overview cannot be read"):
            again.overview("a")


def test_it_is_copied_recovered_and_rebuilt_with_the_recording(tmp_path):
    recording = record(tmp_path / "r.zarr", 300)
    whole = recording.overview("a").rows
    mirror(recording.path, f"file://{tmp_path}/copy.zarr")
    assert verify(tmp_path / "copy.zarr").intact
    np.testing.assert_array_equal(open_recording(tmp_path / "copy.zarr").overview("a").rows, whole)
    (recording.path / "a" / "lines" / "c" / "0" / "0").unlink()
    recover(recording.path)
    assert verify(recording.path).contradictions == ()
    np.testing.assert_array_equal(open_recording(recording.path).overview("a").rows, whole)
    (recording.path / "zarr.json").unlink()
    recover(recording.path)
    assert verify(recording.path).contradictions == ()
    np.testing.assert_array_equal(open_recording(recording.path).overview("a").rows, whole)
