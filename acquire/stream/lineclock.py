"""Finds the line that a camera was reading out at a time of its own clock.

The trigger issues lines at even intervals, and a camera stamps its blocks. From both follows the line
interval in the camera's time, and how much faster the camera's clock runs than the trigger's (its drift). A
camera that was away counts from 0 again; its time stamps show with which line it continues.
"""

from __future__ import annotations

from dataclasses import dataclass

_FRESH_LINES = 1 << 22
"""Lines after which the older half of the measurement is dropped, since drift follows temperature."""
_CERTAIN = 0.25
"""Largest distance from a whole line, and largest uncertainty, in lines, at which a line is certain."""


@dataclass(frozen=True, slots=True)
class Stamp:
    """The camera's clock at the first line of a block."""

    line: int
    time_ns: int


class LineClock:
    """The straight line through the stamps of one camera.

    Parameters
    ----------
    line_period_ns : line period by the trigger's clock; 0: unknown
    """

    def __init__(self, line_period_ns: float) -> None:
        self._nominal_ns = line_period_ns
        self._first: Stamp | None = None
        self._middle: Stamp | None = None
        self._last: Stamp | None = None
        self._jitter_ns = 0.0

    def take_over(self, line: int, time_ns: int, drift_ppb: int) -> None:
        """Continue from a clock whose latest stamp and drift are known."""
        period_ns = self._nominal_ns * (1 + drift_ppb / 1e9)
        # A made-up stamp of long ago stands for the earlier ones, of which only the drift is left.
        self._first = self._middle = Stamp(line - _FRESH_LINES, time_ns - round(_FRESH_LINES * period_ns))
        self._last = Stamp(line, time_ns)

    def note(self, line: int, time_ns: int) -> None:
        """Add the stamp of a block that began at ``line``. Stamps come in order."""
        stamp = Stamp(line, time_ns)
        if self._first is None or self._last is None:
            self._first = self._middle = self._last = stamp
            return
        expected = self._last.time_ns + (line - self._last.line) * self.period_ns
        # The largest error of about the last thousand blocks: one late stamp does not count for ever.
        self._jitter_ns = max(abs(time_ns - expected), self._jitter_ns * 0.999)
        self._last = stamp
        assert self._middle is not None
        # Two halves, so that at least one whole half is behind the measured interval at any time.
        if line - self._middle.line > _FRESH_LINES:
            self._first, self._middle = self._middle, stamp

    @property
    def period_ns(self) -> float:
        """Line period by the camera's clock; the trigger's until it has been measured."""
        if self._first is None or self._last is None or self._last.line == self._first.line:
            return self._nominal_ns
        return (self._last.time_ns - self._first.time_ns) / (self._last.line - self._first.line)

    @property
    def drift_ppb(self) -> int:
        """How much faster the camera's clock runs than the trigger's, in parts per billion."""
        return round((self.period_ns / self._nominal_ns - 1) * 1e9) if self._nominal_ns else 0

    def line_at(self, time_ns: int) -> int | None:
        """Return the line that began at ``time_ns``, after the latest stamp; None if it is not certain."""
        if self._first is None or self._last is None or time_ns <= self._last.time_ns or not self.period_ns:
            return None
        ahead = (time_ns - self._last.time_ns) / self.period_ns
        baseline = max(1, self._last.line - self._first.line)
        uncertainty = self._jitter_ns / self.period_ns * (1 + ahead / baseline)
        if abs(ahead - round(ahead)) > _CERTAIN or uncertainty > _CERTAIN:
            return None
        return self._last.line + round(ahead)
