"""Shutters before a scene: sliding windows (Fig. 8) and chopper wheels (Fig. 11)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from acquire.config.scene import WindowConfig
from acquire.sim.kernels import chop
from acquire.sim.scene import frames_at
from acquire.sim.targets import overlap

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from acquire.config.scene import ChopperConfig, WindowPhase
    from acquire.sim.scene import Scene


class Shutter(Protocol):
    """A moving opaque object."""

    def cover(self, frames: NDArray[np.float32], substeps: NDArray[np.int64]) -> None:
        """Remove, in place, the light that is blocked at the middle of each sub-step."""
        ...


class ShutteredScene:
    """A scene behind shutters, of which the first is the nearest to it."""

    def __init__(self, scene: Scene, shutters: Sequence[Shutter]) -> None:
        self._scene, self._shutters = scene, shutters

    @property
    def size(self) -> int:
        return self._scene.size

    def frames(self, first: int, count: int) -> NDArray[np.float32]:
        """(count, row, column) float32."""
        return self.frames_at(np.arange(first, first + count))

    def frames_at(self, substeps: NDArray[np.int64]) -> NDArray[np.float32]:
        """(count, row, column) float32."""
        # In place, since a scene's frames are a new array each time (`Scene.frames`).
        frames = frames_at(self._scene, substeps)
        for shutter in self._shutters:
            shutter.cover(frames, substeps)
        return frames


def build_shutter(config: WindowConfig | ChopperConfig, size: int, substep_s: float) -> Shutter:
    """Return the shutter that a configuration describes."""
    if isinstance(config, WindowConfig):
        return PhasedWindow(config.phases, size, substep_s)
    return Chopper(config, size, substep_s)


class PhasedWindow:
    """A sequence of phases in a loop that begins at sub-step 0."""

    def __init__(self, phases: tuple[WindowPhase, ...], size: int, substep_s: float) -> None:
        self._phases, self._size, self._substep_s = phases, size, substep_s
        self._ends_s = np.cumsum([phase.duration_s for phase in phases])

    def cover(self, frames: NDArray[np.float32], substeps: NDArray[np.int64]) -> None:
        time_s = (substeps + 0.5) * self._substep_s % self._ends_s[-1]
        for frame, at_s in zip(frames, time_s.tolist(), strict=True):
            # The remainder of a time just below 0 can be rounded to the end of the loop itself.
            number = min(int(np.searchsorted(self._ends_s, at_s, side="right")), len(self._phases) - 1)
            phase = self._phases[number]
            if phase.axis != "open":
                done = 1 - (self._ends_s[number] - at_s) / phase.duration_s
                middle = phase.begin + (phase.end - phase.begin) * float(done)
                opened = overlap(self._size, middle - phase.width / 2, phase.width).astype(np.float32)
                np.multiply(frame, opened[:, None] if phase.axis == "row" else opened, out=frame)


class Chopper:
    """A wheel with straight spokes; its edges are one pixel wide."""

    def __init__(self, config: ChopperConfig, size: int, substep_s: float) -> None:
        self._config, self._substep_s = config, substep_s
        centre = (np.arange(size) + 0.5) / size
        up, right = config.row - centre[:, None], centre[None, :] - config.column
        self._angle = np.arctan2(up, right) / (2 * np.pi)
        # in pixels, in which an edge's width is given; the angle is in turns
        self._radius = np.hypot(up, right) * size

    def cover(self, frames: NDArray[np.float32], substeps: NDArray[np.int64]) -> None:
        config = self._config
        turned = ((substeps + 0.5) * (config.rotation_hz * self._substep_s) + config.phase_deg / 360) % 1.0
        chop(
            frames,
            self._angle,
            self._radius,
            turned,
            blades=config.blades,
            open_part=config.open_part,
        )
