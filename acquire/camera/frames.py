"""Line numbers of buffers, and located losses, from frame IDs, counters and time stamps.

A buffer is a frame of ``height`` lines. The camera numbers frames; every loss shows as a hole in the numbers,
and the host's counts (no free buffer) give the causes of holes. Line triggers that the camera missed leave no
hole: its counter of missed triggers gives their number, the time from one frame to the next their frame::

    id        0    1    2  │ 5    6        7
    lines     0-   h-  2h- │ 5h-  6h-      7h + m -
                           └ 3, 4 lost     └ m triggers missed in frame 6

The number and the time of a frame that arrived incomplete may be those of an earlier frame in its buffer, so
such a frame counts as unnumbered. It is between the frames before and after it; if the hole between those is
as large as the number of unnumbered frames, each has its place::

    id        7    ?    ?    10   ?    13
    lines     7h-  8h-  9h-  10h-      13h-
                             └ two frames are missing, one came: its place is not known, both are lost

A number slightly behind the last one belongs to a frame that was late or sent twice, and was counted already.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.camera.base import CameraLoss, LossCause
from acquire.errors import CameraError, CameraLostError

if TYPE_CHECKING:
    from collections.abc import Iterator

# GigE Vision's block ids have 16 bits and go from 65535 to 1 (0 is for test packets), or 64 with extended
# ids, as in USB3 Vision. GenTL returns all of them as 64 bits (BUFFER_INFO_FRAMEID) without their width, and
# frame grabbers have other widths: it is found at the first wrap.
_ID_BITS = (8, 16, 24, 32, 48, 64)
_COUNTER_BITS = (16, 32, 64)
_MOST_DOUBT = 256
"""Frames after which missed triggers that no time stamp has located are assumed before the next frame."""
_CERTAIN = 0.25
"""Largest distance from a whole number of frames, in frames, that is conclusive."""
_MOST_STALE = 256
"""Consecutive frames with numbers behind the last one; after more, the camera has restarted its count."""


@dataclass(frozen=True, slots=True)
class FrameFacts:
    """Facts of one delivered frame.

    ``frame_id`` is None if it is not reliable. ``underruns`` and ``missed`` are counts since the beginning,
    read after the frame came: frames that found no free buffer, line triggers that the camera missed.
    ``time_ns`` is the camera's clock at the first line, None if it is unknown.
    """

    frame_id: int | None
    underruns: int = 0
    missed: int = 0
    time_ns: int | None = None


class Tally:
    """Total of a device's counter since the tally was created, although the counter may be reset or wrap."""

    def __init__(self, reading: int) -> None:
        self._reading = reading
        self._total = 0

    def note(self, reading: int) -> int:
        """Return the total when the counter reads ``reading``."""
        grown = reading - self._reading
        if grown < 0:
            wrapped = (grown + (1 << bits) for bits in _COUNTER_BITS if self._reading < 1 << bits)
            # A counter that wrapped has grown little since the last frame; otherwise it was reset.
            grown = next((grown for grown in wrapped if grown < 1 << 15), reading)
        self._reading = reading
        self._total += grown
        return self._total


@dataclass(frozen=True, slots=True)
class FramePlace:
    """Lines of a frame since arm, and the losses just before it.

    ``doubtful``: the camera has missed triggers in the frame or soon after, so its line numbers are in doubt.
    ``kept``: the unnumbered frames since the last one fill the lines just before it; otherwise they are among
    the losses.
    """

    first_line: int
    losses: tuple[CameraLoss, ...]
    doubtful: bool
    kept: bool


