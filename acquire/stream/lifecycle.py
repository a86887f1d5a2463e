"""The life of the latest recording, as seen by the recorder's owner: a table of (stage, event) → stage.

::

              BEGIN            BEGAN              SEALED
      none ─────────▶ asked ───────────▶ recording ─────▶ sealed ── BEGIN ─▶ asked
       ▲ REFUSED │      │ OVERDUE          │  ▲  │ DIED         ▲
       └─────────┘      ▼         KILLED   │  │  ▼              │ END, FAULT
                    cancelled     DISK_END ▼  │ lost            │
                                  replaced, paused ─────────────┘ (paused only; also OVER)

It has no thread and no clock, and sends no messages: times are passed in, and messages for the recorder are
returned. An event that cannot happen, or a command that makes no sense, has no row.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from enum import StrEnum
from typing import TYPE_CHECKING

from acquire.errors import DeviceError, StateError
from acquire.lines import ARMS
from acquire.stream.messages import End, Extend, Refused
from acquire.stream.succession import Orphan, Resumption, continuation, once_more, resumed

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from acquire.stream.messages import Began, Begin, Note, Sealed

_MOST_NOTES = 1024
_MOST_KEPT = 256
"""Number of recordings whose line ranges are remembered: more than a ring can hold lines of."""


class Stage(StrEnum):
    """Stage of the latest recording's life."""

    NONE = "none"
    ASKED = "asked"
    CANCELLED = "cancelled"
    RECORDING = "recording"
    REPLACED = "replaced"
    PAUSED = "paused"
    SEALED = "sealed"
    LOST = "lost"


MEANINGS = {
    Stage.NONE: "nothing has been recorded",
    Stage.ASKED: "a recording is being created",
    Stage.CANCELLED: "the recording was cancelled because the disk took too long to create it",
    Stage.RECORDING: "a recording is being written",
    Stage.REPLACED: "the recorder was killed; another one continues the recording in a new segment",
    Stage.PAUSED: "the recording will continue in a further segment once the disk allows it",
    Stage.SEALED: "the recording is closed",
    Stage.LOST: "the recorder ended without sealing the recording, which can be recovered",
}
"""Texts for refusals and for the status."""

ADVICE = {
    Stage.NONE: "start a recording first",
    Stage.ASKED: "wait until it has begun (acquire status shows it), or disarm",
    Stage.CANCELLED: "start another one; acquire bench measures the disk",
    Stage.RECORDING: "stop it first",
    Stage.REPLACED: "stop it first",
    Stage.PAUSED: "stop it first",
    Stage.SEALED: "start another one",
    Stage.LOST: "disarm, and arm again; acquire recover seals the recording",
}
"""What to try where a start or a stop is refused."""

UNDER_WAY = frozenset({Stage.RECORDING, Stage.REPLACED, Stage.PAUSED})
"""Stages in which a recording is open, or will be continued."""


class Event(StrEnum):
    """Events in a recording's life. BEGIN and END are commands."""

    BEGIN = "start"
    END = "stop"
    BEGAN = "began"
    REFUSED = "refused"
    OVERDUE = "overdue"
    """The recorder has not answered in time."""
    KILLED = "killed"
    """The recorder was killed, and another process took its place."""
    DIED = "died"
    """The recorder died, and has no successor."""
    DISK_END = "ended by the disk"
    """The recorder sealed what it had, and continues as soon as the disk allows."""
    OVER = "over"
    """The line at which the recording was to end came before the disk allowed a further segment."""
    SEALED = "sealed"
    FAULT = "fault"
    """The capture has failed, or is closed: a recording that has not begun is cancelled."""


