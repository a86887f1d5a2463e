"""Effects of an arm's lens. They are linear and do not change with time, as those of `image`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.sim.effects.base import Setting, Stage

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.config import effect as config


def lens_distortion(effect: config.LensDistortion, setting: Setting) -> list[Stage]:
    """What is seen at p shows the scene at p·(1 − k·|p/h|²), from the middle, with half the side h: radial
    distortion of the third order (Brown 1966), bilinear; dark beyond the field.
    """
    if not _concerns(effect.arm, setting):
        return []
    from scipy.ndimage import map_coordinates

    half = setting.scene.size / 2
    middle = (setting.scene.size - 1) / 2
    seen = np.indices((setting.scene.size,) * 2, np.float64) - middle
    source = seen * (1 - effect.part * (seen**2).sum(axis=0) / half**2) + middle

    def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.stack([map_coordinates(frame, source, order=1, mode="constant") for frame in frames])

    return [Stage("lens_distortion", "image", run)]


def vignetting(effect: config.Vignetting, setting: Setting) -> list[Stage]:
    """X ← X·(1 − v·|p − axis|²/(2·h²)), not below 0: the loss v where |p − axis| is half a diagonal."""
    if not _concerns(effect.arm, setting):
        return []
    half, middle = setting.scene.size / 2, (setting.scene.size - 1) / 2
    rows, columns = np.indices((setting.scene.size,) * 2, np.float64) - middle
    away = ((rows - effect.rows) ** 2 + (columns - effect.columns) ** 2) / (2 * half**2)
    left = np.maximum(1 - effect.loss * away, 0).astype(np.float32)

    def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
        dimmed: NDArray[np.float32] = frames * left
        return dimmed

    return [Stage("vignetting", "image", run)]


def _concerns(arm: str, setting: Setting) -> bool:
    return arm in ("both", setting.arm)
