"""Lines that never reached the recording: where, how many, and why."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from acquire.camera.base import LossCause

MAX_LOSSES = 8
"""Losses that one ring slot can report about the lines before it."""


class Cause(StrEnum):
    """Why lines are missing; the word that the recording's gaps carry."""

    CAMERA = "camera"
    """The camera's own count jumped, for a reason that it did not tell."""
    NO_BUFFER = LossCause.NO_BUFFER.value
    INCOMPLETE = LossCause.INCOMPLETE.value
    ID_GAP = LossCause.ID_GAP.value
    MISSED_TRIGGER = LossCause.MISSED_TRIGGER.value
    DEVICE_LOST = LossCause.DEVICE_LOST.value
    """What the camera told: see `acquire.camera.base.LossCause`."""
    GRABBER_LOST = "grabber_lost"
    """The grabber's process died; another took its place."""
    RECORDER_LOST = "recorder_lost"
    """The recorder's process died with the line in its hands; the ring had it no more for the next one."""
    RING_FULL = "ring_full"
    """The recorder was late: the grabber found no free slot. A recording ends before the first such line; one
    that goes on after its recorder was killed lists as a gap what found no slot meanwhile."""
    MIXED = "mixed"
    """Too many different losses at one place to tell them apart."""
    STALLED = "stalled"
    """The arm fell silent, or too far behind the other."""
    ARM_LOST = "arm_lost"
    """The arm's camera or grabber failed."""
    INTERRUPTED = "interrupted"
    """The recording was cut off before this arm delivered the line."""
    WRITE_ERROR = "write_error"
    """The disk failed before the line was on it; the recording ends before it."""


@dataclass(frozen=True, slots=True)
class Loss:
    """``count`` consecutive lines from ``first_line``, missing for one cause."""

    first_line: int
    count: int
    cause: Cause

    @property
    def end_line(self) -> int:
        return self.first_line + self.count


class LossLog:
    """Losses since the last committed slot. They follow one another without a hole, so they stay few.

    Past ``MAX_LOSSES`` the last one grows and becomes `Cause.MIXED`: bounded, and never silent. Where lines
    found the ring full it becomes `Cause.RING_FULL`, since no recording goes past these.
    """

    def __init__(self) -> None:
        self._losses: list[Loss] = []

    def add(self, loss: Loss) -> None:
        if not self._losses:
            self._losses.append(loss)
            return
        last = self._losses[-1]
        if last.cause is loss.cause:
            self._losses[-1] = Loss(last.first_line, last.count + loss.count, last.cause)
        elif len(self._losses) < MAX_LOSSES:
            self._losses.append(loss)
        else:
            overrun = Cause.RING_FULL in (last.cause, loss.cause)
            cause = Cause.RING_FULL if overrun else Cause.MIXED
            self._losses[-1] = Loss(last.first_line, last.count + loss.count, cause)

    def take(self) -> tuple[Loss, ...]:
        """All of them, in order; the log is empty afterwards."""
        taken = tuple(self._losses)
        self._losses.clear()
        return taken
