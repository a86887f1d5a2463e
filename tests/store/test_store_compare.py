"""Comparing recordings: what the lines determine, array by array, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from store_helpers import CLOCK, Truth, array_of, make_spec, with_array

from acquire.clock import ClockFit
from acquire.lines import ARMS, LineTable
from acquire.store import RecordingWriter, RunCondition, open_recording
from acquire.store.compare import compare

LINES, FIRST = 100, 1000
LOST = (range(20, 24), range(60, 61))
LATER_NS, LATER_TICKS = 12_345_678_901, 77_700


def write(path, again, change=lambda arm, block: block, lost=LOST):
    """Lines from number 1000 on; ``again``: the same lines from 0 on, by a clock that began elsewhere."""
    spec = make_spec()
    clock = ClockFit(CLOCK.clock_hz, CLOCK.utc_ns_at_tick_0 + LATER_NS, 100) if again else CLOCK
    begin = 0 if again else FIRST
    with RecordingWriter.create(path, replace(spec, first_line=begin, clock=clock)) as writer:
        for arm in ARMS:
            block = Truth(spec).block(arm, FIRST, LINES)
            flags = block.flags.copy()
            for rows in lost if arm == "b" else ():
                flags[rows.start : rows.stop] = 1
                writer.add_gap(arm, begin + rows.start, len(rows), "camera")
            block = replace(block, first_line=begin, flags=flags)
            if again:
                tick = block.tags.tick - spec.substeps * FIRST * spec.substep_ticks + LATER_TICKS
                index = block.tags.code_index - np.uint64(spec.substeps * FIRST)
                tags = LineTable(index, block.tags.code, tick, clock.time_ns(tick))
                block = replace(block, tags=tags)
            writer.append(change(arm, block))
        writer.seal(RunCondition.GOOD, "stopped", {})
    return open_recording(path)


@pytest.fixture
def stored(tmp_path):
    return write(tmp_path / "r.zarr", again=False)


def test_the_same_lines_with_another_numbering_and_clock_are_equal(stored, tmp_path):
    told = []
    assert compare(stored, write(tmp_path / "again.zarr", again=True), lambda *at: told.append(at)) == []
    assert told == [(LINES, LINES)]


def changed(name, row):
    """One row of arm b's array is another."""

    def change(arm, block):
        if arm == "b":
            values = array_of(block, name).copy()
            values[row] += 1 if name != "flags" else 8
            return with_array(block, name, values)
        return block

    return change


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("pixels", "b/lines"),
        ("code", "b/code"),
        ("code_index", "b/code_index"),
        ("flags", "b/flags"),
        ("time_ns", "b/time"),
    ],
)
def test_one_row_that_differs_is_found_in_its_array(stored, tmp_path, name, array):
    (found,) = compare(stored, write(tmp_path / "again.zarr", again=True, change=changed(name, 42)))
    assert (found.array, found.rows, found.row) == (array, 1, 42)
    assert str(found).startswith(f"{array} differs in 1 row, first in row 42: ")


def test_a_tick_that_differs_takes_its_time_with_it(stored, tmp_path):
    again = write(tmp_path / "again.zarr", again=True, change=changed("tick", 42))
    assert {found.array for found in compare(stored, again)} == {"b/tick", "b/time"}


def test_arms_that_slip_against_each_other_are_no_offset(stored, tmp_path):
    def slipped(arm, block):
        return with_array(block, "tick", block.tags.tick + np.uint64(arm == "b"))

    found = compare(stored, write(tmp_path / "again.zarr", again=True, change=slipped))
    assert {one.array: one.rows for one in found}["b/tick"] == LINES - sum(map(len, LOST))


@pytest.mark.parametrize(
    ("lost", "rows", "row"), [((), 5, 20), ((*LOST, range(90, 93)), 3, 90), ((range(20, 23), LOST[1]), 1, 23)]
)
def test_gaps_that_differ_are_found_in_flags_and_gaps(stored, tmp_path, lost, rows, row):
    found = compare(stored, write(tmp_path / "again.zarr", again=True, lost=lost))
    assert {(one.array, one.rows, one.row) for one in found} == {
        ("b/flags", rows, row),
        ("gaps of arm b", rows, row),
    }


def test_what_stands_in_missing_rows_is_nothing(stored, tmp_path):
    assert compare(stored, write(tmp_path / "again.zarr", again=True, change=changed("pixels", 21))) == []


def test_fewer_lines_differ(stored, tmp_path):
    shorter = write(
        tmp_path / "again.zarr",
        again=True,
        change=lambda _, block: replace(
            block, pixels=block.pixels[:90], flags=block.flags[:90], tags=block.tags[:90]
        ),
    )
    (found,) = compare(stored, shorter)
    assert str(found) == "the recording has 100 rows, and the copy 90"
