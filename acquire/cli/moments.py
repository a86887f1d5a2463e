"""Moments inside a recording or a video, on the command line: after its beginning, UTC, or a line's."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from acquire.cli.durations import UNITS_NS, parse_duration_ns
from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

_LINE = re.compile(r"\s*[Ll](\d+)\s*")


def line_number(text: str) -> int | None:
    """5000 of ``L5000``; None for text that names no line."""
    found = _LINE.fullmatch(text)
    return None if found is None else int(found[1])


def utc_ns(text: str) -> int | None:
    """UTC as ISO 8601 writes it, in ns since 1970; None for text that is no such time."""
    try:
        moment = None if text.isdigit() else datetime.fromisoformat(text)
    except ValueError:
        return None
    if moment is None:
        return None  # 20260131 is seconds, as every bare number
    since = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)) - datetime.fromtimestamp(0, UTC)
    return (since.days * 86_400 + since.seconds) * UNITS_NS["s"] + since.microseconds * UNITS_NS["us"]


def after_ns(
    text: str | None, begin_ns: Callable[[], int], line_ns: Callable[[int], int] | None = None
) -> int | None:
    """A moment as nanoseconds after ``begin_ns()``, which is asked only where the text is UTC; None of None.

    ``line_ns`` says how long after the beginning a line is; where there are no lines, it is absent.
    """
    if text is None:
        return None
    line = line_number(text)
    if line is not None:
        if line_ns is None:
            raise UsageError(
                f"{text} names a line, and a video has frames", possible="52ms after the first, or UTC"
            )
        return line_ns(line)
    moment = utc_ns(text)
    return parse_duration_ns(text) if moment is None else moment - begin_ns()
