"""The trigger's part of an armed run: its tags go to the recorder, its events and counts to other readers."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from acquire.errors import AcquireError, DeviceError
from acquire.stream.external_counts import TRIGGER_COUNTERS
from acquire.stream.messages import Note
from acquire.stream.tagger import tag_rows
from acquire.trigger.base import WATCHDOG

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.processes.shared import Counters
    from acquire.stream.ring import Ring
    from acquire.trigger.base import LineTag, Trigger

# Queries share the trigger's link with its tags.
_QUERY_EVERY_S = 1.0


class TagFeed:
    """Takes tags, events and counts from the trigger, in one thread; its findings can be read in any.

    ``report`` is called with every event, ``fail`` with the reason why the trigger can no longer be used.

    Attributes
    ----------
    newest_pulse : the latest line with a tag; None before the first one
    heard_s : monotonic time of the latest tag, or answer to a query
    """

    def __init__(
        self,
        trigger: Trigger,
        tags: Ring,
        counters: Counters,
        *,
        report: Callable[[Note], None],
        fail: Callable[[str], None],
    ) -> None:
        self._trigger, self._tags, self._counters = trigger, tags, counters
        self._report, self._fail = report, fail
        self.newest_pulse: int | None = None
        self.heard_s = time.monotonic()
        self._query_s = 0.0
        self._lost = False

    def take(self, wait_s: float) -> list[LineTag]:
        """Wait ``wait_s`` for tags, and pass them and the events on; return the tags."""
        if self._lost:
            return []
        try:
            tags, events = self._trigger.tags(wait_s), self._trigger.events()
        except Exception as error:  # noqa: BLE001 - a fault; a driver's defect must not cost the recording
            self._give_up(error)
            return []
        if tags:
            self.newest_pulse = tags[-1].line
            self.heard_s = time.monotonic()
        for event in events:
            self._report(Note(event.line, event.kind, f"tick {event.tick}"))
            if event.kind == WATCHDOG:  # no line comes any more: a recording that began now would be empty
                self._lost = True
                self._fail(
                    f"trigger: its watchdog ended the run at line {event.line}, "
                    "since this host had given no sign of life for too long"
                )
        rows = self._tags.shape.rows
        for at in range(0, len(tags), rows):
            some = tags[at : at + rows]
            slot = self._tags.claim(0, len(some))  # the rows are tags, and have no line numbers
            if slot is None:
                # The recorder is late. Do not wait for it: later tags confirm the same lines.
                self._tags.drop(some[0].line, len(some))
                continue
            slot.pixels[:] = tag_rows(some)
            self._tags.commit(slot)
        return tags

    def query(self, now_s: float) -> None:
        """Publish the trigger's counts, if the latest ones are older than `_QUERY_EVERY_S`."""
        if self._lost or now_s < self._query_s:
            return
        self._query_s = now_s + _QUERY_EVERY_S
        try:
            counts = self._trigger.statistics()
        except DeviceError:
            return  # a trigger that cannot answer fails in `take`, which reports it
        except AcquireError as error:  # it answers, but with something else
            self._give_up(error)
            return
        for name in TRIGGER_COUNTERS:
            self._counters[name] = int(counts.get(name, 0))
        if "link_lost" not in counts:
            self.heard_s = time.monotonic()

    def _give_up(self, error: Exception) -> None:
        self._lost = True
        kind = "" if isinstance(error, AcquireError) else f"{type(error).__name__}: "
        self._fail(f"trigger: {kind}{error}")
