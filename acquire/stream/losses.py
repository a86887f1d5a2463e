"""Lines that never reached the recording: which, how many, and why."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from acquire.camera.base import LossCause

MAX_LOSSES = 8
"""Number of losses that one ring slot can report about the lines before it."""


class Cause(StrEnum):
    """Why lines are missing; the word that is stored with the recording's gaps."""

    CAMERA = "camera"
    """The camera's own count jumped, for no stated reason."""
    NO_BUFFER = LossCause.NO_BUFFER.value
    INCOMPLETE = LossCause.INCOMPLETE.value
    ID_GAP = LossCause.ID_GAP.value
    MISSED_TRIGGER = LossCause.MISSED_TRIGGER.value
    DEVICE_LOST = LossCause.DEVICE_LOST.value
    """Causes reported by the camera: see `acquire.camera.base.LossCause`."""
    GRABBER_LOST = "grabber_lost"
    """The grabber's process died; another took its place."""
    RECORDER_LOST = "recorder_lost"
    """The recorder died before the line was on disk, and the ring no longer held it for its successor."""
    RING_FULL = "ring_full"
    """The recorder was late: the grabber found no free slot. A recording ends before the first such line; one
    that continues after its recorder was killed lists the lines that found no slot in between as a gap."""
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
        """The first line after the lost ones."""
        return self.first_line + self.count


class LossLog:
    """Losses since the last committed slot. They are contiguous, and joined if their causes agree.

    Past ``MAX_LOSSES`` the last one grows and becomes `Cause.MIXED`: bounded, and never silent. If lines
    found the ring full it becomes `Cause.RING_FULL`, since no recording goes past such a line.
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
        """Return all losses in order, and empty the log."""
        taken = tuple(self._losses)
        self._losses.clear()
        return taken