TABLE: dict[tuple[Stage, Event], Stage] = {
    (Stage.NONE, Event.BEGIN): Stage.ASKED,
    (Stage.NONE, Event.KILLED): Stage.NONE,
    (Stage.NONE, Event.DIED): Stage.NONE,
    (Stage.NONE, Event.FAULT): Stage.NONE,
    (Stage.ASKED, Event.BEGAN): Stage.RECORDING,
    (Stage.ASKED, Event.REFUSED): Stage.NONE,
    (Stage.ASKED, Event.OVERDUE): Stage.CANCELLED,
    (Stage.ASKED, Event.KILLED): Stage.NONE,
    (Stage.ASKED, Event.DIED): Stage.NONE,
    (Stage.ASKED, Event.FAULT): Stage.CANCELLED,
    # The recorder does not answer for a cancelled recording, unless its answer was on the way already.
    (Stage.CANCELLED, Event.BEGIN): Stage.ASKED,
    (Stage.CANCELLED, Event.BEGAN): Stage.RECORDING,
    (Stage.CANCELLED, Event.REFUSED): Stage.NONE,
    (Stage.CANCELLED, Event.KILLED): Stage.NONE,
    (Stage.CANCELLED, Event.DIED): Stage.NONE,
    (Stage.CANCELLED, Event.FAULT): Stage.CANCELLED,
    (Stage.RECORDING, Event.END): Stage.RECORDING,
    (Stage.RECORDING, Event.REFUSED): Stage.RECORDING,  # the late answer to a start that was given up
    (Stage.RECORDING, Event.KILLED): Stage.REPLACED,
    (Stage.RECORDING, Event.DIED): Stage.LOST,
    (Stage.RECORDING, Event.DISK_END): Stage.PAUSED,
    (Stage.RECORDING, Event.SEALED): Stage.SEALED,
    (Stage.RECORDING, Event.FAULT): Stage.RECORDING,
    (Stage.REPLACED, Event.END): Stage.REPLACED,
    (Stage.REPLACED, Event.BEGAN): Stage.RECORDING,
    (Stage.REPLACED, Event.REFUSED): Stage.LOST,
    (Stage.REPLACED, Event.KILLED): Stage.REPLACED,
    (Stage.REPLACED, Event.DIED): Stage.LOST,
    (Stage.REPLACED, Event.FAULT): Stage.REPLACED,
    (Stage.PAUSED, Event.END): Stage.SEALED,
    (Stage.PAUSED, Event.BEGAN): Stage.RECORDING,
    (Stage.PAUSED, Event.REFUSED): Stage.PAUSED,
    (Stage.PAUSED, Event.KILLED): Stage.PAUSED,
    (Stage.PAUSED, Event.DIED): Stage.SEALED,
    (Stage.PAUSED, Event.OVER): Stage.SEALED,
    (Stage.PAUSED, Event.FAULT): Stage.SEALED,
    # A further segment that was cancelled may have begun, or been refused, before the recorder heard of it.
    (Stage.SEALED, Event.BEGIN): Stage.ASKED,
    (Stage.SEALED, Event.END): Stage.SEALED,
    (Stage.SEALED, Event.BEGAN): Stage.RECORDING,
    (Stage.SEALED, Event.REFUSED): Stage.SEALED,
    (Stage.SEALED, Event.KILLED): Stage.SEALED,
    (Stage.SEALED, Event.DIED): Stage.SEALED,
    (Stage.SEALED, Event.FAULT): Stage.SEALED,
    (Stage.LOST, Event.END): Stage.LOST,
    (Stage.LOST, Event.KILLED): Stage.LOST,
    (Stage.LOST, Event.DIED): Stage.LOST,
    (Stage.LOST, Event.FAULT): Stage.LOST,
}


def after(stage: Stage, event: Event) -> Stage:
    """Return the stage that ``event`` leads to. Raises StateError if the table has no row for it."""
    try:
        return TABLE[stage, event]
    except KeyError:
        raise refusal(stage, event) from None


def refusal(stage: Stage, event: Event) -> StateError:
    """Return the error for an event that has no row in the table, with what is possible instead."""
    others = ", ".join(other for other in (Event.BEGIN, Event.END) if (stage, other) in TABLE)
    # What the recorder reports is nobody's command: whoever reads of it can only begin anew.
    hint = ADVICE[stage] if event in (Event.BEGIN, Event.END) else "disarm, and arm again"
    return StateError(f"{event}: {MEANINGS[stage]}", possible=others, hint=hint)


