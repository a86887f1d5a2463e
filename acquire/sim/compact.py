"""Both arms on one simulated sensor (compact layout): the lines of two cameras side by side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.camera.base import CameraBlock, CameraIdentity

if TYPE_CHECKING:
    from numpy.typing import NDArray

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
    """One camera made of several that follow the same pulses; columns without an image are dark."""

    def __init__(self, opener: SideBySideOpener) -> None:
        self._opener = opener
        self._parts: list[SimulatedCamera] = [part() for part in opener.openers]
        self._ready: list[CameraBlock] = []

    def identify(self) -> CameraIdentity:
        return self._parts[0].identify()

    def settings(self) -> dict[str, Any]:
        return self._parts[0].settings() | {"Width": self._opener.width, "SensorWidth": self._opener.width}

    def arm(self) -> None:
        self._ready.clear()
        first, *others = self._parts
        first.arm()
        for part in others:
            part.arm_like(first)

    def next_block(self, timeout_s: float) -> CameraBlock | None:
        """Return a block once every part has delivered its own; it is as long as the first part's."""
        # A block that arrived before a timeout of another part is kept for the next call.
        for part in self._parts[len(self._ready) :]:
            block = part.next_block(timeout_s)
            if block is None:
                return None
            self._ready.append(block)
        blocks, self._ready = self._ready, []
        count = len(blocks[0].flags)
        pixels: NDArray[Any] = np.zeros((count, self._opener.width), blocks[0].pixels.dtype)
        for first, block in zip(self._opener.first_columns, blocks, strict=True):
            pixels[:, first : first + block.pixels.shape[1]] = block.pixels[:count]
        return CameraBlock(blocks[0].first_line, pixels, blocks[0].flags)

    def times_ns(self, first_line: int, count: int) -> NDArray[np.int64]:
        return self._parts[0].times_ns(first_line, count)

    def release(self, block: CameraBlock) -> None:
        """Do nothing: every block has its own memory."""

    def disarm(self) -> None:
        for part in self._parts:
            part.disarm()

    def statistics(self) -> dict[str, int]:
        return self._parts[0].statistics()

    def close(self) -> None:
        for part in self._parts:
            part.close()
