"""Which lines a buffer holds: from frame ids, counters and time stamps to line numbers and located losses.

A buffer is a frame of ``height`` lines. The camera numbers frames; every loss shows as a hole in the
numbers, and what the host counts (no free buffer) tells holes apart. Line triggers that the camera did not
see leave no hole: its counter of missed triggers says how many, the time from this frame to the next in
which frame::

    id        0    1    2  │ 5    6        7
    lines     0-   h-  2h- │ 5h-  6h-      7h + m -
                           └ 3, 4 lost     └ m triggers missed in frame 6
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.camera.base import CameraLoss, LossCause

if TYPE_CHECKING:
    from collections.abc import Iterator

_ID_BITS = (8, 16, 24, 32, 48, 64)
_MOST_DOUBT = 256
"""Frames after which missed triggers that no time stamp shows are taken as before the next frame."""


@dataclass(frozen=True, slots=True)
class FrameFacts:
    """What is known of one delivered frame.

    ``underruns`` and ``missed`` are counts since the beginning, read after the frame came: frames that
    found no free buffer, line triggers that the camera did not see. ``time_ns`` is the camera's clock at
    the first line, None where the camera tells none.
    """

    frame_id: int
    underruns: int = 0
    missed: int = 0
    time_ns: int | None = None


@dataclass(frozen=True, slots=True)
class FramePlace:
    """Lines of a frame since arm, what was lost just before it, and whether its own numbers are in doubt:
    the camera has missed triggers in it or soon after.
    """

    first_line: int
    losses: tuple[CameraLoss, ...]
    doubtful: bool


class FrameCount:
    """Numbers the frames of one acquisition.

    Parameters
    ----------
    height : lines per frame
    id_bits : width of frame ids; 0: found when they wrap
    first_id : id of the first frame and of the one after a wrap; None: whichever comes first is the first,
        as with cameras whose ids go on from one acquisition to the next, and a wrap leads to 0, or to 1 if
        that was the first. (A camera that loses its first frame then seems to have lost none.)
    """

    def __init__(self, height: int, id_bits: int = 0, first_id: int | None = None) -> None:
        self._height = height
        self._id_bits = id_bits
        self._first_id = first_id
        self._last: FrameFacts | None = None
        self._underruns = 0
        self._missed = 0
        self._pending = self._doubtful = 0
        self._next_line = 0
        self._period_ns: float | None = None

    def place(self, frame: FrameFacts) -> FramePlace:
        """The frame's place, given that the ones before were placed."""
        lost = self._lost_frames(frame)
        missed = self._missed_before(frame, lost)
        losses = tuple(self._explain(frame, lost, missed))
        first = self._next_line + missed + lost * self._height
        self._next_line = first + self._height
        self._pending += frame.missed - self._missed
        self._missed = frame.missed
        self._doubtful = self._doubtful + 1 if self._pending else 0
        self._last = frame
        return FramePlace(first, losses, doubtful=self._pending > 0)

    def _lost_frames(self, frame: FrameFacts) -> int:
        last = self._last
        if last is None:
            if self._first_id is not None:
                return frame.frame_id - self._first_id
            self._first_id = 1 if frame.frame_id == 1 else 0
            return 0
        return self._ahead(last.frame_id, frame.frame_id) - 1

    def _ahead(self, last: int, now: int) -> int:
        """Frames from id ``last`` to id ``now``, over a wrap; ids begin again where they began."""
        if now > last:
            return now - last
        assert self._first_id is not None
        bits = self._id_bits or next(bits for bits in _ID_BITS if last < 1 << bits)
        return now - last + (1 << bits) - self._first_id

    def _missed_before(self, frame: FrameFacts, lost: int) -> int:
        """Missed triggers of the frames before this one, of those that the counter has announced."""
        last = self._last
        if last is None or last.time_ns is None or frame.time_ns is None or self._doubtful > _MOST_DOUBT:
            missed, self._pending = self._pending, 0
            return missed
        elapsed_ns = frame.time_ns - last.time_ns
        lines = (1 + lost) * self._height
        if not self._pending or self._period_ns is None:
            if not self._pending and not lost:
                self._period_ns = elapsed_ns / lines
            missed = self._pending
        else:
            missed = min(self._pending, max(0, round(elapsed_ns / self._period_ns) - lines))
        self._pending -= missed
        return missed

    def _explain(self, frame: FrameFacts, lost: int, missed: int) -> Iterator[CameraLoss]:
        if missed:
            yield CameraLoss(LossCause.MISSED_TRIGGER, missed)
        starved = min(lost, frame.underruns - self._underruns)
        self._underruns += starved
        if starved:
            yield CameraLoss(LossCause.NO_BUFFER, starved * self._height)
        if lost > starved:
            yield CameraLoss(LossCause.ID_GAP, (lost - starved) * self._height)
