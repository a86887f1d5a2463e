"""From the device's tags to those of a run: counted, checked, on one axis of ticks."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, ClassVar

from acquire.text import counted
from acquire.trigger.base import WATCHDOG, LineTag, TagEvent
from acquire.trigger.registers import TAG_FIELDS, TIME_BITS, TagFlag

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from acquire.trigger.base import TriggerRun
    from acquire.trigger.dialogue import TagArrival

_NUMBERS = 1 << 16
"""The device numbers its tags with 16 bits."""
_RUN_BITS = dict(TAG_FIELDS)["run"]
_WRAP = 1 << TIME_BITS
_MOST_EVENTS = 4096
EVENTS = {
    TagFlag.PPS: "input",
    TagFlag.MISSED_A: "missed_trigger_a",
    TagFlag.MISSED_B: "missed_trigger_b",
    TagFlag.UNEXPECTED_A: "unexpected_strobe_a",
    TagFlag.UNEXPECTED_B: "unexpected_strobe_b",
    TagFlag.WATCHDOG: WATCHDOG,
    TagFlag.CLOCK_LOST: "clock_lost",
    TagFlag.BUDGET: "line_budget",
}
"""Why a tag was sent → the event's name."""


class TagReader:
    """Reads the tags of ``run``, which has ``number`` in the device and began at ``start_tick``.

    It counts ``tags`` received, including those of events; ``tags_missing``, sent by the device but not
    received, except whole turns of 65536 at once; ``tags_repeated``, older than earlier ones; ``tags_wrong``,
    whose code index does not match their line. The latter two are dropped.
    """

    NOTHING: ClassVar[Mapping[str, int]] = {
        "tags": 0,
        "tags_missing": 0,
        "tags_repeated": 0,
        "tags_wrong": 0,
    }

    def __init__(self, run: TriggerRun, number: int, start_tick: int) -> None:
        self.lines_known = 0
        """Number of lines that have certainly begun."""
        self._run, self._number, self._start_tick = run, number % (1 << _RUN_BITS), start_tick
        self._next, self._newest_line = 0, -1
        self._counts = dict(self.NOTHING)
        self._events: deque[TagEvent] = deque(maxlen=_MOST_EVENTS)

    def __str__(self) -> str:
        return f"run {self._run.run_id!r} with {counted(self.lines_known, 'line')}"

    def statistics(self) -> dict[str, int]:
        return dict(self._counts)

    def events(self) -> list[TagEvent]:
        """Return the events among the tags taken since the last call."""
        taken = list(self._events)
        self._events.clear()
        return taken

    def take(self, arrivals: Iterable[TagArrival]) -> list[LineTag]:
        """Return the tags of lines, without those of events and of other runs."""
        found = []
        for number, tag in arrivals:
            if tag.run != self._number:  # of the previous run: it was still on its way in link or queue
                continue
            # Two counters of the device that must agree: a check of the gateware, besides the frame's CRC.
            wrong = tag.code_index != tag.line * self._run.substeps
            # 16-bit numbers wrap: one that seems more than half a turn ahead is behind, unless its line is
            # newer, which means that as many were lost.
            ahead = (number - self._next) % _NUMBERS
            if ahead >= _NUMBERS // 2 and (wrong or tag.line <= self._newest_line):
                self._counts["tags_repeated"] += 1
                continue
            # Also for a wrong one, which has used up its number: it would count as missing as well.
            self._next = (number + 1) % _NUMBERS
            self._counts["tags_missing"] += ahead
            if wrong:
                self._counts["tags_wrong"] += 1
                continue
            self._counts["tags"] += 1
            self._newest_line = max(self._newest_line, tag.line)
            if not tag.flags & TagFlag.NO_LINES:
                self.lines_known = max(self.lines_known, tag.line + 1)
            # The ticks since the start that are nearest to the line's: 48 bits wrap after weeks.
            expected = tag.line * self._run.line_period_ticks
            ticks = expected + signed_ticks(tag.timestamp - self._start_tick - expected)
            self._events += [
                TagEvent(tag.line, ticks, kind) for flag, kind in EVENTS.items() if tag.flags & flag
            ]
            if tag.flags & TagFlag.LINE:
                found.append(LineTag(tag.line, tag.code_index, ticks))
        return found


def signed_ticks(ticks: int) -> int:
    """Return a difference of 48-bit time stamps as the value nearest to 0."""
    return (ticks + _WRAP // 2) % _WRAP - _WRAP // 2
