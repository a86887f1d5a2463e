"""Lines of a recording, with their tags and flags, as the content of an export."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire import __version__
from acquire.errors import UsageError
from acquire.exchange.content import Array, Axis, Block, Content, block, little
from acquire.lines import ARMS, LineFlag
from acquire.store.present import MISSING, flags_of, present_values

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from acquire.store import Recording

BLOCK_BYTES = 2**23
"""Of pixels that are in memory at a time."""
FACTS = (
    "run_id", "run_condition", "end_reason", "layout", "geometry", "trigger", "code", "clock", "cameras",
    "simulated", "imported", "versions",
)  # fmt: skip
"""What a recording says of itself that a file of its lines says, too."""


def recording_content(recording: Recording, rows: range | None = None) -> Content:
    """Lines of both arms of a recording (rows; None: all) as (arm, line, pixel), with their tags and flags.

    A line that is missing, or was dropped by retention, is 0 and flagged so. Rows with a step are an
    overview: so many lines each become their mean (float32, of those that are not missing), with all their
    flags and the first one's tags. UsageError for lines that are not there.
    """
    asked = range(recording.lines) if rows is None else rows
    if not 0 <= asked.start < asked.stop <= recording.lines:
        first, last = recording.first_line, recording.first_line + recording.lines - 1
        raise UsageError(
            f"lines {first + asked.start} to {first + asked.stop - 1} of {recording} are not all there",
            possible=f"lines {first} to {last}" if recording.lines else "none: it holds no lines yet",
        )
    stream, first_line = recording.arms[ARMS[0]], recording.first_line + asked.start
    words = "lines as recorded" if asked.step == 1 else f"means of {asked.step} lines each"
    image = Array(
        name="lines",
        dims=("arm", "line", "pixel"),
        shape=(len(ARMS), len(asked), stream.pixels),
        dtype=little(stream.dtype if asked.step == 1 else np.dtype(np.float32)),
        blocks=partial(_of_arms, recording, asked, "lines"),
        attributes={"long_name": words, "units": "DN"},
    )
    axes = (Axis("arm"), Axis("line", float(asked.step), first_line), Axis("pixel", 1.0))
    facts = _facts(recording, asked)
    return Content(
        kind="lines",
        title=str(recording),
        axes=axes,
        image=image,
        columns=tuple(_columns(recording, asked)),
        facts=facts,
    )


def _facts(recording: Recording, rows: range) -> dict[str, Any]:
    return {
        "source": str(recording),
        **{key: recording.attrs[key] for key in FACTS if key in recording.attrs},
        "first_line": recording.first_line + rows.start,
        "lines": rows.stop - rows.start,
        "lines_averaged": rows.step,
        "arms": list(ARMS),
        "line_period_s": recording.line_period_ns * 1e-9,
        "flag_masks": {flag.name.lower(): int(flag) for flag in LineFlag if flag.name},
        "exported_by": f"acquire {__version__}",
    }


def _columns(recording: Recording, rows: range) -> Iterator[Array]:
    """Flags of each arm; what follows from the line's number is the same in both."""
    stream = recording.arms[ARMS[0]]
    flags = partial(_of_arms, recording, rows, "flags")
    words = "what is known about the line beyond its pixels"
    yield Array(
        name="flags",
        dims=("arm", "line"),
        shape=(len(ARMS), len(rows)),
        dtype=np.dtype("<u2"),
        blocks=flags,
        attributes={"long_name": words},
    )
    tags = (
        ("time_ns", "time", "UTC at which the line's read-out begins, ns since 1970"),
        ("code_index", "code_index", "index of the code's bit in the line's first sub-step"),
        ("code", "code", "the line's code bits, first sub-step in bit 0"),
    )
    for name, column, words in tags if rows.step == 1 else tags[:2]:
        blocks = partial(_of_either, recording, rows, column)
        dtype = little(stream.reader(column).shape.dtype)
        yield Array(
            name=name,
            dims=("line",),
            shape=(len(rows),),
            dtype=dtype,
            blocks=blocks,
            attributes={"long_name": words},
        )


def _steps(recording: Recording, rows: range) -> Iterator[tuple[int, int]]:
    """Parts of the rows that are read at once."""
    stream = recording.arms[ARMS[0]]
    size = max(1, BLOCK_BYTES // (stream.pixels * stream.dtype.itemsize * rows.step)) * rows.step
    for start in range(rows.start, rows.stop, size):
        yield start, min(rows.stop, start + size)


def _of_arms(recording: Recording, rows: range, name: str) -> Iterator[Block]:
    for number, arm in enumerate(ARMS):
        for start, stop in _steps(recording, rows):
            flags = flags_of(recording, arm, start, stop)
            values = flags if name == "flags" else present_values(recording, arm, name, start, flags)
            if rows.step > 1:
                values = _all_flags(flags, rows.step) if name == "flags" else _means(values, flags, rows.step)
            yield block((number, _place(rows, start, stop)), values)


def _of_either(recording: Recording, rows: range, name: str) -> Iterator[Block]:
    """Tags of arm a; where its line is missing, those of arm b."""
    for start, stop in _steps(recording, rows):
        flags = {arm: flags_of(recording, arm, start, stop) for arm in ARMS}
        first, other = (present_values(recording, arm, name, start, flags[arm]) for arm in ARMS)
        both = np.where((flags[ARMS[0]] & MISSING) != 0, other, first)
        yield block((_place(rows, start, stop),), both[:: rows.step])


def _place(rows: range, start: int, stop: int) -> slice:
    """Where what becomes of these rows belongs."""
    return slice((start - rows.start) // rows.step, -(-(stop - rows.start) // rows.step))


def _all_flags(flags: NDArray[np.uint16], count: int) -> NDArray[np.uint16]:
    """Every flag that one of ``count`` lines has; ``missing`` where all of them are."""
    edges = np.arange(0, len(flags), count)
    found: NDArray[np.uint16] = np.bitwise_or.reduceat(flags & ~MISSING, edges)
    return found | np.bitwise_and.reduceat(flags & MISSING, edges)


def _means(lines: NDArray[Any], flags: NDArray[np.uint16], count: int) -> NDArray[np.float32]:
    """Of ``count`` lines each, without those that are missing, which are 0."""
    edges = np.arange(0, len(lines), count)
    total = np.add.reduceat(lines, edges, axis=0, dtype=np.float64)  # a sum of uint16 would overflow
    there = np.add.reduceat((flags & MISSING) == 0, edges, dtype=np.int64)
    return (total / np.maximum(there, 1)[:, None]).astype(np.float32)
