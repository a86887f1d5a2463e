"""Both arms on one simulated sensor (compact layout): the lines of two cameras side by side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.camera.base import CameraBlock, CameraIdentity

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.lines import LineBlock
    from acquire.sim.devices import SimulatedCamera, SimulatedCameraOpener


@dataclass(frozen=True, slots=True)
class SideBySideOpener:
    """Opens the sensor that both arms share; ``first_columns`` are the first columns of their images."""

    openers: tuple[SimulatedCameraOpener, ...]
    first_columns: tuple[int, ...]
    width: int

    def __call__(self) -> SideBySide:
        return SideBySide(self)


class SideBySide:
    """One camera made of several that follow the same pulses; columns without an image are dark.

    A sensor loses whole lines: one that any of the parts has lost is not delivered.
    """

    def __init__(self, opener: SideBySideOpener) -> None:
        self._opener = opener
        self._parts: list[SimulatedCamera] = [part() for part in opener.openers]
        self._waiting: list[LineBlock | None] = [None] * len(self._parts)
        self._delivered = 0

    def identify(self) -> CameraIdentity:
        return self._parts[0].identify()

    def settings(self) -> dict[str, Any]:
        return self._parts[0].settings() | {"Width": self._opener.width, "SensorWidth": self._opener.width}

    def arm(self) -> None:
        self._waiting = [None] * len(self._parts)
        self._delivered = 0
        first, *others = self._parts
        first.arm()
        # from the same pulse, although one may come while the parts are armed
        for part in others:
            part.arm_like(first)

    def next_block(self, timeout_s: float) -> CameraBlock | None:
        """Return the next lines that every part has delivered, side by side."""
        while True:
            for number, camera in enumerate(self._parts):
                if self._waiting[number] is None:
                    self._waiting[number] = camera.next_block(timeout_s)
                # the blocks of other parts are kept until this one has one, too
                if self._waiting[number] is None:
                    return None
            blocks = [block for block in self._waiting if block is not None]
            # a part that lost lines has blocks that begin and end elsewhere
            first = max(block.first_line for block in blocks)
            end = min(block.end_line for block in blocks)
            for number, block in enumerate(blocks):
                rest = block.part(end, block.end_line)
                self._waiting[number] = rest if len(rest) else None
            if first < end:
                self._delivered += end - first
                pixels: NDArray[Any] = np.zeros((end - first, self._opener.width), blocks[0].pixels.dtype)
                flags = np.zeros(end - first, np.uint16)
                for column, block in zip(self._opener.first_columns, blocks, strict=True):
                    part = block.part(first, end)
                    pixels[:, column : column + part.pixels.shape[1]] = part.pixels
                    # what is wrong with a line of one image is wrong with the sensor's line
                    flags |= part.flags
                return CameraBlock(first, pixels, flags)

    def times_ns(self, first_line: int, count: int) -> NDArray[np.int64]:
        return self._parts[0].times_ns(first_line, count)

    def release(self, block: CameraBlock) -> None:
        """Do nothing: every block has its own memory."""

    def disarm(self) -> None:
        for part in self._parts:
            part.disarm()

    def statistics(self) -> dict[str, int]:
        behind = max(part.statistics()["behind_lines"] for part in self._parts)
        # A line that one part has passed, and holds no more, was delivered or cannot be.
        passed = max(
            part.passed if block is None else block.first_line
            for part, block in zip(self._parts, self._waiting, strict=True)
        )
        return {"lines": self._delivered, "lost": passed - self._delivered, "behind_lines": behind}

    def close(self) -> None:
        for part in self._parts:
            part.close()
