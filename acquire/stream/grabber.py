"""One process per camera: it takes blocks from the camera and copies them, once, into the arm's ring.

The camera counts lines since it was armed; line ``k`` of that count is the trigger's line
``k - depth_lines``, and lines before the trigger's line 0 (preroll) are discarded. Lines that do not come,
or find the ring full, are located and reported with the next committed slot.

A camera that is gone is opened again, within a time limit. It then counts from 0: its time stamps give the
number of that line, and the lines that the trigger issued in the meantime are a loss like any other.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.camera.base import LossCause
from acquire.errors import AcquireError, CameraError, CameraLostError, add_failure
from acquire.lines import LineFlag
from acquire.processes.messages import Ready
from acquire.processes.rank import become_prompt, become_urgent
from acquire.processes.worker import OwnerGone
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
"""Lines since arm: delivered by the camera (preroll included), discarded as preroll, lost by cause; the next
line. How often the camera was opened again; a line and its time by the camera's clock, and how much faster
that clock runs than the trigger's. Lines with a saturated pixel.
"""

# A waiting driver cannot be interrupted: Quit, and the owner's death, are noticed this much later at most.
_BLOCK_WAIT_S = 0.05
# A camera takes seconds to come back; looking for it ten times a second costs next to nothing.
_REOPEN_PAUSE_S = 0.1
# Blocks may come every 2 ms: checking the mailbox for each would be a needless system call.
_MAIL_INTERVAL_S = 0.02


@dataclass(frozen=True, slots=True)
class GrabberPlan:
    """Settings of one grabber, for one arm. Picklable.

    A jump of the camera's count by more than ``max_jump_lines`` is a broken count, not a loss. A camera that
    is gone is waited for during ``reopen_timeout_s``; ``line_period_ns`` is the trigger's. ``columns`` are
    the arm's columns on a camera that serves both arms; None if the arm has a camera of its own.
    ``realtime``: run ahead of everything else on the host, where that is allowed. ``successor``: take over
    the ring and counters of a grabber that died, as it left them.
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
    """Main function of a grabber: open and arm the camera, report Ready, fill the rings until Quit.

    Several ``arms`` share one camera, each with its own columns.
    """
    plan = arms[0][0]  # the first arm's opener opens the camera that they share
    # First, since a driver's threads inherit the rank.
    urgent = plan.realtime and become_urgent()
    if not urgent:
        become_prompt()
    camera = _open_again(mailbox, plan, "its grabber died") if plan.successor else plan.opener()
    intakes = [Intake(*arm) for arm in arms]
    try:
        facts = {**camera.settings(), "identity": asdict(camera.identify()), "realtime": urgent}
        if not plan.successor:  # `_open_again` has armed it already
            camera.arm()
        mailbox.post(Ready(facts))
        while True:
            try:
                _pump(mailbox, camera, intakes)
            except CameraLostError as lost:
                # Close it first, as far as possible: most devices can be opened by one handle at a time.
                with contextlib.suppress(AcquireError):
                    _shut_down(camera)
                camera = _open_again(mailbox, plan, lost.message)
                for intake in intakes:
                    intake.realign()
    except OwnerGone:  # the usual end: a camera that cannot be closed, and may still be running, is its error
        _shut_down(camera)
        raise
    except BaseException as error:
        try:
            _shut_down(camera)
        except AcquireError as second:
            add_failure(error, "while closing the camera", second)
        raise


def _open_again(mailbox: Mailbox, plan: GrabberPlan, why: str) -> Camera:
    """Return the camera, open and armed. Raises CameraLostError if that does not succeed in time."""
    deadline = time.monotonic() + plan.reopen_timeout_s
    while True:
        try:
            return _open_armed(plan)
        except CameraError as error:
            if time.monotonic() >= deadline:
                away = f"it did not come back within {plan.reopen_timeout_s:g} s ({error.message})"
                raise CameraLostError(
                    f"camera {plan.arm} is gone: {why}; {away}", hint="check cable and power, then arm again"
                ) from error
        mailbox.take()  # raises OwnerGone once the run is over
        time.sleep(_REOPEN_PAUSE_S)


def _open_armed(plan: GrabberPlan) -> Camera:
    camera = plan.opener()
    try:
        camera.arm()
    except CameraError:
        with contextlib.suppress(AcquireError):
            _shut_down(camera)
        raise
    return camera


def _shut_down(camera: Camera) -> None:
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
    """Correct the count of a grabber that died: lines that it did not commit were not delivered."""
    # `Intake.take` counts a block before it puts it into the ring; a kill in between leaves it counted only.
    counters["delivered"] = counters["preroll"] + ring.statistics().dropped_lines + ring.committed_lines


