"""Effects of an arm's lens. They are linear and constant in time, like those of `image`."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from pydantic import Field

from acquire.config.base import Part
from acquire.sim.effects.base import Effect, Place, Setting, Stage

if TYPE_CHECKING:
    from numpy.typing import NDArray


class LensDistortion(Effect):
    """Radial distortion of third order by the lens of one arm, or of both (bilinear)."""

    kind: Literal["lens_distortion"]
    place: ClassVar[Place] = "image"
    rank: ClassVar[float] = 20
    arm: Literal["a", "b", "both"] = "both"
    part: float = Field(
        ge=-0.2,
        le=0.2,
        description="outward displacement of the middle of a side, as a fraction of half the field; "
        "below 0: inward",
    )

    def stages(self, setting: Setting) -> list[Stage]:
        """The image at p shows the scene at p·(1 − k·|p/h|²), from the centre, with h half the side.

        This is radial distortion of third order (Brown 1966), bilinear, and dark beyond the field.
        """
        if not _concerns(self.arm, setting):
            return []
        from scipy.ndimage import map_coordinates

        half = setting.scene.size / 2
        centre = (setting.scene.size - 1) / 2
        image = np.indices((setting.scene.size,) * 2, np.float64) - centre
        source = image * (1 - self.part * (image**2).sum(axis=0) / half**2) + centre

        def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
            # Not "constant", with which a pixel that extends beyond the edge by a hundredth is entirely dark.
            return np.stack(
                [map_coordinates(frame, source, order=1, mode="grid-constant") for frame in frames]
            )

        return [Stage("lens_distortion", "image", run)]


class Vignetting(Effect):
    """Less light far from the axis of an arm's lens."""

    kind: Literal["vignetting"]
    place: ClassVar[Place] = "image"
    rank: ClassVar[float] = 30
    arm: Literal["a", "b", "both"] = "both"
    loss: Part = Field(
        description="fraction of light lost at the distance from the axis of a corner from the centre"
    )
    rows: float = Field(
        default=0.0, ge=-1024, le=1024, description="fine pixels from the centre down to the axis"
    )
    columns: float = Field(
        default=0.0, ge=-1024, le=1024, description="fine pixels from the centre to the right to the axis"
    )

    def stages(self, setting: Setting) -> list[Stage]:
        """X ← X·(1 − v·|p − axis|²/(2·h²)), not below 0: the loss is v if |p − axis| is half a diagonal."""
        if not _concerns(self.arm, setting):
            return []
        half, centre = setting.scene.size / 2, (setting.scene.size - 1) / 2
        rows, columns = np.indices((setting.scene.size,) * 2, np.float64) - centre
        distance = ((rows - self.rows) ** 2 + (columns - self.columns) ** 2) / (2 * half**2)
        # Far from an axis outside the field the parabola is below 0.
        transmission = np.maximum(1 - self.loss * distance, 0).astype(np.float32)

        def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
            dimmed: NDArray[np.float32] = frames * transmission
            return dimmed

        return [Stage("vignetting", "image", run)]


def _concerns(arm: str, setting: Setting) -> bool:
    return arm in ("both", setting.arm)
