"""Stalls: when an arm has stalled, when a process shows no life, and when an arm delivers too many lines.

The recorder judges the arms of its recording (silent for too long, or too far behind the other) and itself,
by the blocks that wait in the rings. The supervisor watches counters that must not stand still: the
recorder's always, the arms' while nothing is recorded.
"""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from acquire.lines import ARMS
from acquire.store import RunCondition
from acquire.stream.kept import Kept
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.processes.shared import Counters
    from acquire.stream.ring import Ring
    from acquire.stream.session import Session

T = TypeVar("T")

NEARLY_FULL = 0.9
"""Share of a ring at which the recording is ended, while the rest can still take what comes."""
PATIENCE_SHARE = 8
"""A ring more than half full is judged only after one slot in this many was emptied: it may have filled in a
pause of the recorder."""
HELD_UP_S = 0.25
"""More than a busy host keeps a process waiting. After such a hold-up, messages and tags that came in the
meantime are still unread."""
_LONGEST_LOOK_S = 0.5
"""Longest time between two looks that counts as silence."""


@dataclass(frozen=True, slots=True)
class Stall:
    """The arms that are no longer waited for, and the recording's condition because of it."""

    arms: tuple[str, ...]
    reason: str
    condition: RunCondition


class Backlog:
    """Detects a ring that fills up although it is being emptied; to be asked after every block taken from it.

    A ring that filled in a pause of the recorder empties again, and is no reason to end; so does one that
    begins full, with lines from before. One that is nearly full, and has not emptied since it was first found
    more than half full, will overflow. Everything is counted in blocks, so that it holds at any line rate. A
    ring that overflows before that is detected, because it is short or the pause long, ends the recording as
    well: see `Session.overrun`.
    """

    def __init__(self) -> None:
        self._caught_up = False
        self._first_fill: int | None = None
        self._taken = 0

    def grows(self, fill: int, slots: int) -> bool:
        """Return whether the next blocks would find no slot, when ``fill`` of ``slots`` blocks wait."""
        if 2 * fill < slots:
            self._caught_up, self._first_fill = True, None
            return False
        if self._first_fill is None:
            self._first_fill, self._taken = fill, 0
        self._taken += 1
        if not self._caught_up or self._taken <= max(1, slots // PATIENCE_SHARE):
            return False
        return fill >= max(self._first_fill, NEARLY_FULL * slots)


class DiskWaits:
    """Publishes since when a process's loop, and its second thread, have been waiting for the disk."""

    def __init__(self, counters: Counters) -> None:
        self._counters = counters

    @contextmanager
    def loop(self) -> Iterator[None]:
        """Mark a wait of the loop itself, which shows no other sign of life."""
        with self._publishing("disk_since_ns"):
            yield

    def elsewhere(self, work: Callable[..., T], *args: Any) -> T:
        """Do ``work`` in the second thread, marked as a wait for the disk."""
        with self._publishing("store_since_ns"):
            return work(*args)

    @contextmanager
    def _publishing(self, name: str) -> Iterator[None]:
        self._counters[name] = time.monotonic_ns()
        try:
            yield
        finally:
            self._counters[name] = 0


class HoldUps:
    """When a loop was held up last, and for how long."""

    def __init__(self) -> None:
        self._seen_s = time.monotonic()
        self.over_s = 0.0
        """When the last hold-up was over."""
        self.longest_s = 0.0
        """The longest of the hold-ups that may concern the lines taken now."""

    def update(self) -> None:
        """Note a hold-up since the last call; to be called between any two actions that may take time."""
        now_s = time.monotonic()
        held_s, self._seen_s = now_s - self._seen_s, now_s
        if held_s > HELD_UP_S:
            self.over_s = now_s
            self.longest_s = max(self.longest_s, held_s)

    def took(self, come_s: float) -> None:
        """Lines that came at ``come_s`` were taken: if that is after the last hold-up, it is dealt with."""
        if come_s > self.over_s:
            self.longest_s = 0.0


class ArmView:
    """The recorder's view of a ring: its last sign of life, its backlog, the block being written, and the
    lines that recordings hold already.
    """

    def __init__(self, ring: Ring) -> None:
        self.ring = ring
        self.backlog = Backlog()
        self.lent: range | None = None
        """The lines of the block that may still be on its way to the disk."""
        self.kept = Kept()
        self.alive_s = time.monotonic()
        self._newest = ring.newest_line
        self._awaited = 0

    def watch(self, now_s: float, awaited: int = 0) -> None:
        """Note a sign of life: a new line, a block that waits to be taken, or a growing ``awaited``."""
        newest = self.ring.newest_line
        if newest != self._newest or self.ring.fill or awaited != self._awaited:
            self._newest, self._awaited = newest, awaited
            self.alive_s = now_s

    def revive(self, now_s: float) -> None:
        """Measure silence from now on."""
        self.alive_s = now_s


class Heartbeat:
    """Measures for how long a counter of another process has stood still."""

    def __init__(self, counters: Counters, name: str) -> None:
        self._counters = counters
        self._name = name
        self._count = counters[name]
        self._looked_s = time.monotonic()
        self.still_s = 0.0

    def update(self, now_s: float) -> float:
        """Return the seconds without a beat; time between two calls counts up to `_LONGEST_LOOK_S`."""
        # A host that did not let *us* run for seconds has probably stopped the other process as well.
        self.still_s += min(now_s - self._looked_s, _LONGEST_LOOK_S)
        self._looked_s = now_s
        if (count := self._counters[self._name]) != self._count:
            self._count = count
            self.still_s = 0.0
        return self.still_s

    def revive(self) -> None:
        """Measure silence from now on."""
        self.still_s = 0.0


class Excess:
    """Detects an arm that counts lines which the trigger has not issued, and so is not triggered by it.

    Tags come in steps and late, on a busy host by seconds: only an excess of more than ``margin_lines`` for
    longer than ``limit_s`` counts. A host that did not let this process run for seconds leaves it behind with
    the tags: time between two calls counts up to `_LONGEST_LOOK_S`.
    """

    def __init__(self, counters: Counters, margin_lines: int, limit_s: float) -> None:
        self._counters = counters
        self._margin_lines = margin_lines
        self._limit_s = limit_s
        self._looked_s = time.monotonic()
        self._ahead_s = 0.0

    def update(self, newest_pulse: int, now_s: float) -> int:
        """Return the arm's next line if it is impossible, else 0; ``newest_pulse``: the latest tag's line."""
        self._ahead_s += min(now_s - self._looked_s, _LONGEST_LOOK_S)
        self._looked_s = now_s
        line = self._counters["next_line"]
        if line <= newest_pulse + self._margin_lines:
            self._ahead_s = 0.0
        return line if self._ahead_s > self._limit_s else 0


def find_stall(
    session: Session, arms: dict[str, ArmView], looked_s: float, limit_s: float, max_skew_lines: int
) -> Stall | None:
    """Return the stall that ends the recording, or None; arms given up already do not count again.

    ``looked_s``: the time before the arms were looked at last. A process that was stopped after that look
    does not know what came since, and must not take its own pause for the arms' silence.
    """
    waited_for = [name for name in ARMS if not session.reached(name) and name not in session.lost]
    if not waited_for:
        return None
    silent_s = {name: looked_s - arm.alive_s for name, arm in arms.items()}
    if any(silent_s[name] > limit_s for name in waited_for):
        # Arms that fall silent together do so to within a block: half the limit distinguishes both from one.
        silent = tuple(name for name in ARMS if silent_s[name] > limit_s / 2)
        return _stall(silent, f"no line for {limit_s:g} s")
    # An arm may deliver and never catch up: all rows that it lacks would be written in one go at the end.
    if session.skew > max_skew_lines:
        late = min(waited_for, key=lambda name: session.books[name].next_line)
        return _stall((late,), f"{counted(session.skew, 'line')} behind the other")
    return None


def _stall(arms: tuple[str, ...], text: str) -> Stall:
    # Both at once point to the trigger or the host: the arms have the same lines, and the recording only
    # ended early.
    if len(arms) == len(ARMS):
        return Stall(arms, f"both arms stalled: {text}", RunCondition.INTERRUPTED)
    return Stall(arms, f"arm {arms[0]} stalled: {text}", RunCondition.INCOMPLETE)
