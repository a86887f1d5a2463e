"""Effects of an arm's lens. They are linear and do not change with time, as those of `image`."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from pydantic import Field

from acquire.config.base import Part
from acquire.sim.effects.base import Effect, Place, Setting, Stage

if TYPE_CHECKING:
    from numpy.typing import NDArray


class LensDistortion(Effect):
    """The lens of one arm, or of both, is not true: radial, of the third order, bilinear."""

    kind: Literal["lens_distortion"]
    place: ClassVar[Place] = "image"
    rank: ClassVar[float] = 20
    arm: Literal["a", "b", "both"] = "both"
    part: float = Field(
        ge=-0.2,
        le=0.2,
        description="of half the field, by which the middle of a side is seen too far out; below 0: in",
    )

    def stages(self, setting: Setting) -> list[Stage]:
        """What is seen at p shows the scene at p·(1 − k·|p/h|²), from the middle, with half the side h:
        radial distortion of the third order (Brown 1966), bilinear; dark beyond the field.
        """
        if not _concerns(self.arm, setting):
            return []
        from scipy.ndimage import map_coordinates

        half = setting.scene.size / 2
        middle = (setting.scene.size - 1) / 2
        seen = np.indices((setting.scene.size,) * 2, np.float64) - middle
        source = seen * (1 - self.part * (seen**2).sum(axis=0) / half**2) + middle

        def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
            # not "constant", which makes a pixel that reaches over the edge by a hundredth wholly dark
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
    loss: Part = Field(description="of the light, as far from the axis as a corner is from the middle")
    rows: float = Field(
        default=0.0, ge=-1024, le=1024, description="fine pixels of the axis below the middle"
    )
    columns: float = Field(default=0.0, ge=-1024, le=1024, description="fine pixels to its right")

    def stages(self, setting: Setting) -> list[Stage]:
        """X ← X·(1 − v·|p − axis|²/(2·h²)), not below 0: the loss v where |p − axis| is half a diagonal."""
        if not _concerns(self.arm, setting):
            return []
        half, middle = setting.scene.size / 2, (setting.scene.size - 1) / 2
        rows, columns = np.indices((setting.scene.size,) * 2, np.float64) - middle
        away = ((rows - self.rows) ** 2 + (columns - self.columns) ** 2) / (2 * half**2)
        left = np.maximum(1 - self.loss * away, 0).astype(np.float32)

        def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
            dimmed: NDArray[np.float32] = frames * left
            return dimmed

        return [Stage("vignetting", "image", run)]


def _concerns(arm: str, setting: Setting) -> bool:
    return arm in ("both", setting.arm)
