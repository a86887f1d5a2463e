"""One process per camera: it takes blocks from the camera and copies them, once, into the arm's ring.

The camera counts lines since it was armed; line ``k`` of that count is the trigger's line
``k - depth_lines``, and what comes before the trigger's line 0 (preroll) is discarded. Lines that do not
come, or find the ring full, are located and told with the next slot that is committed.

A camera that is gone is opened again, for a bounded time. It then counts from 0: its time stamps say which
line that is, and what the trigger issued meanwhile is a loss like any other.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.camera.base import LossCause
from acquire.errors import AcquireError, CameraError, CameraLostError
from acquire.lines import LineFlag
from acquire.processes.messages import Ready
from acquire.processes.worker import become_urgent
from acquire.stream.lineclock import LineClock
from acquire.stream.losses import Cause, Loss, LossLog

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.camera.base import Camera, CameraBlock, CameraLoss, CameraOpener
    from acquire.processes.shared import Counters
    from acquire.processes.worker import Mailbox
    from acquire.stream.ring import Ring

CAMERA_CAUSES = (Cause.CAMERA, *(Cause(cause) for cause in LossCause))
COUNTERS = (
    "delivered", "preroll", *CAMERA_CAUSES, Cause.GRABBER_LOST,
    "next_line", "reopened", "stamp_line", "stamp_ns", "drift_ppb", "saturated",
)  # fmt: skip
"""Lines since arm: delivered by the camera (preroll included), discarded as preroll, lost by cause; the line
that comes next. How often the camera was opened again; a line and its time by the camera's clock, and how
much faster that runs than the trigger's. Lines with a saturated pixel.
"""

# A driver that waits does not hear us: an end, and an owner that is gone, are noticed so late.
_BLOCK_WAIT_S = 0.05
# A camera takes seconds to come back; to look for it ten times a second costs nobody anything.
_REOPEN_PAUSE_S = 0.1
# Blocks may come every 2 ms: a look at the mailbox for each would be a system call that nobody needs.
_MAIL_INTERVAL_S = 0.02


@dataclass(frozen=True, slots=True)
class GrabberPlan:
    """What one grabber needs to know. Picklable.

    A jump of the camera's count by more than ``max_jump_lines`` is a broken count, not a loss. A camera that
    is gone is waited for as long as ``reopen_timeout_s``; ``line_period_ns`` is the trigger's. ``columns``
    are the arm's on a camera that has both arms, None on one of its own. ``realtime``: it runs before
    everything else on the host, where that is allowed. ``successor``: of a grabber that died; its ring and
    counters are as that one left them.
    """

    arm: str
    opener: CameraOpener
    depth_lines: int
    white_dn: int
    max_jump_lines: int
    reopen_timeout_s: float = 0.0
    line_period_ns: float = 0.0
    columns: tuple[int, int] | None = None
    realtime: bool = False
    successor: bool = False


def grab(mailbox: Mailbox, *arms: tuple[GrabberPlan, Ring, Counters]) -> None:
    """Life of a grabber: open and arm the camera, say so, fill the rings until told to end.

    Several ``arms`` fall on one camera, each on columns of its own.
    """
    plan = arms[0][0]  # the first arm's opener opens the camera that they share
    urgent = plan.realtime and become_urgent()  # first: threads of a driver are as urgent as who starts them
    camera = _open_again(mailbox, plan, "its grabber died") if plan.successor else plan.opener()
    intakes = [Intake(*arm) for arm in arms]
    try:
        facts = {**camera.settings(), "identity": asdict(camera.identify()), "realtime": urgent}
        if not plan.successor:  # `_open_again` has armed it: a camera is there again once it can be armed
            camera.arm()
        mailbox.post(Ready(facts))
        while True:
            try:
                _pump(mailbox, camera, intakes)
            except CameraLostError as lost:
                # Closed first, as far as it can be: most devices are opened by one handle at a time.
                with contextlib.suppress(AcquireError):
                    _let_go(camera)
                camera = _open_again(mailbox, plan, lost.message)
                for intake in intakes:
                    intake.realign()
    except BaseException as error:  # the only way out
        try:
            _let_go(camera)
        except AcquireError as second:
            error.add_note(f"while letting go: {second}")
        raise


def _open_again(mailbox: Mailbox, plan: GrabberPlan, why: str) -> Camera:
    """The camera, open and armed; CameraLostError when that does not succeed in time."""
    deadline = time.monotonic() + plan.reopen_timeout_s
    while (camera := _try_open(plan)) is None:
        if time.monotonic() >= deadline:
            raise CameraLostError(
                f"camera {plan.arm} is gone: {why}", hint=f"it was waited for {plan.reopen_timeout_s:g} s"
            )
        mailbox.take()  # raises OwnerGone once nobody wants the camera any more
        time.sleep(_REOPEN_PAUSE_S)
    return camera


def _try_open(plan: GrabberPlan) -> Camera | None:
    try:
        camera = plan.opener()
    except CameraError:
        return None
    try:
        camera.arm()
    except CameraError:
        with contextlib.suppress(AcquireError):
            _let_go(camera)
        return None
    return camera


def _let_go(camera: Camera) -> None:
    try:
        camera.disarm()
    finally:
        camera.close()


def _pump(mailbox: Mailbox, camera: Camera, intakes: list[Intake]) -> None:
    """Move blocks until the mailbox raises OwnerGone."""
    look = 0.0
    while True:
        if (now := time.monotonic()) >= look:
            mailbox.take()
            look = now + _MAIL_INTERVAL_S
        block = camera.next_block(_BLOCK_WAIT_S)
        if block is not None:
            for intake in intakes:
                intake.take(block)
            camera.release(block)


def settle_books(ring: Ring, counters: Counters) -> None:
    """For a grabber that died: lines that it had counted, and did not commit, were not delivered."""
    # `take` counts a block before it puts it: killed in between, the block is in the count and nowhere else.
    counters["delivered"] = counters["preroll"] + ring.statistics().dropped_lines + ring.committed_lines


class Intake:
    """From camera blocks to ring slots: numbering, preroll, losses, saturation. Single copy, no I/O."""

    def __init__(self, plan: GrabberPlan, ring: Ring, counters: Counters) -> None:
        self._plan = plan
        self._ring = ring
        self._counters = counters
        self._losses = LossLog()
        self._next = -plan.depth_lines
        self._shift = -plan.depth_lines
        self._clock = LineClock(plan.line_period_ns)
        self._away = False
        self._away_for = Cause.DEVICE_LOST
        if plan.successor:
            self._take_over()

    def _take_over(self) -> None:
        """Go on for a grabber that died: what comes after its last slot is lost."""
        ring, counters = self._ring, self._counters
        self._next = ring.newest_line
        counted = sum(counters[cause] for cause in (*CAMERA_CAUSES, Cause.GRABBER_LOST))
        told = ring.committed_lines + ring.statistics().dropped_lines + counted - self._next
        counters.add(Cause.GRABBER_LOST, -max(0, told))  # lost before the death, and located after it
        self._clock.take_over(counters["stamp_line"], counters["stamp_ns"], counters["drift_ppb"])
        self._away_for = Cause.GRABBER_LOST
        self.realign()

    def realign(self) -> None:
        """The camera was opened again: it counts from 0, and its next time stamp says from which line."""
        self._away = True
        self._counters.add("reopened", 1)

    def take(self, block: CameraBlock) -> None:
        """Put the block's lines into the ring. Raises CameraError for a block that cannot be right."""
        if self._plan.columns is not None:
            block = replace(block, pixels=block.pixels[:, slice(*self._plan.columns)])
        shape = self._ring.shape
        if block.pixels.shape != (len(block.flags), shape.width) or block.pixels.dtype != shape.dtype:
            raise CameraError(
                f"camera {self._plan.arm} gave a block of {block.pixels.shape} {block.pixels.dtype} "
                f"with {len(block.flags)} flags",
                possible=f"(lines, {shape.width}) {shape.dtype} with a flag per line",
            )
        if self._away:
            if block.time_ns is None and block.flags.all():
                return  # an incomplete frame has no time, and the next one may have
            self._come_back(block)
            block = replace(block, losses=())  # these are among what it missed
        first = block.first_line + self._shift
        self._note_jump(first, block.losses)
        # Before the lines are put: whoever sees them, and a successor, finds a stamp that is not older.
        if block.time_ns is not None:
            self._clock.note(first, block.time_ns)
            stamp = {"stamp_line": first, "stamp_ns": block.time_ns, "drift_ppb": self._clock.drift_ppb}
            for name, value in stamp.items():
                self._counters[name] = value
        count = len(block.flags)
        preroll = min(max(-first, 0), count)
        self._counters.add("delivered", count)
        self._counters.add("preroll", preroll)
        # A frame may have more lines than a slot: its height is the camera's, the slot's is the rig's.
        for at in range(preroll, count, self._ring.shape.rows):
            part = slice(at, at + self._ring.shape.rows)
            self._put(first + at, block.pixels[part], block.flags[part])
        self._next = first + count
        self._counters["next_line"] = self._next

    def _come_back(self, block: CameraBlock) -> None:
        """Number a camera that was away by its time stamps; what it missed is lost."""
        line = None if block.time_ns is None else self._clock.line_at(block.time_ns)
        if line is None:
            raise CameraError(
                f"camera {self._plan.arm} is there again, but its time stamps do not say at which line",
                hint="arm again",
            )
        self._away = False
        self._shift = line - block.first_line
        # A line further off than that is left for `_note_jump` to refuse.
        if 0 <= line - self._next <= self._plan.max_jump_lines:
            self._lose(self._next, line - self._next, self._away_for)
            self._next = line
        self._away_for = Cause.DEVICE_LOST

    def _note_jump(self, first: int, losses: tuple[CameraLoss, ...]) -> None:
        jump = first - self._next
        if not 0 <= jump <= self._plan.max_jump_lines:
            raise CameraError(
                f"camera {self._plan.arm}: its count of lines went from "
                f"{self._next - self._shift} to {first - self._shift}",
                possible=f"the next line, or up to {self._plan.max_jump_lines} lost ones",
            )
        # Where the camera told fewer losses than its count jumped by, the rest has no reason of its own; the
        # sum of the causes must be the jump, or the ledger would not balance.
        unexplained = jump - sum(loss.count for loss in losses)
        self._lose(self._next, unexplained, Cause.CAMERA)
        at = self._next + max(unexplained, 0)
        for loss in losses:
            count = min(loss.count, first - at)
            self._lose(at, count, Cause(loss.cause))
            at += count

    def _lose(self, first: int, count: int, cause: Cause) -> None:
        """Note lines that did not come, but for the preroll's."""
        # Lines before the trigger's line 0 are nobody's: no ledger has them.
        count += min(first, 0)
        if count > 0:
            self._counters.add(cause, count)
            self._losses.add(Loss(max(first, 0), count, cause))

    def _put(self, first_line: int, pixels: NDArray[Any], flags: NDArray[np.uint16]) -> None:
        count = len(flags)
        slot = self._ring.claim()
        if slot is None:
            # Nobody waits for a slot: what is dropped here has a number and a cause. Cameras that run out of
            # buffers do not always say how many lines that was.
            self._ring.drop(first_line, count)
            self._losses.add(Loss(first_line, count, Cause.RING_FULL))
            return
        slot.pixels[:count] = pixels
        slot.flags[:count] = flags
        # One look at the whole block is several times cheaper than one per line, and mostly enough.
        if pixels.max() >= self._plan.white_dn:
            white = pixels.max(axis=1) >= self._plan.white_dn
            slot.flags[:count][white] |= np.uint16(LineFlag.SATURATED)
            self._counters.add("saturated", int(np.count_nonzero(white)))
        self._ring.commit(first_line, count, self._losses.take())