class Intake:
    """Moves camera blocks to ring slots: numbering, preroll, losses, saturation. One copy, no I/O."""

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
            # Lines after the last slot of the dead grabber are lost. Losses that it had counted and not
            # committed yet are located, and counted, once more.
            self._next = ring.newest_line
            lost = sum(counters[cause] for cause in (*CAMERA_CAUSES, Cause.GRABBER_LOST))
            excess = ring.committed_lines + ring.statistics().dropped_lines + lost - self._next
            counters.add(Cause.GRABBER_LOST, -max(0, excess))
            self._clock.take_over(counters["stamp_line"], counters["stamp_ns"], counters["drift_ppb"])
            self._away_for = Cause.GRABBER_LOST
            self.realign()

    def realign(self) -> None:
        """Note that the camera was opened again and counts from 0; its next time stamp gives the line."""
        self._away = True
        self._counters.add("reopened", 1)

    def take(self, block: CameraBlock) -> None:
        """Put the block's lines into the ring. Raises CameraError for an impossible block."""
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
            self._renumber(block)
            block = replace(block, losses=())  # they are part of the loss that `_renumber` noted
        first = block.first_line + self._shift
        self._note_jump(first, block.losses)
        # Before the lines are put: readers of the lines, and a successor, must not find an older stamp.
        if block.time_ns is not None:
            self._clock.note(first, block.time_ns)
            stamp = {"stamp_line": first, "stamp_ns": block.time_ns, "drift_ppb": self._clock.drift_ppb}
            for name, value in stamp.items():
                self._counters[name] = value
        count = len(block.flags)
        preroll = min(max(-first, 0), count)
        # Before they are put: `settle_books` corrects these counts if this process is killed in between.
        self._counters.add("delivered", count)
        self._counters.add("preroll", preroll)
        # A frame may have more lines than a slot: the camera sets its height, the rig the slot's.
        for at in range(preroll, count, shape.rows):
            part = slice(at, at + shape.rows)
            self._put(first + at, block.pixels[part], block.flags[part])
        self._next = first + count
        self._counters["next_line"] = self._next

    def _renumber(self, block: CameraBlock) -> None:
        """Number the lines of a camera that was away by its time stamps; the lines in between are lost."""
        line = None if block.time_ns is None else self._clock.line_at(block.time_ns)
        if line is None:
            raise CameraError(
                f"camera {self._plan.arm} is back, but its time stamps do not show at which line",
                hint="arm again",
            )
        self._away = False
        self._shift = line - block.first_line
        # A jump outside these limits is left for `_note_jump` to refuse.
        if 0 <= line - self._next <= self._plan.max_jump_lines:
            self._lose(self._next, line - self._next, self._away_for)
            self._next = line
        self._away_for = Cause.DEVICE_LOST

    def _note_jump(self, first: int, losses: tuple[CameraLoss, ...]) -> None:
        jump = first - self._next
        if not 0 <= jump <= self._plan.max_jump_lines:
            raise CameraError(
                f"camera {self._plan.arm}: its line count went from "
                f"{self._next - self._shift} to {first - self._shift}",
                possible=f"the next line, or up to {self._plan.max_jump_lines} lost ones",
            )
        if not jump:
            return
        # If the camera reported fewer losses than its count jumped by, the rest has no specific cause; the
        # losses must add up to the jump, or the ledger would not balance.
        unexplained = jump - sum(loss.count for loss in losses)
        self._lose(self._next, unexplained, Cause.CAMERA)
        at = self._next + max(unexplained, 0)
        for loss in losses:
            count = min(loss.count, first - at)
            self._lose(at, count, Cause(loss.cause))
            at += count

    def _lose(self, first: int, count: int, cause: Cause) -> None:
        """Note lines that did not come, except in the preroll, which is in no ledger."""
        count += min(first, 0)
        if count > 0:
            self._counters.add(cause, count)
            self._losses.add(Loss(max(first, 0), count, cause))

    def _put(self, first_line: int, pixels: NDArray[Any], flags: NDArray[np.uint16]) -> None:
        count = len(flags)
        slot = self._ring.claim(first_line, count)
        if slot is None:
            # Do not wait for a slot: lines dropped here have numbers and a cause, whereas a camera that runs
            # out of buffers does not always report how many lines it lost.
            self._ring.drop(first_line, count)
            self._losses.add(Loss(first_line, count, Cause.RING_FULL))
            return
        slot.pixels[...] = pixels
        slot.flags[...] = flags
        # The maximum of the whole block is several times cheaper than one per line, and mostly enough.
        if pixels.max() >= self._plan.white_dn:
            white = pixels.max(axis=1) >= self._plan.white_dn
            slot.flags[white] |= np.uint16(LineFlag.SATURATED)
            self._counters.add("saturated", int(np.count_nonzero(white)))
        self._ring.commit(slot, self._losses.take())
