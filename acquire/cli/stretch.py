"""The options that select a range of lines, shared by all commands: by line numbers, or by moments.

::

    --first-line 2000 --lines 256      line numbers, as the trigger counts them
    --from 52ms --to 57.98ms           moments, see `acquire.cli.durations`; also L2000
    --from L2000 --lines 256           a first moment and a number of lines
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.moments import after_ns
from acquire.errors import UsageError

if TYPE_CHECKING:
    from acquire.store import Recording

FirstLineOption = Annotated[
    int | None,
    typer.Option(
        help="Number of the first line, as counted by the trigger. Default: the first one available."
    ),
]
LinesOption = Annotated[int | None, typer.Option(help="Number of lines. Default: all lines to the end.")]
FromOption = Annotated[
    str | None,
    typer.Option(
        "--from",
        metavar="TIME",
        help="Start of the range: a time after the first line or frame (52ms), UTC (2026-01-31T12:00:00), or "
        "a line (L2000).",
    ),
]
ToOption = Annotated[
    str | None,
    typer.Option(
        "--to",
        metavar="TIME",
        help="End of the range, in the same forms as --from. The end itself is excluded.",
    ),
]
ROUNDING = 1e-6
"""Tolerance in line periods, so that a moment printed with few digits still selects its line."""


def lines_between(
    recording: Recording,
    first_line: int | None,
    lines: int | None,
    begin: str | None,
    end: str | None,
    *,
    to_come: bool = False,
) -> tuple[int | None, int | None]:
    """Return the first line and the number of lines that the options select; None for an absent option.

    Raises UsageError if a number and a moment contradict each other, if the range is empty, or if a moment is
    outside the recording. With ``to_come`` the range may include lines that are not recorded yet.
    """
    if lines is not None and lines < 1:
        raise UsageError(f"a range of {lines} lines cannot be selected", possible="1 or more")
    if (first_line is not None and begin is not None) or (lines is not None and end is not None):
        raise UsageError(
            "the range is given twice, by line numbers and by times",
            possible="--first-line and --lines, --from and --to, or --from and --lines",
        )
    first = first_line if begin is None else _line(recording, begin)
    last = math.inf if to_come else recording.first_line + recording.lines
    if first is not None and not recording.first_line <= first < last:
        asked = f"line {first}" if begin is None else f"line at or after {begin}"
        raise UsageError(f"{recording} has no {asked}", possible=span(recording))
    if end is None:
        return first, lines
    start = recording.first_available_line if first is None else first
    stop = _line(recording, end)
    if not start < stop <= last:
        raise UsageError(f"there are no lines from {begin or f'L{start}'} to {end}", possible=span(recording))
    return start, stop - start


def span(recording: Recording) -> str:
    """Describe the lines of a recording, by numbers and by times."""
    first, count = recording.first_line, recording.lines
    if not count:
        return "no lines yet"
    length_ms = count * recording.line_period_ns / 1e6
    return f"lines {first} to {first + count - 1}, or 0ms to {length_ms:.6g}ms after the first"


def _line(recording: Recording, text: str) -> int:
    """Return the first line that is read out at a moment or later."""
    period_ns = recording.line_period_ns
    ns = after_ns(
        text,
        lambda: first_ns(recording),
        lambda line: round((line - recording.first_line) * period_ns),
    )
    assert ns is not None  # it is None only for an absent text
    # Moments are rounded to whole nanoseconds, so the tolerance is one at least.
    return recording.first_line + math.ceil(ns / period_ns - max(ROUNDING, 1 / period_ns))


def first_ns(recording: Recording) -> int:
    """Return the UTC (ns) at which the first line was read out, even if retention has dropped it since."""
    row = recording.first_available_line - recording.first_line
    if row >= recording.lines:
        raise UsageError(f"{recording} has no lines")
    # Of arm a: line ℓ of both arms has one line start, and one time.
    return int(recording.arms["a"].read("time", row, row + 1)[0]) - round(row * recording.line_period_ns)
