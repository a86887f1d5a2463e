"""Times inside a recording or a video, on the command line: after its beginning, or UTC."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

NS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}


def parse_duration_ns(text: str) -> int:
    """``52ms``, ``0.052 s``, ``300us``."""
    found = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*(ns|us|ms|s)", text)
    if found is None:
        raise UsageError(
            f"time {text!r} cannot be read", possible="52ms, 0.052s, 300us, or UTC as 2026-01-31T12:00:00"
        )
    return round(float(found[1]) * NS[found[2]])


def utc_ns(text: str) -> int | None:
    """UTC as ISO 8601 writes it, in ns since 1970; None for text that is no such time."""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return None
    since = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)) - datetime.fromtimestamp(0, UTC)
    return (since.days * 86_400 + since.seconds) * NS["s"] + since.microseconds * NS["us"]


def after_ns(text: str | None, begin_ns: Callable[[], int]) -> int | None:
    """A time as nanoseconds after ``begin_ns()``, which is asked only where the text is UTC; None of None."""
    if text is None:
        return None
    moment = utc_ns(text)
    return parse_duration_ns(text) if moment is None else moment - begin_ns()
