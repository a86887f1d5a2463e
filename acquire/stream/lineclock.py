"""Which line a camera was reading out at a time of its own clock.

The trigger issues lines at even intervals, and a camera stamps its blocks: from both the interval in the
camera's time follows, and with it how fast the camera's clock runs against the trigger's (its drift). A
camera that was away begins to count at 0 again; its time stamps say where it goes on.
"""

from __future__ import annotations

from dataclasses import dataclass

_FRESH_LINES = 1 << 22
"""Lines after which the measured interval is kept up to date by halves: drift follows temperature."""
_CERTAIN = 0.25
"""Of a line: what is further from a whole line than this is not known."""


@dataclass(frozen=True, slots=True)
class Stamp:
    """The camera's clock at the first line of a block."""

    line: int
    time_ns: int


class LineClock:
    """The straight line through the stamps of one camera.

    Parameters
    ----------
    line_period_ns : by the trigger's clock; 0: not told
    """

    def __init__(self, line_period_ns: float) -> None:
        self._nominal_ns = line_period_ns
        self._first: Stamp | None = None
        self._middle: Stamp | None = None
        self._last: Stamp | None = None
        self._jitter_ns = 0.0

    def take_over(self, line: int, time_ns: int, drift_ppb: int) -> None:
        """Go on for a clock that had noted ``line`` last, and knew the drift."""
        period_ns = self._nominal_ns * (1 + drift_ppb / 1e9)
        # As if a stamp of long ago were known: of the earlier ones only the drift is left.
        self._first = self._middle = Stamp(line - _FRESH_LINES, time_ns - round(_FRESH_LINES * period_ns))
        self._last = Stamp(line, time_ns)

    def note(self, line: int, time_ns: int) -> None:
        """A block that began at ``line``. Stamps come in order."""
        stamp = Stamp(line, time_ns)
        if self._first is None or self._last is None:
            self._first = self._middle = self._last = stamp
            return
        expected = self._last.time_ns + (line - self._last.line) * self.period_ns
        # The worst of the last thousand blocks or so: one late stamp does not count for ever.
        self._jitter_ns = max(abs(time_ns - expected), self._jitter_ns * 0.999)
        self._last = stamp
        assert self._middle is not None
        # Two halves, so that at least one whole half is behind the measured interval at any time.
        if line - self._middle.line > _FRESH_LINES:
            self._first, self._middle = self._middle, stamp

    @property
    def period_ns(self) -> float:
        """A line's duration by the camera's clock: the trigger's until it has been measured."""
        if self._first is None or self._last is None or self._last.line == self._first.line:
            return self._nominal_ns
        return (self._last.time_ns - self._first.time_ns) / (self._last.line - self._first.line)

    @property
    def drift_ppb(self) -> int:
        """How much faster the camera's clock runs than the trigger's, in parts per billion."""
        return round((self.period_ns / self._nominal_ns - 1) * 1e9) if self._nominal_ns else 0

    def line_at(self, time_ns: int) -> int | None:
        """The line that began at a later ``time_ns``; None when it cannot be told for certain."""
        if self._first is None or self._last is None or time_ns <= self._last.time_ns or not self.period_ns:
            return None
        ahead = (time_ns - self._last.time_ns) / self.period_ns
        baseline = max(1, self._last.line - self._first.line)
        doubt = self._jitter_ns / self.period_ns * (1 + ahead / baseline)
        if abs(ahead - round(ahead)) > _CERTAIN or doubt > _CERTAIN:
            return None
        return self._last.line + round(ahead)
