"""One process per camera: it takes blocks from the camera and copies them, once, into the arm's ring.

The camera counts lines since it was armed; line ``k`` of that count is the trigger's line
``k - depth_lines``, and what comes before the trigger's line 0 (preroll) is discarded. Lines that do not
come, or find the ring full, are located and told with the next slot that is committed.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import AcquireError, CameraError
from acquire.lines import LineFlag
from acquire.stream.losses import Cause, Loss, LossLog
from acquire.stream.messages import Ready

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.camera.base import Camera, CameraBlock, CameraOpener
    from acquire.stream.process import Mailbox
    from acquire.stream.ring import Ring
    from acquire.stream.shared import Counters

COUNTERS = ("delivered", "preroll", "camera_lost")
"""Lines since arm: delivered by the camera (preroll included), discarded as preroll, jumped over."""

_BLOCK_WAIT_S = 0.05
_MAIL_INTERVAL_S = 0.02


@dataclass(frozen=True, slots=True)
class GrabberPlan:
    """What one grabber needs to know. Picklable.

    A jump of the camera's count by more than ``max_jump_lines`` is a broken count, not a loss.
    """

    arm: str
    opener: CameraOpener
    depth_lines: int
    white_dn: int
    max_jump_lines: int


def grab(mailbox: Mailbox, plan: GrabberPlan, ring: Ring, counters: Counters) -> None:
    """Life of a grabber: open and arm the camera, say so, fill the ring until told to end."""
    camera = plan.opener()
    try:
        facts = {**camera.settings(), "identity": asdict(camera.identify())}
        camera.arm()
        mailbox.post(Ready(facts))
        _pump(mailbox, camera, Intake(plan, ring, counters))
    except BaseException as error:  # the only way out
        try:
            _let_go(camera)
        except AcquireError as second:
            error.add_note(f"while letting go: {second}")
        raise


def _let_go(camera: Camera) -> None:
    try:
        camera.disarm()
    finally:
        camera.close()


def _pump(mailbox: Mailbox, camera: Camera, intake: Intake) -> None:
    """Move blocks until the mailbox raises OwnerGone."""
    look = 0.0
    while True:
        if (now := time.monotonic()) >= look:
            mailbox.take()
            look = now + _MAIL_INTERVAL_S
        block = camera.next_block(_BLOCK_WAIT_S)
        if block is not None:
            intake.take(block)
            camera.release(block)


class Intake:
    """From camera blocks to ring slots: numbering, preroll, losses, saturation. Single copy, no I/O."""

    def __init__(self, plan: GrabberPlan, ring: Ring, counters: Counters) -> None:
        self._plan = plan
        self._ring = ring
        self._counters = counters
        self._losses = LossLog()
        self._next = -plan.depth_lines

    def take(self, block: CameraBlock) -> None:
        """Put the block's lines into the ring. Raises CameraError for a block that cannot be right."""
        self._check(block)
        first = block.first_line - self._plan.depth_lines
        self._note_jump(first)
        count = len(block.flags)
        preroll = min(max(-first, 0), count)
        self._counters.add("delivered", count)
        self._counters.add("preroll", preroll)
        for at in range(preroll, count, self._ring.shape.rows):
            part = slice(at, at + self._ring.shape.rows)
            self._put(first + at, block.pixels[part], block.flags[part])
        self._next = first + count

    def _check(self, block: CameraBlock) -> None:
        shape = self._ring.shape
        if block.pixels.shape != (len(block.flags), shape.width) or block.pixels.dtype != shape.dtype:
            raise CameraError(
                f"camera {self._plan.arm}: a block of {block.pixels.shape} {block.pixels.dtype} "
                f"with {len(block.flags)} flags",
                possible=f"(lines, {shape.width}) {shape.dtype} with a flag per line",
            )

    def _note_jump(self, first: int) -> None:
        jump = first - self._next
        if not 0 <= jump <= self._plan.max_jump_lines:
            raise CameraError(
                f"camera {self._plan.arm}: its count of lines went from "
                f"{self._next + self._plan.depth_lines} to {first + self._plan.depth_lines}",
                possible=f"the next line, or up to {self._plan.max_jump_lines} lost ones",
            )
        lost = first - max(self._next, 0)
        if lost > 0:
            self._counters.add("camera_lost", lost)
            self._losses.add(Loss(first - lost, lost, Cause.CAMERA))

    def _put(self, first_line: int, pixels: NDArray[Any], flags: NDArray[np.uint16]) -> None:
        count = len(flags)
        slot = self._ring.claim()
        if slot is None:
            self._ring.drop(count)
            self._losses.add(Loss(first_line, count, Cause.RING_FULL))
            return
        slot.pixels[:count] = pixels
        slot.flags[:count] = flags
        # One look at the whole block is several times cheaper than one per line, and mostly enough.
        if pixels.max() >= self._plan.white_dn:
            white = pixels.max(axis=1) >= self._plan.white_dn
            slot.flags[:count][white] |= np.uint16(LineFlag.SATURATED)
        self._ring.commit(first_line, count, self._losses.take())
