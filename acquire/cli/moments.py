"""Moments in a recording or a video on the command line: a time after its start, UTC, or a line number."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from acquire.cli.durations import UNITS_NS, parse_duration_ns
from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

# Python refuses to convert thousands of digits, and a float those of more than 308.
_LINE = re.compile(r"\s*[Ll](\d{1,18})\s*")


def line_number(text: str) -> int | None:
    """Return 5000 for ``L5000``; None for other text."""
    found = _LINE.fullmatch(text)
    return None if found is None else int(found[1])


def utc_ns(text: str) -> int | None:
    """Parse UTC in ISO 8601 to ns since 1970; None for other text."""
    try:
        moment = None if text.isdigit() else datetime.fromisoformat(text)
    except ValueError:
        return None
    if moment is None:
        return None  # 20260131 is a number of seconds, like every bare number
    # In whole numbers: a float of seconds since 1970 is exact to 0.2 us only.
    since = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)) - datetime.fromtimestamp(0, UTC)
    return (since.days * 86_400 + since.seconds) * UNITS_NS["s"] + since.microseconds * UNITS_NS["us"]


def after_ns(
    text: str | None, begin_ns: Callable[[], int], line_ns: Callable[[int], int] | None = None
) -> int | None:
    """Parse a moment to nanoseconds after the beginning; None stays None.

    ``begin_ns()``, the UTC of the beginning, is called only if the text is UTC. ``line_ns`` returns the time
    of a line after the beginning; it is absent for a video, which has no lines. Raises UsageError.
    """
    if text is None:
        return None
    line = line_number(text)
    if line is not None:
        if line_ns is None:
            raise UsageError(
                f"{text} is a line, but a video has frames",
                possible="a time after the first frame, such as 52ms, or UTC",
            )
        return line_ns(line)
    moment = utc_ns(text)
    return parse_duration_ns(text) if moment is None else moment - begin_ns()
