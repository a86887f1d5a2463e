"""Which lines a buffer holds: from frame ids, counters and time stamps to line numbers and located losses.

A buffer is a frame of ``height`` lines. The camera numbers frames; every loss shows as a hole in the
numbers, and what the host counts (no free buffer) tells holes apart. Line triggers that the camera did not
see leave no hole: its counter of missed triggers says how many, the time from this frame to the next in
which frame::

    id        0    1    2  │ 5    6        7
    lines     0-   h-  2h- │ 5h-  6h-      7h + m -
                           └ 3, 4 lost     └ m triggers missed in frame 6

The number of a frame that arrived incomplete may be that of whatever was in its buffer before, and so may
its time: such a frame has no number of its own. It lies between the frames before and after it, and when
the hole between those is as large as the number of such frames, each has its place::

    id        7    ?    ?    10   ?    13
    lines     7h-  8h-  9h-  10h-      13h-
                             └ two frames are missing, one came: its place is not known, both are lost

A number that is a little behind the last one is a frame that was late or sent twice: it has been counted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.camera.base import CameraLoss, LossCause
from acquire.errors import CameraError, CameraLostError

if TYPE_CHECKING:
    from collections.abc import Iterator

# GigE Vision's block ids have 16 bits and go from 65535 to 1 (0 is for test packets), or 64 with extended
# ids, as in USB3 Vision. GenTL gives all of them as 64 bits (BUFFER_INFO_FRAMEID) and does not say which,
# and grabbers have widths of their own: it shows at the first wrap.
_ID_BITS = (8, 16, 24, 32, 48, 64)
_COUNTER_BITS = (16, 32, 64)
_MOST_DOUBT = 256
"""Frames after which missed triggers that no time stamp shows are taken as before the next frame."""
_CERTAIN = 0.25
"""Of a frame: what is further from a whole number of frames than this says nothing."""
_MOST_STALE = 256
"""Frames in a row with numbers behind the last one; more are a camera that has begun to count anew."""


@dataclass(frozen=True, slots=True)
class FrameFacts:
    """What is known of one delivered frame.

    ``frame_id`` is None where nothing vouches for it. ``underruns`` and ``missed`` are counts since the
    beginning, read after the frame came: frames that found no free buffer, line triggers that the camera did
    not see. ``time_ns`` is the camera's clock at the first line, None where it is not known.
    """

    frame_id: int | None
    underruns: int = 0
    missed: int = 0
    time_ns: int | None = None


class Tally:
    """What a device's counter has counted since the tally was begun, though it may be reset or wrap."""

    def __init__(self, reading: int) -> None:
        self._reading = reading
        self._total = 0

    def note(self, reading: int) -> int:
        """The total, now that the counter reads ``reading``."""
        grown = reading - self._reading
        if grown < 0:
            wrapped = (grown + (1 << bits) for bits in _COUNTER_BITS if self._reading < 1 << bits)
            # A counter that wrapped has grown by little since the last frame; another was reset.
            grown = next((grown for grown in wrapped if grown < 1 << 15), reading)
        self._reading = reading
        self._total += grown
        return self._total


