"""Effects of the optics on the image of the scene.

They are linear and constant in time, so a separable scene is mapped once, by its masks, and any other scene
frame by frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from acquire.alignment import Alignment
from acquire.config.base import Part
from acquire.sim.effects.base import Effect, Place, Setting, Stage

if TYPE_CHECKING:
    from numpy.typing import NDArray


Blur = Annotated[float, Field(ge=0.01, le=1024)]
"""From no pixel of blur at all to the width of the largest scenes."""


class Misregistration(Effect):
    """The image of one arm is shifted by fractions of a fine pixel, rotated or magnified (bilinear)."""

    kind: Literal["misregistration"]
    place: ClassVar[Place] = "image"
    rank: ClassVar[float] = 10
    arm: Literal["a", "b"] = "b"
    rows: float = Field(default=0.0, ge=-64, le=64, description="fine pixels downwards, in arm A's view")
    columns: float = Field(default=0.0, ge=-64, le=64, description="fine pixels to the right")
    turn_deg: float = Field(default=0.0, ge=-45, le=45, description="counter-clockwise about the centre")
    magnification: float = Field(default=1.0, ge=0.5, le=2, description="about the centre")
    beyond: Literal["dark", "edge"] = Field(
        default="dark", description="light from beyond the field: none, or the values at its edge"
    )

    def stages(self, setting: Setting) -> list[Stage]:
        """Magnify and rotate the image of ``arm`` about its centre, then shift it, bilinear.

        ``beyond`` supplies the light from outside the field. The map is that of
        `acquire.alignment.Alignment`.
        """
        if setting.arm != self.arm:
            return []
        from scipy.ndimage import affine_transform

        alignment = Alignment(self.rows, self.columns, self.turn_deg, self.magnification)
        # scipy asks for the source of each pixel of the result, which is the map backwards.
        inverse = np.linalg.inv(alignment.matrix)
        # Not "constant", with which a pixel that extends beyond the edge by a hundredth is entirely dark.
        mode: Literal["nearest", "grid-constant"] = "nearest" if self.beyond == "edge" else "grid-constant"
        centre = np.full(2, (setting.scene.size - 1) / 2)
        offset = centre - inverse @ (centre + np.array([self.rows, self.columns]))

        def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
            displaced = np.empty_like(frames)
            for frame, out in zip(frames, displaced, strict=True):
                affine_transform(frame, inverse, offset, output=out, order=1, mode=mode)
            return displaced

        return [Stage("misregistration", "image", run)]


class PointSpread(Effect):
    """A Gaussian point spread function, the same for both arms or one for each."""

    kind: Literal["psf"]
    place: ClassVar[Place] = "image"
    rank: ClassVar[float] = 40
    sigma_pixels: Blur = Field(description="standard deviation in fine pixels")
    sigma_b_pixels: Blur | None = Field(default=None, description="for arm B; absent: sigma_pixels")

    def stages(self, setting: Setting) -> list[Stage]:
        """Convolve with a normalised Gaussian of σ fine pixels, cut off at 4σ; light may leave the field."""
        from scipy.ndimage import gaussian_filter1d

        sigma_b = self.sigma_b_pixels if setting.arm == "b" else None
        sigma = self.sigma_pixels if sigma_b is None else sigma_b

        def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
            # not `gaussian_filter`, which would blur along the first axis, over masks or sub-steps, too
            along = gaussian_filter1d(frames, sigma, axis=1, mode="constant")
            blurred: NDArray[np.float32] = gaussian_filter1d(along, sigma, axis=2, mode="constant")
            return blurred

        return [Stage("psf", "image", run)]


class StrayLight(Effect):
    """Stray light: a veil of the scene's own light, and steady ambient light that no code switches."""

    kind: Literal["stray_light"]
    place: ClassVar[Place] = "image"
    rank: ClassVar[float] = 50
    veil: Part = Field(default=0.0, description="fraction of the scene's light that is spread evenly")
    ambient: float = Field(
        default=0.0, ge=0, le=1e6, description="ambient light in units of the scene's light"
    )

    def stages(self, setting: Setting) -> list[Stage]:
        """Veil v: X ← (1 − v)·X + v·mean(X). Ambient light a: Y ← Y + a·n·S², in every line, coded or not.

        In front of a baseline's sensor, whose scene is k times as fine, that is a·n·S²·k³.
        """
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
            finer = 1 if setting.fibre is not None else setting.scene.size // n
            steady = self.ambient * n * S**2 * finer**3

            def add(lines: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
                return lines + steady

            stages.append(Stage("stray_light", "signal", add))
        return stages
