"""A stretch of a recording, as every command is asked for it: by line numbers, or by moments.

::

    --first-line 2000 --lines 256      numbers of the trigger
    --from 52ms --to 57.98ms           moments, see `acquire.cli.durations`; also L2000
    --from L2000 --lines 256           the first line by a moment, and how many
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
    typer.Option(help="Number of the first line, as the trigger counts; absent: the first there is."),
]
LinesOption = Annotated[int | None, typer.Option(help="Number of lines; absent: all that follow.")]
FromOption = Annotated[
    str | None,
    typer.Option(
        "--from",
        metavar="TIME",
        help="Begin of the stretch: 52ms after the first line, UTC (2026-01-31T12:00:00), or a line (L2000).",
    ),
]
ToOption = Annotated[
    str | None,
    typer.Option(
        "--to", metavar="TIME", help="End of the stretch, given as for --from; that line is left out."
    ),
]
ROUNDING = 1e-6
"""Of a period: a moment that was printed with few digits means the line that it was printed for."""


def lines_between(
    recording: Recording,
    first_line: int | None,
    lines: int | None,
    begin: str | None,
    end: str | None,
    *,
    to_come: bool = False,
) -> tuple[int | None, int | None]:
    """First line and number of lines that were asked for; None where nothing was said.

    UsageError where a number and a moment say the same, nothing lies between begin and end, or a moment is
    before the recording or after it; with ``to_come`` lines may be asked for that it does not have yet.
    """
    if lines is not None and lines < 1:
        raise UsageError(f"{lines} lines cannot be asked for", possible="1 or more")
    if (first_line is not None and begin is not None) or (lines is not None and end is not None):
        raise UsageError(
            "the stretch is said twice, by numbers and by times",
            possible="--first-line and --lines, --from and --to, or --from and --lines",
        )
    first = first_line if begin is None else _line(recording, begin)
    last = math.inf if to_come else recording.first_line + recording.lines
    if begin is not None and first is not None and not recording.first_line <= first < last:
        raise UsageError(f"no line of {recording} begins at {begin} or after it", possible=span(recording))
    if end is None:
        return first, lines
    start = recording.first_available_line if first is None else first
    stop = _line(recording, end)
    if not start < stop <= last:
        raise UsageError(f"no line lies from {begin or f'L{start}'} to {end}", possible=span(recording))
    return start, stop - start


def span(recording: Recording) -> str:
    """What there is, in both ways in which it can be asked for."""
    first, count = recording.first_line, recording.lines
    if not count:
        return "no lines yet"
    length_ms = count * recording.line_period_ns / 1e6
    return f"lines {first} to {first + count - 1}, which is 0ms to {length_ms:.6g}ms after the first"


def _line(recording: Recording, text: str) -> int:
    """The first line that is read out at a moment or later."""
    period_ns = recording.line_period_ns
    ns = after_ns(
        text,
        lambda: first_ns(recording),
        lambda line: round((line - recording.first_line) * period_ns),
    )
    assert ns is not None  # of a text there is one
    return recording.first_line + math.ceil(ns / period_ns - max(ROUNDING, 1 / period_ns))


def first_ns(recording: Recording) -> int:
    """UTC at which the first line was read out, also where it has been dropped since."""
    row = recording.first_available_line - recording.first_line
    if row >= recording.lines:
        raise UsageError(f"{recording} holds no lines")
    return int(recording.arms["a"].read("time", row, row + 1)[0]) - round(row * recording.line_period_ns)
