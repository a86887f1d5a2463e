"""Comparison of two recordings of the same lines, array by array: the first difference, and their number.

A recording made from another one numbers its lines from 0 again, and has a clock of its own. So the following
is compared, which the lines themselves determine:

=============  ==========================================================================================
lines, code    equal
flags          equal; both missing is equal, whatever else is flagged
code_index     equal if each is counted from its recording's line 0
tick           equal up to one offset, the same for all rows of both arms
time           equal offset from the recording's own clock at its tick, to the nanosecond
gaps           the same rows of the same arm; their causes may differ
=============  ==========================================================================================

Rows that are missing in either are compared only by their flags and gaps.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.lines import ARMS
from acquire.store.present import MISSING, flags_of, present_values
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from acquire.store.reader import Recording

# A recording may be longer than memory.
BLOCK_ROWS = 16_384
COLUMNS = ("lines", "code", "flags", "code_index", "tick", "time")
ROWS = "number of rows"
Block = dict[str, "NDArray[Any]"]


@dataclass(frozen=True, slots=True)
class Difference:
    """First difference between an array of both recordings, and the number of rows that differ."""

    array: str
    rows: int
    row: int
    first: str
    second: str

    def __str__(self) -> str:
        if self.array == ROWS:
            return f"the recording has {self.first} rows, and the copy {self.second}"
        return (
            f"{self.array} differs in {counted(self.rows, 'row')}, first in row {self.row}: {self.first}, "
            f"and {self.second} in the copy"
        )

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def compare(
    first: Recording, second: Recording, progress: Callable[[int, int], object] | None = None
) -> list[Difference]:
    """Compare every array of ``second`` with ``first``; row 0 of ``second`` is line ``second.first_line``.

    Raises DataError if one of them cannot be read.
    """
    shift = second.first_line  # a copy counts from 0, and may begin with a later line of the original
    asked, have = first.lines - shift, second.lines
    count = Difference(ROWS, abs(asked - have), min(asked, have), str(asked), str(have))
    found = [] if asked == have else [count]
    rows = max(0, min(asked, have))
    by_array: dict[str, Difference] = {}
    ticks = _Offset()
    for start in range(0, rows, BLOCK_ROWS):
        stop = min(start + BLOCK_ROWS, rows)
        for arm in ARMS:
            old, new = _read(first, arm, start + shift, stop + shift), _read(second, arm, start, stop)
            _count_from_zero(first, second, old, new, ticks)
            for found_here in _of_block(arm, start, old, new):
                before = by_array.setdefault(found_here.array, found_here)
                if before is not found_here:  # the first difference stays, and the number grows
                    by_array[before.array] = replace(before, rows=before.rows + found_here.rows)
        if progress is not None:
            progress(stop, rows)
    return [*found, *by_array.values(), *_of_gaps(first, second, shift, rows)]


class _Offset:
    """Offset between the two clocks: found at the first row that both have, and constant from there on."""

    def __init__(self) -> None:
        self.ticks: int | None = None


def _read(recording: Recording, arm: str, start: int, stop: int) -> Block:
    flags = flags_of(recording, arm, start, stop)
    values = {name: present_values(recording, arm, name, start, flags) for name in COLUMNS if name != "flags"}
    return {"flags": flags, **values}


def _count_from_zero(first: Recording, second: Recording, old: Block, new: Block, offset: _Offset) -> None:
    """Refer numbers and clocks of both to the same origin; set rows that either lacks to 0."""
    both = ((old["flags"] | new["flags"]) & MISSING) == 0
    for recording, block in ((first, old), (second, new)):
        # int64 throughout: differences of recorded numbers may be negative if something is wrong
        block["time"] = block["time"] - recording.clock.time_ns(block["tick"])
        begin = 0 if recording is second else first.substeps * first.first_line
        block["code_index"] = block["code_index"].astype(np.int64) - begin
        block["tick"] = block["tick"].astype(np.int64)
    if offset.ticks is None and both.any():
        row = int(both.argmax())
        offset.ticks = int(new["tick"][row] - old["tick"][row])
    new["tick"] = new["tick"] - (offset.ticks or 0)
    for block in (old, new):
        for name in COLUMNS:
            if name != "flags":
                block[name][~both] = 0
    neither = (old["flags"] & new["flags"] & MISSING) != 0
    old["flags"][neither] = new["flags"][neither] = MISSING


def _of_block(arm: str, start: int, old: Block, new: Block) -> Iterator[Difference]:
    for name in COLUMNS:
        differs = (old[name] != new[name]).reshape(len(old[name]), -1).any(axis=1)
        if differs.any():
            row = int(differs.argmax())
            yield Difference(
                f"{arm}/{name}",
                int(differs.sum()),
                start + row,
                _shown(old[name][row]),
                _shown(new[name][row]),
            )


def _shown(value: Any) -> str:
    """Return a value as text; of a line, its first pixels."""
    if np.ndim(value) == 0:
        return str(value)
    return f"[{' '.join(map(str, value[:4]))}{' …' if len(value) > 4 else ''}]"


def _of_gaps(first: Recording, second: Recording, shift: int, rows: int) -> Iterator[Difference]:
    """Compare the listed gaps; if a table was full, the flags alone have the gaps that it lacks."""
    if first.gaps_not_listed or second.gaps_not_listed:
        return
    for arm in ARMS:
        old = _edges([*first.lost_rows(arm), *first.dropped_rows()], shift, rows)
        new = _edges(second.lost_rows(arm), 0, rows)
        # Edges that only one of the two has. They come in pairs, and between those of a pair the two
        # disagree.
        differing = np.setxor1d(old, new)
        if len(differing):
            row = int(differing[0])
            # An odd number of edges up to a row: it is inside a lost range.
            words = ("lost", "not lost") if np.searchsorted(old, row, "right") % 2 else ("not lost", "lost")
            count = int((differing[1::2] - differing[::2]).sum())
            yield Difference(f"gaps of arm {arm}", count, row, *words)


def _edges(stretches: list[range], shift: int, rows: int) -> NDArray[np.int64]:
    """Return first and end row of the ranges in turn; ranges that touch or overlap are joined."""
    edges: list[int] = []
    for lost in sorted(stretches, key=lambda lost: lost.start):
        begin, end = (min(max(0, row - shift), rows) for row in (lost.start, lost.stop))
        if begin >= end:
            continue
        if edges and begin <= edges[-1]:
            edges[-1] = max(edges[-1], end)
        else:
            edges += [begin, end]
    return np.array(edges, np.int64)
