"""Effects of an image-transmitting fibre: the transmission of its fibres, and the alignment of its bands.

Every pixel of the scene is imaged by one fibre of each arm, so both effects are maps of the scene's image on
that arm. Without a fibre in the rig the field is a single band.
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
    """Each band of the fibre is slightly displaced, which shifts its part of the scene."""

    kind: Literal["fibre_bands"]
    place: ClassVar[Place] = "image"
    rank: ClassVar[float] = 60
    shift_pixels: float = Field(gt=0, le=16, description="standard deviation along either axis, fine pixels")

    def stages(self, setting: Setting) -> list[Stage]:
        """X(r, c) ← X(r − Δr, c − Δc) within each band, bilinear, with Δr, Δc ~ N(0, shift_pixels).

        The shifts are fixed per arm and band. Beyond the simulated square, the values at its edge continue.
        """
        from scipy.ndimage import shift

        side, edges = setting.scene.size, _edges(setting)
        drawn = pattern("fibre_bands", setting).standard_normal((len(edges), 2)) * self.shift_pixels
        axis = 1 if setting.arm == "a" else 2

        def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
            shifted = frames.copy()
            for (begin, end), offset in zip(edges, drawn, strict=True):
                # The band with enough of its neighbourhood for the shift.
                margin = ceil(abs(offset[axis - 1])) + 1
                low, high = max(0, begin - margin), min(side, end + margin)
                part = shift(_band(frames, axis, low, high), (0, *offset), order=1, mode="nearest")
                _band(shifted, axis, begin, end)[:] = _band(part, axis, begin - low, end - low)
            return shifted

        return [Stage("fibre_bands", "image", run)]


class FibreGain(Effect):
    """Fibres transmit different fractions of the light: a gain per column, and one per fibre."""

    kind: Literal["fibre_gain"]
    place: ClassVar[Place] = "image"
    rank: ClassVar[float] = 70
    columns: Part = Field(
        default=0.0, description="standard deviation of the gain of all fibres that end on a column"
    )
    fibres: Part = Field(
        default=0.0,
        description="standard deviation of the gain of single fibres; a line averages over all on its column",
    )

    def stages(self, setting: Setting) -> list[Stage]:
        """X ← X·max(0, 1 + N(0, columns)[band, along] + N(0, fibres)[r, c]), fixed per arm.

        ``along`` is the position along the band: the scene's column on arm A, its row on arm B.
        """
        side, edges = setting.scene.size, _edges(setting)
        drawn = pattern("fibre_gain", setting)
        along_a, gain = setting.arm == "a", np.ones((side, side), np.float32)
        for begin, end in edges:
            column_gain = (self.columns * drawn.standard_normal(side)).astype(np.float32)
            if along_a:
                gain[begin:end] += column_gain
            else:
                gain[:, begin:end] += column_gain[:, None]
        # per pixel of the scene, each of which has a fibre of its own
        gain += self.fibres * drawn.standard_normal((side, side)).astype(np.float32)
        np.maximum(gain, 0, out=gain)

        def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
            dimmed: NDArray[np.float32] = frames * gain
            return dimmed

        return [Stage("fibre_gain", "image", run)]


def _edges(setting: Setting) -> list[tuple[int, int]]:
    """Return first and end row (arm A) or column (arm B) of each band in the simulated square."""
    fibre, side = setting.fibre, setting.scene.size
    if fibre is None:
        return [(0, side)]
    start = fibre.field()[0 if setting.arm == "a" else 1].start
    count = len(fibre.bands(setting.arm))
    return [(start + number * fibre.size, start + (number + 1) * fibre.size) for number in range(count)]


def _band(frames: NDArray[np.float32], axis: int, begin: int, end: int) -> NDArray[np.float32]:
    """Return a view of frames (t, r, c) from row or column ``begin`` to ``end``."""
    return frames[:, begin:end] if axis == 1 else frames[:, :, begin:end]