class FrameCount:
    """Numbers the frames of one acquisition.

    Parameters
    ----------
    height : lines per frame
    id_bits : width of frame ids; 0: found when they wrap
    first_id : id of the first frame; None: that of the first one to come, for cameras whose ids continue from
        one acquisition to the next. (The loss of the very first frame is not detected then.)
    skips_zero : whether ids restart at 1 after a wrap, not at 0; None: according to the time stamps at the
        wrap, or else to the first frame's id
    """

    def __init__(
        self, height: int, id_bits: int = 0, first_id: int | None = None, skips_zero: bool | None = None
    ) -> None:
        self._height = height
        self._id_bits = id_bits
        self._first_id = first_id
        self._skips_zero = skips_zero
        self._last: FrameFacts | None = None
        self._last_id = self._largest_id = 0
        self._stale = 0
        self._underruns = 0
        self._missed = 0
        self._pending = self._doubtful = 0
        self._next_line = 0
        self._period_ns: float | None = None

    def place(self, frame: FrameFacts, unnumbered: int = 0, *, keep: bool = True) -> FramePlace | None:
        """Return the place of a numbered frame after the earlier ones; None if it was counted already.

        ``unnumbered`` frames have come since the last one; ``keep``: their lines are still available.

        Raises
        ------
        CameraLostError : the camera has restarted its count
        CameraError : the first frame has an id below the first one
        """
        assert frame.frame_id is not None
        lost = self._lost_frames(frame, frame.frame_id, unnumbered)
        if lost is None:
            self._stale += 1
            # A few are late or were sent twice; after a restart all frames stay behind.
            if self._stale > _MOST_STALE:
                raise CameraLostError(
                    f"the camera has restarted its count: after id {self._last_id}, {self._stale} frames "
                    f"with lower ids came, the last one {frame.frame_id}",
                    hint="check its power supply, then arm again",
                )
            return None
        self._stale = 0
        missed = self._missed_before(frame, lost)
        kept = keep and unnumbered == lost and not missed
        losses = () if kept else tuple(self._explain(frame, lost, missed, min(unnumbered, lost)))
        first = self._next_line + missed + lost * self._height
        self._next_line = first + self._height
        # Only now: the counter was read after this frame had come, so new misses are in it or after it.
        self._pending += frame.missed - self._missed
        self._missed = frame.missed
        self._doubtful = self._doubtful + 1 if self._pending else 0
        self._last, self._last_id = frame, frame.frame_id
        self._largest_id = max(self._largest_id, frame.frame_id)
        return FramePlace(first, losses, doubtful=self._pending > 0, kept=kept)

    def _lost_frames(self, frame: FrameFacts, number: int, unnumbered: int) -> int | None:
        """Return the number of frames between the last one and this one; None if this is not after it."""
        if self._last is not None:
            ahead = self._ahead(frame, number)
            return None if ahead is None else ahead - 1
        if self._first_id is None:
            self._first_id = number - unnumbered
            return unnumbered
        if number < self._first_id:
            raise CameraError(
                f"the first frame has id {number}, but ids are set to begin at {self._first_id}",
                hint="change frame_id_first in the camera's table",
            )
        return number - self._first_id

    def _ahead(self, frame: FrameFacts, number: int) -> int | None:
        """Return the frames from the last one to this one, across a wrap; None if this is not after it."""
        # Where the width is not known, a larger number is no sign of a wrap.
        if not self._id_bits and number >= self._last_id:
            return number - self._last_id or None
        # Assume the narrowest counter that can have produced the ids.
        bits = self._id_bits or next(bits for bits in _ID_BITS if self._largest_id < 1 << bits)
        ahead = (number - self._last_id) % (1 << bits)
        # More than half of the range ahead is less than half behind: a late frame, not a day of losses.
        if ahead == 0 or ahead > 1 << (bits - 1):
            return None
        # While the width is only assumed, a smaller number may be a late frame, which its time shows.
        assert self._last is not None
        before, now = self._last.time_ns, frame.time_ns
        if not self._id_bits and before is not None and now is not None and now < before:
            return None
        if number < self._last_id:
            self._id_bits = bits
            ahead -= self._skips(frame, number, ahead)
        return ahead

    def _skips(self, frame: FrameFacts, number: int, ahead: int) -> bool:
        """Return whether ids skip 0, at a frame after a wrap; it is ``ahead`` frames ahead if they do not."""
        assert self._last is not None
        if number == 0:
            self._skips_zero = False
        if self._skips_zero is None:
            self._skips_zero = self._first_id == 1
            if frame.time_ns is not None and self._last.time_ns is not None and self._period_ns:
                # The time since the last frame shows which one this is: one fewer if 0 was skipped.
                frames = (frame.time_ns - self._last.time_ns) / (self._period_ns * self._height)
                if min(abs(frames - ahead), abs(frames - (ahead - 1))) < _CERTAIN:
                    self._skips_zero = frames < ahead - _CERTAIN
        return self._skips_zero

    def _missed_before(self, frame: FrameFacts, lost: int) -> int:
        """Return how many of the missed triggers counted so far are before this frame."""
        last = self._last
        if last is None or last.time_ns is None or frame.time_ns is None or self._doubtful > _MOST_DOUBT:
            missed, self._pending = self._pending, 0
            return missed
        # The counter is read when a frame is taken from its queue, and may then include triggers missed after
        # it: before the frame, there were no more than the time stamps leave room for.
        elapsed_ns = frame.time_ns - last.time_ns
        lines = (1 + lost) * self._height
        if not self._pending or self._period_ns is None:
            # Measure the line period only where nothing is missing.
            if not self._pending and not lost:
                self._period_ns = elapsed_ns / lines
            missed = self._pending
        else:
            missed = min(self._pending, max(0, round(elapsed_ns / self._period_ns) - lines))
        self._pending -= missed
        return missed

    def _explain(self, frame: FrameFacts, lost: int, missed: int, incomplete: int) -> Iterator[CameraLoss]:
        # First the losses that were counted; only the rest of the hole is attributed to the link.
        if missed:
            yield CameraLoss(LossCause.MISSED_TRIGGER, missed)
        if incomplete:
            yield CameraLoss(LossCause.INCOMPLETE, incomplete * self._height)
        # The count may include frames after this one: what is beyond this hole is left for later ones.
        starved = min(lost - incomplete, frame.underruns - self._underruns)
        self._underruns += starved
        if starved:
            yield CameraLoss(LossCause.NO_BUFFER, starved * self._height)
        if gap := lost - incomplete - starved:
            yield CameraLoss(LossCause.ID_GAP, gap * self._height)
