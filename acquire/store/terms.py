"""Terms of a recording that are fixed before it begins: which lines are kept, and what it continues."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from acquire.errors import UsageError

ALL_LINES = 2**62
"""Count of a hold that has no end."""


@dataclass(frozen=True, slots=True)
class Retention:
    """Which lines of an endless recording are kept. Raises UsageError for impossible terms.

    Attributes
    ----------
    max_bytes : bytes of the disk that the recording may take; None: no limit
    max_age_lines : number of newest lines that are kept; None: all
    margin_lines : lines kept on either side of a held range, and before the newest line, whatever the limits:
        M + L_R
    hold_events : kinds of events that hold lines
    hold_lines : lines held before and after such an event
    copied_to : URL below which the recording is copied while it grows: no line is dropped before it is
        there, or before the copy has begun
    """

    max_bytes: int | None = None
    max_age_lines: int | None = None
    margin_lines: int = 4096
    hold_events: tuple[str, ...] = ("mark",)
    hold_lines: tuple[int, int] = (2**16, 2**16)
    copied_to: str | None = None

    def __post_init__(self) -> None:
        numbers = (self.max_bytes or 1, self.max_age_lines or 1, self.margin_lines + 1, *self.hold_lines)
        if min(numbers) < 0 or 0 in (self.max_bytes, self.max_age_lines, self.margin_lines + 1):
            raise UsageError(f"the terms of retention are impossible: {self}", possible="numbers above 0")


@dataclass(frozen=True, slots=True)
class Continuation:
    """What a segment continues.

    Attributes
    ----------
    first : name of the run's first recording, in the same directory
    number : number of the segment; the first recording is 1
    end_line, end_ns : line after the last one before the outage, and when that was read out
    cause : why there was an outage
    listed : list the segment in the first recording as soon as it has begun; otherwise the recovery of the
        first recording does that
    """

    first: str
    number: int
    end_line: int
    end_ns: int | None
    cause: str
    listed: bool = True

    def to_attrs(self, first_line: int, start_ns: int) -> dict[str, Any]:
        """Return the attribute ``segment`` of the root, once its first line is known."""
        lost = first_line - self.end_line
        outage = {
            "after_line": self.end_line - 1,
            "lines": lost if lost >= 0 else None,
            "from_ns": self.end_ns,
            "to_ns": start_ns,
            "cause": self.cause,
        }
        return {"number": self.number, "of": self.first, "outage": outage}