class Lifecycle:
    """The latest recording of an armed run. Not thread-safe: its owner guards it.

    Attributes
    ----------
    stage : where it is in its life
    began : the recorder's answer to the latest `Begin`, unless that was refused
    sealed : how the recording ended
    refused : why it was not begun
    path : path of ``began``: the latest segment's if the recording continued in another one
    resumption : when a recording that the disk has ended continues, and why it has not yet
    notes : recent notes sent to the recorder, which may die before it has written them
    """

    def __init__(self, *, continues: bool) -> None:
        self.stage = Stage.NONE
        self.began: Began | None = None
        self.sealed: Sealed | None = None
        self.refused: Refused | None = None
        self.path: Path | None = None
        self.resumption = Resumption()
        self.notes: deque[Note] = deque(maxlen=_MOST_NOTES)
        self._continues = continues
        self._begin: Begin | None = None
        self._end_reason: str | None = None
        self._failed = False
        self._cut_short: Sealed | None = None
        self._orphans: list[Orphan] = []
        self._kept: dict[str, deque[tuple[int, int]]] = {arm: deque(maxlen=_MOST_KEPT) for arm in ARMS}

    @property
    def orphans(self) -> tuple[Orphan, ...]:
        """Recordings that were not sealed."""
        # None while a successor is only starting: recovering them would compete with it for the disk.
        return () if self.stage is Stage.REPLACED else tuple(self._orphans)

    def kept(self, arm: str, released_line: int) -> list[tuple[int, int]]:
        """Return the ranges of the arm's lines in recordings, the current one up to ``released_line``."""
        ranges = list(self._kept[arm])
        if self.began is not None and self.stage in (Stage.RECORDING, Stage.REPLACED, Stage.LOST):
            ranges.append((self.began.first_line, max(self.began.first_line, released_line)))
        return ranges

    # ---- commands

    def begin(self, begin: Begin) -> None:
        """Note that a recording was requested of the recorder. Raises StateError while there is one."""
        self._go(Event.BEGIN)
        self.began = self.sealed = self.refused = self._cut_short = self._end_reason = None
        self.resumption = Resumption()
        self._begin = begin

    def end(self, reason: str) -> bool:
        """End the recording. Return whether a further segment that is only starting must be cancelled."""
        was = self._go(Event.END)
        self._end_reason = reason
        return self._close_pause(was)

    def extend(self, line: int) -> None:
        """Do not end before ``line``, in whichever segment that is."""
        if self.began is None or self.began.end_line is None:
            return
        self.began = replace(self.began, end_line=max(line, self.began.end_line))
        if self.stage is Stage.PAUSED and self._begin is not None:
            self._begin = replace(self._begin, end_line=self.began.end_line)

    # ---- the recorder's messages

    def on_began(self, began: Began, now_s: float) -> End | Extend | None:
        """Note that the recording exists. Return the command that it missed while it was being created."""
        self._go(Event.BEGAN)
        assert self._begin is not None
        before, self.began, self.sealed, self._cut_short = self.began, began, None, None
        self.path = self._begin.path
        self.resumption.began(now_s)
        if self._end_reason is not None:
            return End(self._end_reason)
        # The end is the one that was known when the segment was requested; it may have been put off since.
        wanted = before.end_line if before is not None else None
        if wanted is None or began.end_line is None or wanted <= began.end_line:
            return None
        self.began = replace(began, end_line=wanted)
        return Extend(wanted)

    def on_refused(self, refused: Refused, now_s: float) -> bool:
        """Note that it, or its further segment, was refused. Return whether the recording is lost by that."""
        was = self._go(Event.REFUSED)
        if was is Stage.ASKED:
            self.refused = refused
        elif was is Stage.PAUSED:
            self.resumption.ended(now_s, refused.error.message)
        elif was is Stage.REPLACED:
            self._begin = None  # nothing of it was made
        return self.stage is Stage.LOST

    def on_sealed(self, sealed: Sealed, rows: Mapping[str, int], committed_lines: int, now_s: float) -> None:
        """Note that it is closed, with ``rows`` of each arm; ``committed_lines`` of them are on the disk."""
        began, begin, path = self.began, self._begin, self.path
        if began is None or begin is None or path is None:
            raise refusal(self.stage, Event.SEALED)
        following = None
        if self._continues and sealed.end_line is not None and self._end_reason is None and not self._failed:
            following = resumed(begin, began, sealed.end_line, sealed.end_reason)
        self._go(Event.SEALED if following is None else Event.DISK_END)
        for arm, ranges in self._kept.items():
            ranges.append((began.first_line, began.first_line + rows[arm]))
        if not sealed.on_disk:
            self._leave(Orphan(path, sealed.end_reason, committed_lines))
        if following is None:
            self.sealed = sealed
        else:
            self._begin, self._cut_short = following, sealed
            self.resumption.ended(now_s, sealed.end_reason)

    # ---- the recorder's death, faults, and time

    def on_overdue(self) -> None:
        """Note that the recorder has not answered in time: the recording is cancelled."""
        self._go(Event.OVERDUE)
        self._end_reason = "cancelled"  # in case it begins nevertheless

    def on_killed(self, death: str, committed_lines: int, now_s: float) -> Begin | None:
        """Note that another recorder took over. Return the recording it is to begin now, if any."""
        was, begin = self._go(Event.KILLED), self._begin
        if begin is None or was in (Stage.NONE, Stage.SEALED, Stage.LOST):
            return None
        if was in (Stage.ASKED, Stage.CANCELLED):
            self._leave(Orphan(begin.path, f"its recorder was {death}"))
            if was is Stage.ASKED:
                self.refused = Refused(DeviceError(f"start: the recorder was {death}", hint="start again"))
            return None
        if was is Stage.RECORDING and self.began is not None:
            self._begin = continuation(begin, self.began, committed_lines, death)
        else:
            # Killed again before it began: the counters may belong to neither recording.
            self._begin, committed_lines = once_more(begin), 0
        if self._begin.path != begin.path:  # else it was killed before it had made anything
            why = f"its recorder was {death}; it continues in {self._begin.path.name}"
            self._leave(Orphan(begin.path, why, committed_lines))
        if was is Stage.PAUSED:
            self.resumption.ended(now_s, f"its recorder was {death}")
            return None
        return self._begin

    def on_died(self) -> None:
        """Note that the recorder died without a successor."""
        self._close_pause(self._go(Event.DIED))

    def on_fault(self) -> bool:
        """Note that the capture failed or is closed. Return whether the recorder must cancel a beginning."""
        was = self._go(Event.FAULT)
        self._failed = True
        return self._close_pause(was) or was is Stage.ASKED

    def due(self, now_s: float) -> Begin | None:
        """Return the further segment to be tried now, or None."""
        if self.stage is not Stage.PAUSED or self._begin is None or not self.resumption.is_due(now_s):
            return None
        self._begin = once_more(self._begin, self.resumption.why)
        return self._begin

    def on_line(self, line: int) -> bool:
        """Note that the lines have come to ``line``. Return whether that ended a recording that had paused.

        An attempt that is under way is awaited: it may have begun before the end.
        """
        end_line = None if self._begin is None else self._begin.end_line
        is_paused = self.stage is Stage.PAUSED and self.resumption.is_waiting
        if not is_paused or end_line is None or line < end_line or self._cut_short is None:
            return False
        passed = f"its end, line {end_line}, passed before a further segment could begin"
        self._cut_short = replace(self._cut_short, end_reason=f"{self._cut_short.end_reason}; {passed}")
        return self._close_pause(self._go(Event.OVER))

    def mark_unsealed(self, why: str, committed_lines: int) -> None:
        """Note that every process has ended: a recording that is not sealed now never will be."""
        self.on_died()
        known = {orphan.path for orphan in self._orphans}
        if self.stage is Stage.LOST and self._begin is not None and self._begin.path not in known:
            # A segment that never began has none: the counters are those of the segment before.
            lines = committed_lines if self._begin.path == self.path else 0
            self._leave(Orphan(self._begin.path, why, lines))

    def _go(self, event: Event) -> Stage:
        """Move to the next stage; return the one before."""
        before, self.stage = self.stage, after(self.stage, event)
        return before

    def _leave(self, orphan: Orphan) -> None:
        self._orphans.append(replace(orphan, notes=tuple(self.notes)))

    def _close_pause(self, was: Stage) -> bool:
        """Give up a further segment that has not begun yet; return whether there was one."""
        if was is not Stage.PAUSED:
            return False
        self.sealed, self._cut_short = self._cut_short, None
        self.resumption = Resumption()
        return True
