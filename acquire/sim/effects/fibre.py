"""Effects of an image-transmitting fibre: how bright its fibres are, and how well its bands are laid.

Every pixel of the scene is seen by one fibre of either arm, so both are maps of the scene's image on that
arm. Where a rig has no fibre, the field is a single band.
"""

from __future__ import annotations

from math import ceil
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from pydantic import Field

from acquire.config.base import Part
from acquire.sim.effects.base import Effect, Place, Setting, Stage, pattern

if TYPE_CHECKING:
    from numpy.typing import NDArray


class FibreBands(Effect):
    """Each band of the fibre begins a little beside its place: what its end shows of the scene is shifted."""

    kind: Literal["fibre_bands"]
    place: ClassVar[Place] = "image"
    rank: ClassVar[float] = 60
    shift_pixels: float = Field(gt=0, le=16, description="standard deviation along either axis, fine pixels")

    def stages(self, setting: Setting) -> list[Stage]:
        """X(r, c) ← X(r − Δr, c − Δc) within each band, bilinear, with Δr, Δc ~ N(0, shift_pixels) fixed per
        arm and band; what is beyond the square that is drawn is as at its edge.
        """
        from scipy.ndimage import shift

        side, edges = setting.scene.size, _edges(setting)
        drawn = pattern("fibre_bands", setting).standard_normal((len(edges), 2)) * self.shift_pixels
        axis = 1 if setting.arm == "a" else 2

        def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
            moved = frames.copy()
            for (begin, end), off in zip(edges, drawn, strict=True):
                margin = ceil(abs(off[axis - 1])) + 1
                low, high = max(0, begin - margin), min(side, end + margin)
                part = shift(_band(frames, axis, low, high), (0, *off), order=1, mode="nearest")
                _band(moved, axis, begin, end)[:] = _band(part, axis, begin - low, end - low)
            return moved

        return [Stage("fibre_bands", "image", run)]


class FibreGain(Effect):
    """Fibres pass different parts of the light: those that end on one column alike, and each by itself."""

    kind: Literal["fibre_gain"]
    place: ClassVar[Place] = "image"
    rank: ClassVar[float] = 70
    columns: Part = Field(
        default=0.0, description="standard deviation of the gain of all fibres that end on a column"
    )
    fibres: Part = Field(
        default=0.0, description="of single ones; what moves down a column averages over as many as it has"
    )

    def stages(self, setting: Setting) -> list[Stage]:
        """X ← X·max(0, 1 + N(0, columns)[band, along] + N(0, fibres)[r, c]), fixed per arm. `along` is where
        the column lies on its band: the scene's column on arm A, its row on arm B.
        """
        side, edges = setting.scene.size, _edges(setting)
        drawn = pattern("fibre_gain", setting)
        along_a, gain = setting.arm == "a", np.ones((side, side), np.float32)
        for begin, end in edges:
            of_column = (self.columns * drawn.standard_normal(side)).astype(np.float32)
            if along_a:
                gain[begin:end] += of_column
            else:
                gain[:, begin:end] += of_column[:, None]
        gain += self.fibres * drawn.standard_normal((side, side)).astype(np.float32)
        np.maximum(gain, 0, out=gain)

        def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
            dimmed: NDArray[np.float32] = frames * gain
            return dimmed

        return [Stage("fibre_gain", "image", run)]


def _edges(setting: Setting) -> list[tuple[int, int]]:
    """First row (arm A) or column (B) of each band in the square that is drawn, and the one after it."""
    fibre, side = setting.fibre, setting.scene.size
    if fibre is None:
        return [(0, side)]
    start = fibre.field()[0 if setting.arm == "a" else 1].start
    count = len(fibre.bands(setting.arm))
    return [(start + number * fibre.size, start + (number + 1) * fibre.size) for number in range(count)]


def _band(frames: NDArray[np.float32], axis: int, begin: int, end: int) -> NDArray[np.float32]:
    """A view of frames (t, r, c) from row or column ``begin`` to ``end``."""
    return frames[:, begin:end] if axis == 1 else frames[:, :, begin:end]
