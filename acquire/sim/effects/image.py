"""Effects of the optics: what the image on the sensor is of the scene.

They are linear and do not change with time, so a separable scene pays once for its masks, any other
for every frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from acquire.alignment import Alignment
from acquire.sim.effects.base import Setting, Stage

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.config import effect as config


def misregistration(effect: config.Misregistration, setting: Setting) -> list[Stage]:
    """The image of ``arm`` magnified and turned about its middle, then shifted, bilinear; from outside comes
    in what is ``beyond``. The map is that of `acquire.alignment.Alignment`.
    """
    if setting.arm != effect.arm:
        return []
    from scipy.ndimage import affine_transform

    alignment = Alignment(effect.rows, effect.columns, effect.turn_deg, effect.magnification)
    back = np.linalg.inv(alignment.matrix)
    mode: Literal["nearest", "constant"] = "nearest" if effect.beyond == "edge" else "constant"
    middle = np.full(2, (setting.scene.size - 1) / 2)
    offset = middle - back @ (middle + np.array([effect.rows, effect.columns]))

    def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
        moved = np.empty_like(frames)
        for frame, out in zip(frames, moved, strict=True):
            affine_transform(frame, back, offset, output=out, order=1, mode=mode)
        return moved

    return [Stage("misregistration", "image", run)]


def psf(effect: config.PointSpread, setting: Setting) -> list[Stage]:  # noqa: ARG001
    """Convolution with a normalised Gaussian of σ fine pixels, cut off at 4σ; light may leave the field."""
    from scipy.ndimage import gaussian_filter1d

    def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
        along = gaussian_filter1d(frames, effect.sigma_pixels, axis=1, mode="constant")
        blurred: NDArray[np.float32] = gaussian_filter1d(along, effect.sigma_pixels, axis=2, mode="constant")
        return blurred

    return [Stage("psf", "image", run)]


def stray_light(effect: config.StrayLight, setting: Setting) -> list[Stage]:
    """Veil v: X ← (1 − v)·X + v·mean(X). Ambient light a: Y ← Y + a·n·S², in every line, coded or not."""
    stages = []
    if effect.veil:
        veil = np.float32(effect.veil)

        def run(frames: NDArray[np.float32]) -> NDArray[np.float32]:
            veiled: NDArray[np.float32] = (1 - veil) * frames + veil * frames.mean(axis=(1, 2), keepdims=True)
            return veiled

        stages.append(Stage("stray_light", "image", run))
    if effect.ambient:
        n, S = setting.stages * setting.substeps, setting.substeps
        steady = effect.ambient * n * S**2

        def add(lines: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
            return lines + steady

        stages.append(Stage("stray_light", "signal", add))
    return stages
