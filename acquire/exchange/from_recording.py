"""The lines of a recording, with their tags and flags, as the content of an export."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire import __version__
from acquire.errors import UsageError
from acquire.exchange.content import Array, Axis, Block, Content, block, little
from acquire.flags import ARMS, NO_IMAGE, LineFlag
from acquire.store.present import MISSING, flags_of, present_values
from acquire.text import visible

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from acquire.store import Recording

BLOCK_BYTES = 2**23
"""Size of the pixels that are in memory at a time."""
FACTS = (
    "run_id", "run_condition", "end_reason", "layout", "geometry", "trigger", "code", "clock", "cameras",
    "simulated", "imported", "versions", "plugins",
)  # fmt: skip
"""Attributes of a recording that are copied into an export."""


def recording_content(recording: Recording, rows: range | None = None) -> Content:
    """Return the lines of both arms (rows; None for all) as (arm, line, pixel), with their tags and flags.

    A line that is missing, or was dropped by retention, is 0 and flagged. Rows with a step make an overview:
    each group of lines becomes its mean (float32, without missing lines), with all their flags and the tags
    of the first. Raises UsageError for lines that the recording does not have.
    """
    rows = range(recording.lines) if rows is None else rows
    if not 0 <= rows.start < rows.stop <= recording.lines:
        first, last = recording.first_line, recording.first_line + recording.lines - 1
        raise UsageError(
            f"{recording} does not have all lines from {first + rows.start} to {first + rows.stop - 1}",
            possible=f"lines {first} to {last}" if recording.lines else "none: it has no lines yet",
        )
    stream, first_line = recording.arms[ARMS[0]], recording.first_line + rows.start
    long_name = "lines as recorded" if rows.step == 1 else f"means of {rows.step} lines each"
    image = Array(
        name="lines",
        dims=("arm", "line", "pixel"),
        shape=(len(ARMS), len(rows), stream.pixels),
        dtype=little(stream.dtype if rows.step == 1 else np.dtype(np.float32)),
        blocks=partial(_of_arms, recording, rows, "lines"),
        attributes={"long_name": long_name, "units": "DN"},
    )
    return Content(
        kind="lines",
        title=visible(recording),
        axes=(Axis("arm"), Axis("line", float(rows.step), first_line), Axis("pixel", 1.0)),
        image=image,
        columns=tuple(_columns(recording, rows)),
        facts={
            "source": str(recording),
            **{key: recording.attrs[key] for key in FACTS if key in recording.attrs},
            "first_line": recording.first_line + rows.start,
            "lines": rows.stop - rows.start,
            "lines_averaged": rows.step,
            "arms": list(ARMS),
            "line_period_s": recording.line_period_ns * 1e-9,
            "flag_masks": {flag.name.lower(): int(flag) for flag in LineFlag if flag.name},
            "exported_by": f"acquire {__version__}",
        },
    )


def _columns(recording: Recording, rows: range) -> Iterator[Array]:
    """Yield the flags of each arm, and the tags, which are the same in both arms."""
    stream = recording.arms[ARMS[0]]
    yield Array(
        name="flags",
        dims=("arm", "line"),
        shape=(len(ARMS), len(rows)),
        dtype=np.dtype("<u2"),
        blocks=partial(_of_arms, recording, rows, "flags"),
        attributes={"long_name": "what is known about the line beyond its pixels"},
    )
    tags = (
        ("time_ns", "time", "UTC at which the line's read-out begins, ns since 1970"),
        ("code_index", "code_index", "index of the code's bit in the line's first sub-step"),
        ("code", "code", "the line's code bits, first sub-step in bit 0"),
    )
    # The code bits of its first line say nothing about a mean.
    for name, column, long_name in tags if rows.step == 1 else tags[:2]:
        yield Array(
            name=name,
            dims=("line",),
            shape=(len(rows),),
            dtype=little(stream.reader(column).shape.dtype),
            blocks=partial(_of_either, recording, rows, column),
            attributes={"long_name": long_name},
        )


def _block_lines(recording: Recording) -> int:
    """Return the number of lines whose pixels are in memory at a time."""
    stream = recording.arms[ARMS[0]]
    return max(1, BLOCK_BYTES // (stream.pixels * stream.dtype.itemsize))


def _steps(recording: Recording, rows: range) -> Iterator[tuple[int, int]]:
    """Yield the parts of the rows that make a block of the export, as start and stop."""
    # A multiple of the step, so that no group of lines is split between two blocks.
    size = max(1, _block_lines(recording) // rows.step) * rows.step
    for start in range(rows.start, rows.stop, size):
        yield start, min(rows.stop, start + size)


def _of_arms(recording: Recording, rows: range, name: str) -> Iterator[Block]:
    # One arm after the other: the pieces of an array follow each other in C order (`Block`).
    for number, arm in enumerate(ARMS):
        for start, stop in _steps(recording, rows):
            # More than a block only if a single group is: then it is read in parts.
            if stop - start > _block_lines(recording):
                values = _long_group(recording, arm, name, start, stop)
                yield block((number, _place(rows, start, stop)), values)
                continue
            flags = flags_of(recording, arm, start, stop)
            values = flags if name == "flags" else present_values(recording, arm, name, start, flags)
            if rows.step > 1:
                values = _groups(name, values, flags, rows.step)
            yield block((number, _place(rows, start, stop)), values)


def _long_group(recording: Recording, arm: str, name: str, start: int, stop: int) -> NDArray[Any]:
    """Return the flags, or the mean, of one group of lines that is read in parts: it may be very long."""
    found, total, there = np.zeros(1, np.uint16), np.zeros(1), 0
    for begin in range(start, stop, _block_lines(recording)):
        flags = flags_of(recording, arm, begin, min(stop, begin + _block_lines(recording)))
        found |= np.bitwise_or.reduce(flags)
        seen = (flags & NO_IMAGE) == 0
        there += int(seen.sum())
        if name == "lines":
            lines = present_values(recording, arm, name, begin, flags)
            # Sums of integers are exact in double, so that the parts give the same mean as the whole.
            total = total + lines[seen].sum(axis=0, dtype=np.float64)
    if name == "flags":
        return found & ~np.uint16(NO_IMAGE) if there else found
    return (total / max(there, 1))[None].astype(np.float32)


def _of_either(recording: Recording, rows: range, name: str) -> Iterator[Block]:
    """Yield the tags of arm a, or those of arm b where the line of arm a is missing."""
    for start, stop in _steps(recording, rows):
        end = stop if stop - start > rows.step else start + 1  # of a single group only the first tag is used
        flags = {arm: flags_of(recording, arm, start, end) for arm in ARMS}
        first, other = (present_values(recording, arm, name, start, flags[arm]) for arm in ARMS)
        both = np.where((flags[ARMS[0]] & MISSING) != 0, other, first)
        yield block((_place(rows, start, stop),), both[:: rows.step])


def _place(rows: range, start: int, stop: int) -> slice:
    """Return the index in the export of these rows of the recording."""
    return slice((start - rows.start) // rows.step, -(-(stop - rows.start) // rows.step))


def _groups(name: str, values: NDArray[Any], flags: NDArray[np.uint16], count: int) -> NDArray[Any]:
    """Make one of every ``count`` lines, as `_long_group` does: all their flags, or the mean of their pixels.

    A group has no image only if none of its lines has one; its mean is 0 then.
    """
    edges = np.arange(0, len(flags), count)
    has_image = (flags & NO_IMAGE) == 0
    there = np.add.reduceat(has_image, edges, dtype=np.int64)
    if name == "flags":
        found = np.bitwise_or.reduceat(flags, edges)
        return np.where(there > 0, found & ~np.uint16(NO_IMAGE), found)
    # In double, as in `_long_group`, so that both ways give the same mean.
    total = np.add.reduceat(np.where(has_image[:, None], values, 0), edges, axis=0, dtype=np.float64)
    return (total / np.maximum(there, 1)[:, None]).astype(np.float32)
