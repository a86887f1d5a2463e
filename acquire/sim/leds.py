"""LEDs behind masks, each with its own drive (Fig. 9)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field, model_validator

from acquire.config.base import FrozenModel
from acquire.config.scene import DriveConfig
from acquire.sim.drives import mean_drive
from acquire.sim.scene import MaskScene, SceneModel
from acquire.sim.shapes import coverage

if TYPE_CHECKING:
    from numpy.typing import NDArray


_EDGE = 2
"""Pixels by which a shape's smooth edge can extend beyond its bounding square."""


class LedConfig(FrozenModel):
    """One LED behind a mask. Positions and sizes are fractions of the scene's side."""

    name: str
    shape: Literal["x", "triangle", "circle", "equals", "square"]
    row: float = Field(ge=0, le=1, description="centre")
    column: float = Field(ge=0, le=1, description="centre")
    size: float = Field(gt=0, le=1, description="side of the bounding square")
    drive: DriveConfig
    saturation: float | None = Field(
        default=None,
        ge=1e-6,
        description="drive at which the LED reaches 1 − 1/e of its asymptote; absent: linear",
    )


class LedSceneConfig(SceneModel):
    """LEDs behind masks, each with its own drive (Fig. 9)."""

    kind: Literal["leds"]
    leds: tuple[LedConfig, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _names_differ(self) -> LedSceneConfig:
        names = [led.name for led in self.leds]
        if len(set(names)) < len(names):
            raise ValueError(f"LEDs must have different names, not {', '.join(names)}")
        return self

    def build(self, size: int, substep_s: float) -> LedScene:
        return LedScene(self.leds, size, substep_s)

    @property
    def sources(self) -> int:
        return len(self.leds)


class LedScene(MaskScene):
    """LEDs behind masks, each with its own drive (Fig. 9).

    Parameters
    ----------
    leds : shapes, positions and drives
    size : n, rows and columns of the scene
    substep_s : duration of a sub-step in seconds of simulated time
    """

    def __init__(self, leds: tuple[LedConfig, ...], size: int, substep_s: float) -> None:
        self.leds = leds
        self.substep_s = substep_s
        self.masks = np.zeros((len(leds), size, size), np.float32)
        centre = (np.arange(size) + 0.5) / size
        for mask, led in zip(self.masks, leds, strict=True):
            # Only the square around the shape is computed: the rest of the mask's memory stays untouched.
            rows, columns = _extent(led.row, led.size, size), _extent(led.column, led.size, size)
            row, column = (centre[rows] - led.row) / led.size, (centre[columns] - led.column) / led.size
            # in the shape's own unit, the side of its bounding square
            pixel = 1 / (led.size * size)
            mask[rows, columns] = coverage(led.shape, row[:, None], column[None, :], pixel=pixel)

    def intensity(self, first: int, count: int, substep_s: float | None = None) -> NDArray[np.float64]:
        """Return the mean light of each LED over each sub-step: (K, count)."""
        intensities = []
        for led in self.leds:
            light = mean_drive(led.drive, first, count, substep_s or self.substep_s)
            if led.saturation is not None:
                # a·(1 − exp(−d/a)) for a duty cycle of d: d where it is small, and never more than a. Of the
                # mean over the sub-step, because the driver smooths the PWM well before it reaches the LED.
                light = -led.saturation * np.expm1(-light / led.saturation)
            intensities.append(light)
        return np.stack(intensities)


def _extent(centre: float, side: float, size: int) -> slice:
    """Return the pixels along one axis that a shape may cover, including its smooth edge."""
    first, last = (centre - side / 2) * size, (centre + side / 2) * size
    return slice(max(0, int(first) - _EDGE), min(size, int(last) + 1 + _EDGE))
