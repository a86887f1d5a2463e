"""Effects of the optics: what the image on the sensor is of the scene.

They are linear and do not change with time, so a separable scene pays once for its masks, any other
for every frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from acquire.alignment import Alignment
from acquire.config.base import Part, Positive
from acquire.sim.effects.base import Effect, Place, Setting, Stage

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Misregistration(Effect):
    """The image of one arm lies off by fractions of a fine pixel (bilinear), is turned, or is larger."""

    kind: Literal["misregistration"]
    place: ClassVar[Place] = "image"
    rank: ClassVar[float] = 10
    arm: Literal["a", "b"] = "b"
    rows: float = Field(default=0.0, ge=-64, le=64, description="fine pixels downwards, in arm A's view")
    columns: float = Field(default=0.0, ge=-64, le=64, description="fine pixels to the right")
    turn_deg: float = Field(default=0.0, ge=-45, le=45, description="counter-clockwise about the centre")
    magnification: float = Field(default=1.0, ge=0.5, le=2, description="about the centre")
    beyond: Literal["dark", "edge"] = Field(
        default="dark", description="what lies beyond the field: nothing, or what is at its edge"
    )

    def stages(self, setting: Setting) -> list[Stage]:
        """The image of ``arm`` magnified and turned about its middle, then shifted, bilinear; from outside
        comes in what is ``beyond``. The map is that of `acquire.alignment.Alignment`.
        """
        if setting.arm != self.arm:
            return []
        from scipy.ndimage import affine_transform

        alignment = Alignment(self.rows, self.columns, self.turn_deg, self.magnification)
        back = np.linalg.inv(alignment.matrix)
        # not "constant", which makes a pixel that reaches over the edge by a hundredth wholly dark
        mode: Literal["nearest", "grid-constant"] = "nearest" if self.beyond == "edge" else "grid-constant"
        middle = np.full(2, (setting.scene.size - 1) / 2)
        offset = middle - back @ (middle + np.array([self.rows, self.columns]))

        def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
            moved = np.empty_like(frames)
            for frame, out in zip(frames, moved, strict=True):
                affine_transform(frame, back, offset, output=out, order=1, mode=mode)
            return moved

        return [Stage("misregistration", "image", run)]


class PointSpread(Effect):
    """A Gaussian point spread function, of both arms or each its own."""

    kind: Literal["psf"]
    place: ClassVar[Place] = "image"
    rank: ClassVar[float] = 40
    sigma_pixels: Positive = Field(description="standard deviation in fine pixels")
    sigma_b_pixels: Positive | None = Field(default=None, description="that of arm B; absent: the same")

    def stages(self, setting: Setting) -> list[Stage]:
        """Convolution with a normalised Gaussian of σ fine pixels, cut off at 4σ; light may leave."""
        from scipy.ndimage import gaussian_filter1d

        of_b = self.sigma_b_pixels if setting.arm == "b" else None
        sigma = self.sigma_pixels if of_b is None else of_b

        def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
            along = gaussian_filter1d(frames, sigma, axis=1, mode="constant")
            blurred: NDArray[np.float32] = gaussian_filter1d(along, sigma, axis=2, mode="constant")
            return blurred

        return [Stage("psf", "image", run)]


class StrayLight(Effect):
    """Light where none belongs: a veil made of the scene's own, and steady light that no code switches."""

    kind: Literal["stray_light"]
    place: ClassVar[Place] = "image"
    rank: ClassVar[float] = 50
    veil: Part = Field(default=0.0, description="part of the scene's light that is spread evenly")
    ambient: float = Field(default=0.0, ge=0, description="in units of the scene's light")

    def stages(self, setting: Setting) -> list[Stage]:
        """Veil v: X ← (1 − v)·X + v·mean(X). Ambient light a: Y ← Y + a·n·S², in every line, coded or not."""
        stages = []
        if self.veil:
            veil = np.float32(self.veil)

            def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
                mean = frames.mean(axis=(1, 2), keepdims=True)
                veiled: NDArray[np.float32] = (1 - veil) * frames + veil * mean
                return veiled

            stages.append(Stage("stray_light", "image", run))
        if self.ambient:
            n, S = setting.stages * setting.substeps, setting.substeps
            steady = self.ambient * n * S**2

            def add(lines: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
                return lines + steady

            stages.append(Stage("stray_light", "signal", add))
        return stages