@dataclass(frozen=True, slots=True)
class FramePlace:
    """Lines of a frame since arm, what was lost just before it, and whether its own numbers are in doubt:
    the camera has missed triggers in it or soon after. ``kept``: the frames without a number that came since
    the last one fill the lines just before it; else they are among the losses.
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
    first_id : id of the first frame; None: whichever comes first is the first, as with cameras whose ids go
        on from one acquisition to the next. (A camera that loses its first frame then seems to have lost
        none.)
    skips_zero : whether ids begin again at 1 after a wrap, not at 0; None: as the time stamps at the wrap
        say, else as the first frame's id suggests
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
        """The place of a frame that has a number, given that the ones before were placed; None for a frame
        that has been counted already.

        ``unnumbered`` frames without a number have come since the last one; ``keep`` says whether their
        lines are still there.

        Raises
        ------
        CameraLostError : the camera has begun to count anew
        CameraError : the first frame has an id below the first one
        """
        assert frame.frame_id is not None
        lost = self._lost_frames(frame, frame.frame_id, unnumbered)
        if lost is None:
            self._stale += 1
            # A few are late or were sent twice; a camera that restarted stays behind for ever.
            if self._stale > _MOST_STALE:
                raise CameraLostError(
                    f"the camera counts its frames anew: after id {self._last_id} came {self._stale} frames "
                    f"with ids behind it, the last one {frame.frame_id}"
                )
            return None
        self._stale = 0
        missed = self._missed_before(frame, lost)
        kept = keep and unnumbered == lost and not missed
        losses = () if kept else tuple(self._explain(frame, lost, missed, min(unnumbered, lost)))
        first = self._next_line + missed + lost * self._height
        self._next_line = first + self._height
        self._pending += frame.missed - self._missed
        self._missed = frame.missed
        self._doubtful = self._doubtful + 1 if self._pending else 0
        self._last, self._last_id = frame, frame.frame_id
        self._largest_id = max(self._largest_id, frame.frame_id)
        return FramePlace(first, losses, doubtful=self._pending > 0, kept=kept)

    def _lost_frames(self, frame: FrameFacts, number: int, unnumbered: int) -> int | None:
        """Frames between the last one and this one; None when this one is not after the last."""
        if self._last is not None:
            ahead = self._ahead(frame, number)
            return None if ahead is None else ahead - 1
        if self._first_id is None:
            self._first_id = number - unnumbered
            return unnumbered
        if number < self._first_id:
            raise CameraError(
                f"the first frame has id {number}, and ids begin at {self._first_id}",
                hint="frame_id_first in the camera's table",
            )
        return number - self._first_id

    def _ahead(self, frame: FrameFacts, number: int) -> int | None:
        """Frames from the last one to this one, over a wrap; None when this one is behind it, or the same."""
        if not self._id_bits and number >= self._last_id:
            return number - self._last_id or None
        # Ids wrap where the narrowest counter that can have made them does.
        bits = self._id_bits or next(bits for bits in _ID_BITS if self._largest_id < 1 << bits)
        ahead = (number - self._last_id) % (1 << bits)
        # More than half of all numbers ahead is less than half behind: late, rather than a day of losses.
        if ahead == 0 or ahead > 1 << (bits - 1) or (not self._id_bits and self._is_earlier(frame)):
            return None
        if number < self._last_id:
            self._id_bits = bits
            ahead -= self._skips(frame, number, ahead)
        return ahead

    def _is_earlier(self, frame: FrameFacts) -> bool:
        assert self._last is not None
        before, now = self._last.time_ns, frame.time_ns
        return before is not None and now is not None and now < before

    def _skips(self, frame: FrameFacts, number: int, ahead: int) -> bool:
        """Whether ids skip 0, at a frame after a wrap that is ``ahead`` frames ahead if they do not."""
        assert self._last is not None
        if number == 0:
            self._skips_zero = False
        if self._skips_zero is None:
            self._skips_zero = self._first_id == 1
            if frame.time_ns is not None and self._last.time_ns is not None and self._period_ns:
                frames = (frame.time_ns - self._last.time_ns) / (self._period_ns * self._height)
                if min(abs(frames - ahead), abs(frames - (ahead - 1))) < _CERTAIN:
                    self._skips_zero = frames < ahead - _CERTAIN
        return self._skips_zero

    def _missed_before(self, frame: FrameFacts, lost: int) -> int:
        """Missed triggers of the frames before this one, of those that the counter has announced."""
        last = self._last
        if last is None or last.time_ns is None or frame.time_ns is None or self._doubtful > _MOST_DOUBT:
            missed, self._pending = self._pending, 0
            return missed
        # The counter is read when a frame is taken from its queue, and may by then have counted what the
        # camera missed after it: before it there were no more than the time stamps leave room for.
        elapsed_ns = frame.time_ns - last.time_ns
        lines = (1 + lost) * self._height
        if not self._pending or self._period_ns is None:
            # The line period is measured where nothing is missing, so that it means what it says.
            if not self._pending and not lost:
                self._period_ns = elapsed_ns / lines
            missed = self._pending
        else:
            missed = min(self._pending, max(0, round(elapsed_ns / self._period_ns) - lines))
        self._pending -= missed
        return missed

    def _explain(self, frame: FrameFacts, lost: int, missed: int, incomplete: int) -> Iterator[CameraLoss]:
        if missed:
            yield CameraLoss(LossCause.MISSED_TRIGGER, missed)
        if incomplete:
            yield CameraLoss(LossCause.INCOMPLETE, incomplete * self._height)
        starved = min(lost - incomplete, frame.underruns - self._underruns)
        self._underruns += starved
        if starved:
            yield CameraLoss(LossCause.NO_BUFFER, starved * self._height)
        if gap := lost - incomplete - starved:
            yield CameraLoss(LossCause.ID_GAP, gap * self._height)
