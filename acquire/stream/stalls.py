"""Silence: when an arm counts as stalled, and when a process shows no life. And its opposite, too much.

The recorder judges the arms of its recording: silent for too long, or too far behind the other; and itself,
by what waits in the rings. The supervisor judges by counters that must not stand still: the recorder always,
the arms while nothing is recorded.
"""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from acquire.lines import ARMS
from acquire.store import RunCondition
from acquire.stream.kept import Kept

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.processes.shared import Counters
    from acquire.stream.ring import Ring
    from acquire.stream.session import Session

T = TypeVar("T")

NEARLY_FULL = 0.9
"""Of a ring: the recording is ended while the rest can still take what comes."""
PATIENCE_SHARE = 8
"""A ring that is more than half full says nothing before one part in so many of its slots was emptied: it may
have leapt there in a pause."""
HELD_UP_S = 0.25
"""More than a busy host keeps a process waiting: what others said meanwhile has still to be heard."""
_LONGEST_LOOK_S = 0.5


@dataclass(frozen=True, slots=True)
class Stall:
    """Which arms will not be waited for any more, and what that makes of the recording."""

    arms: tuple[str, ...]
    reason: str
    condition: RunCondition


class Backlog:
    """Whether a ring fills up although it is being emptied: asked after every block that was taken from it.

    A ring that leapt to full in a pause empties, and costs nothing more; so does one that begins full, with
    what was before. One that is nearly full, and has not emptied since it was first seen more than half full,
    will overflow. All is counted in blocks, so that it holds at any rate. A ring that overflows before that
    is seen, since it is short or the pause long, ends the recording as well: see `Session.overrun`.
    """

    def __init__(self) -> None:
        self._caught_up = False
        self._first_fill: int | None = None
        self._taken = 0

    def grows(self, fill: int, slots: int) -> bool:
        """The next blocks would find no slot; ``fill`` of ``slots`` wait."""
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
    """Publishes since when the disk is waited for: by a process's loop, and by a thread beside it."""

    def __init__(self, counters: Counters) -> None:
        self._counters = counters

    @contextmanager
    def loop(self) -> Iterator[None]:
        """The loop itself waits, and shows no other life."""
        with self._publishing("disk_since_ns"):
            yield

    def elsewhere(self, work: Callable[..., T], *args: Any) -> T:
        """Do what another thread was given."""
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
        """Of those that may have to do with the lines which are taken now."""

    def update(self) -> None:
        """To be called between any two things that may take time."""
        now_s = time.monotonic()
        held_s, self._seen_s = now_s - self._seen_s, now_s
        if held_s > HELD_UP_S:
            self.over_s = now_s
            self.longest_s = max(self.longest_s, held_s)

    def took(self, come_s: float) -> None:
        """Lines were taken that had come at this moment: those that came in hold-ups before are done with."""
        if come_s > self.over_s:
            self.longest_s = 0.0


@dataclass(frozen=True, slots=True)
class Lent:
    """The lines of a block that may still be on its way to the disk."""

    first_line: int
    end_line: int


class Arm:
    """A ring as the recorder sees it: when it last showed life, what waits in it, what is being written, and
    what recordings hold of its lines.
    """

    def __init__(self, ring: Ring) -> None:
        self.ring = ring
        self.backlog = Backlog()
        self.lent: Lent | None = None
        self.kept = Kept()
        self.alive_s = time.monotonic()
        self._newest = ring.newest_line
        self._awaited = 0

    def watch(self, now_s: float, awaited: int = 0) -> None:
        """Note life: something new, something that still waits to be taken, or that ``awaited`` has grown."""
        newest = self.ring.newest_line
        if newest != self._newest or self.ring.fill or awaited != self._awaited:
            self._newest, self._awaited = newest, awaited
            self.alive_s = now_s

    def revive(self, now_s: float) -> None:
        """Count silence from now."""
        self.alive_s = now_s


class Heartbeat:
    """A counter of another process, for how long it has stood still."""

    def __init__(self, counters: Counters, name: str) -> None:
        self._counters = counters
        self._name = name
        self._count = counters[name]
        self._looked_s = time.monotonic()
        self.still_s = 0.0

    def update(self, now_s: float) -> float:
        """Seconds without a beat; of a time between two looks, only so much as a look can take counts."""
        # A host that did not let *us* run for seconds has probably stopped the other one as well.
        self.still_s += min(now_s - self._looked_s, _LONGEST_LOOK_S)
        self._looked_s = now_s
        if (count := self._counters[self._name]) != self._count:
            self._count = count
            self.still_s = 0.0
        return self.still_s

    def revive(self) -> None:
        """Count silence from now."""
        self.still_s = 0.0


class Excess:
    """An arm that counts lines which the trigger has not issued is not triggered by it.

    Tags come in steps and late, on a busy host by seconds: only what exceeds them by ``margin_lines`` for
    longer than ``limit_s`` counts.
    """

    def __init__(self, counters: Counters, margin_lines: int, limit_s: float) -> None:
        self._counters = counters
        self._margin_lines = margin_lines
        self._limit_s = limit_s
        self._since_s: float | None = None

    def update(self, newest_pulse: int, now_s: float) -> int:
        """The arm's next line when it cannot be, else 0; ``newest_pulse`` is the latest tag's."""
        line = self._counters["next_line"]
        if line <= newest_pulse + self._margin_lines:
            self._since_s = None
            return 0
        self._since_s = self._since_s or now_s
        return line if now_s - self._since_s > self._limit_s else 0


def find_stall(session: Session, arms: dict[str, Arm], limit_s: float, max_skew_lines: int) -> Stall | None:
    """The stall that ends the recording, or None; arms that are given up already do not count again."""
    waited_for = [name for name in ARMS if not session.reached(name) and name not in session.lost]
    if not waited_for:
        return None
    now_s = time.monotonic()
    silent_s = {name: now_s - arm.alive_s for name, arm in arms.items()}
    if any(silent_s[name] > limit_s for name in waited_for):
        # Arms that fall silent together do so to within a block: half the limit tells both from one.
        silent = tuple(name for name in ARMS if silent_s[name] > limit_s / 2)
        return _stall(silent, f"no line for {limit_s:g} s")
    # An arm may deliver, and never catch up: the rows that it lacks would be written in one go at the end.
    if session.skew > max_skew_lines:
        late = min(waited_for, key=lambda name: session.books[name].next_line)
        return _stall((late,), f"{session.skew} lines behind the other")
    return None


def _stall(arms: tuple[str, ...], text: str) -> Stall:
    # Both at once is the trigger's, or the host's: nothing is missing between the arms, it only ended early.
    if len(arms) == len(ARMS):
        return Stall(arms, f"both arms stalled: {text}", RunCondition.INTERRUPTED)
    return Stall(arms, f"arm {arms[0]} stalled: {text}", RunCondition.INCOMPLETE)
