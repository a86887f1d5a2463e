"""What simulated cameras look at: scenes sampled sub-step by sub-step, wherever in time they are asked.

A scene has no beginning: sub-steps before the run (negative) exist too, it shines on and the light's code
alone is dark. Values do not depend on how a stretch of sub-steps is split into calls.

LEDs behind masks are *separable*: ``X[t, r, c] = Σ_k intensity[k, t] · mask[k, r, c]``, which the streaming
simulation turns into small matrix products.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from acquire.config import ConstantDrive, SineDrive
from acquire.errors import UsageError
from acquire.sim.shapes import coverage

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.config import LedConfig, SceneConfig

    Drive = SineDrive | ConstantDrive


class Scene(Protocol):
    """A square scene of ``size`` rows and columns, as camera A sees it; light in arbitrary units."""

    @property
    def size(self) -> int: ...

    def frames(self, first: int, count: int) -> NDArray[np.float32]:
        """Mean light during sub-steps ``first .. first + count - 1``: (count, row, column) float32."""
        ...


@runtime_checkable
class SeparableScene(Scene, Protocol):
    """A scene of K fixed masks, each with one intensity."""

    @property
    def masks(self) -> NDArray[np.float32]:
        """(K, row, column), 0 to 1."""
        ...

    def intensity(self, first: int, count: int) -> NDArray[np.float64]:
        """(K, count): mean over each sub-step."""
        ...


class LedScene:
    """LEDs behind masks, each with its own drive (Fig. 9).

    Parameters
    ----------
    leds : shapes, places and drives
    size : n, rows and columns of the scene
    substep_s : duration of a sub-step in seconds of simulated time
    """

    def __init__(self, leds: tuple[LedConfig, ...], size: int, substep_s: float) -> None:
        self.leds = leds
        self.size = size
        self.substep_s = substep_s
        self.masks: NDArray[np.float32] = np.stack([_mask(led, size) for led in leds])

    def intensity(self, first: int, count: int) -> NDArray[np.float64]:
        """(K, count): light of each LED, mean over each sub-step."""
        substep = np.arange(first, first + count)
        return np.stack([_light(led, substep, self.substep_s) for led in self.leds])

    def frames(self, first: int, count: int) -> NDArray[np.float32]:
        """(count, row, column) float32."""
        intensity = self.intensity(first, count).astype(np.float32)
        frames = np.zeros((count, self.size, self.size), np.float32)
        for mask, light in zip(self.masks, intensity, strict=True):
            frames += light[:, None, None] * mask
        return frames


class ArrayScene:
    """A given video (time, row, column), one frame per sub-step, in a loop.

    The loop runs in both directions from sub-step 0, so that a run of any length has something to see.
    """

    def __init__(self, video: NDArray[Any]) -> None:
        if video.ndim != 3 or 0 in video.shape or video.shape[1] != video.shape[2]:
            raise UsageError(f"video of shape {video.shape}", possible="(time, n, n), nothing empty")
        self.video = video

    @property
    def size(self) -> int:
        return int(self.video.shape[1])

    def frames(self, first: int, count: int) -> NDArray[np.float32]:
        """(count, row, column) float32."""
        return self.video[np.arange(first, first + count) % len(self.video)].astype(np.float32)


def build_scene(config: SceneConfig, size: int, substep_s: float) -> Scene:
    """The scene that a configuration describes, at ``size`` rows and columns."""
    return LedScene(config.leds, size, substep_s)


def _mask(led: LedConfig, size: int) -> NDArray[np.float32]:
    """(row, column): how far each pixel of the scene is covered by the LED's shape, 0 to 1."""
    centre = (np.arange(size) + 0.5) / size
    row, column = (centre - led.row) / led.size, (centre - led.column) / led.size
    return coverage(led.shape, row[:, None], column[None, :], pixel=1 / (led.size * size))


def _light(led: LedConfig, substep: NDArray[np.int64], substep_s: float) -> NDArray[np.float64]:
    """Light of an LED from its duty cycle d: d, or a·(1 − exp(−d/a)) when it saturates at a.

    For small d both are d; the saturating LED never exceeds a and gives (1 − 1/e)·a at d = a. Saturation
    acts on the mean over the sub-step: the driver smoothes the PWM long before the LED sees it.
    """
    duty = _duty(led.drive, substep, substep_s)
    if led.saturation is None:
        return duty
    light: NDArray[np.float64] = -led.saturation * np.expm1(-duty / led.saturation)
    return light


def _duty(drive: Drive, substep: NDArray[np.int64], substep_s: float) -> NDArray[np.float64]:
    """Mean duty cycle over each sub-step, exactly.

    The mean of sin over a sub-step is its value at the middle times sinc(f·dt). The middle alone would
    overrate fast drives: at 5 kHz and 10 µs by 0.4 %, at a whole period per sub-step by everything.
    Whole cycles are dropped before the sine is taken: its argument stays small, and hours into a run the
    phase is still good to 1e-6.
    """
    if isinstance(drive, ConstantDrive):
        return np.full(substep.shape, drive.level)
    cycles_per_substep = drive.frequency_hz * substep_s
    cycles = ((substep + 0.5) * cycles_per_substep + drive.phase_deg / 360) % 1.0
    mean: NDArray[np.float64] = np.sinc(cycles_per_substep) * np.sin(2 * np.pi * cycles)
    return drive.low + (drive.high - drive.low) * (1 + mean) / 2
