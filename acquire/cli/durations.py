"""The grammar of durations and moments on the command line.

::

    duration   5   5s   500ms   300us   2min   1.5h      a bare number is in seconds
    moment     a duration after the first line or frame · UTC (2026-01-31T12:00:00) · a line (L5000)

`seconds` parses the durations of options; `acquire.cli.stretch` converts moments to lines.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

import typer

from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

UNITS_NS = {"ns": 1, "us": 10**3, "µs": 10**3, "ms": 10**6, "s": 10**9, "": 10**9, "min": 60 * 10**9}
UNITS_NS["h"] = 60 * UNITS_NS["min"]
DURATIONS = "2s, 500ms, 300us, 1.5min, 1h, or a number of seconds"
MOMENTS = (
    f"{DURATIONS}, after the first line or frame; UTC such as 2026-01-31T12:00:00; or a line such as L5000"
)
_FORM = re.compile(r"\s*([0-9.eE+-]*[0-9.])\s*([a-zµ]*)\s*")
_NS_PER_S = 1e9
MOST_NS = 10**9 * UNITS_NS["s"]
"""Thirty years; a longer time is a typing error."""


def duration_ns(text: str) -> float | None:
    """Parse a duration to nanoseconds; None for other text."""
    found = _FORM.fullmatch(text)
    if found is None or found[2] not in UNITS_NS:
        return None
    try:
        value = float(found[1]) * UNITS_NS[found[2]]
    # Such as 1.2.3, which has only characters of a number.
    except ValueError:
        return None
    # `1e999` is a valid float, and infinite.
    return value if math.isfinite(value) and value >= 0 else None


def parse_duration_ns(text: str) -> int:
    """Parse ``52ms`` to whole nanoseconds. Raises UsageError that names the possible forms."""
    value = duration_ns(text)
    if value is None:
        raise UsageError(f"the time {text!r} cannot be read", possible=MOMENTS)
    if value > MOST_NS:
        raise UsageError(f"the time {text!r} is more than 30 years", possible=MOMENTS)
    return round(value)


def seconds(text: str | float) -> float:
    """Parse a duration to seconds. Raises typer.BadParameter that names the possible forms."""
    # As text: typer gives the default to the parser as well, and that is a number.
    value = duration_ns(str(text))
    if value is None:
        raise typer.BadParameter(f"{text!r} is not a duration, such as {DURATIONS}")
    if value > MOST_NS:
        raise typer.BadParameter(f"{text!r} is more than 30 years")
    return value / _NS_PER_S


def seconds_between(least: float, most: float = math.inf) -> Callable[[str | float], float]:
    """Return a parser like `seconds` that accepts durations from ``least`` to ``most`` seconds."""

    def parse(text: str | float) -> float:
        value = seconds(text)
        if not least <= value <= most:
            possible = f"{least:g} s or more" if most == math.inf else f"{least:g} to {most:g} s"
            raise typer.BadParameter(f"{text} is out of range: {possible}")
        return value

    return parse
