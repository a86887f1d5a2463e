"""Which lines of one arm are in recordings already, so that a line that is in two of them is counted once.

A recording may begin with lines from the ring's history that another one has stored. One range per recording
suffices: a line inside it that was lost never comes from the ring again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


class Kept:
    """The latest recording's range comes last; earlier ones are kept while the ring may hold their lines."""

    def __init__(self, ranges: Iterable[tuple[int, int]] = ()) -> None:
        self._ranges = list(ranges)

    def begin(self, oldest_line: int) -> None:
        """Begin a recording; lines before ``oldest_line`` cannot be recorded any more."""
        self._ranges = [(first, end) for first, end in self._ranges if end > oldest_line]
        self._ranges.append((oldest_line, oldest_line))

    def add(self, first: int, end: int) -> None:
        """Add ``first .. end - 1`` to the recording; calls come in the order of the lines."""
        begun, reached = self._ranges[-1]
        # A range that is still empty begins with the first line added, not where `begin` would have let it.
        self._ranges[-1] = (begun if reached > begun else first), end

    def end_at(self, line: int) -> None:
        """End the recording before ``line``, whatever was added."""
        begun, reached = self._ranges[-1]
        if reached > begun:
            self._ranges[-1] = begun, max(begun, line)

    def count(self, first: int, end: int) -> int:
        """Return how many of the lines ``first .. end - 1`` are in recordings."""
        held = 0
        for start, stop in sorted(self._ranges):
            lines = range(max(start, first), min(stop, end))
            if lines:
                held += len(lines)
                first = lines.stop  # ranges overlap if a recording began with lines of an earlier one
        return held
