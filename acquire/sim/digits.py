"""Seven-segment displays whose digits fade in and out (Fig. 10).

::

      ─a─
     f   b      every period shows the next digit of its display; the light of its segments
      ─g─       rises from 0 to 1 and falls back, a triangle
     e   c
      ─d─

Each segment is one source: its intensity is the sum of the triangles of the digits that light it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from acquire.config.base import FrozenModel
from acquire.config.scene import Fraction
from acquire.sim.drives import phase, triangle_within
from acquire.sim.scene import MaskScene, SceneModel
from acquire.sim.targets import overlap

if TYPE_CHECKING:
    from numpy.typing import NDArray

SEGMENTS = ("abcdef", "bc", "abdeg", "abcdg", "bcfg", "acdfg", "acdefg", "abc", "abcdefg", "abcdfg")
"""Segments of each digit."""

_WIDTH = 0.58
_STROKE = 0.12
_PLACES = {
    "a": (0.0, _STROKE, _STROKE, _WIDTH - 2 * _STROKE),
    "b": (_STROKE, _WIDTH - _STROKE, 0.5 - 1.5 * _STROKE, _STROKE),
    "c": (0.5 + _STROKE / 2, _WIDTH - _STROKE, 0.5 - 1.5 * _STROKE, _STROKE),
    "d": (1 - _STROKE, _STROKE, _STROKE, _WIDTH - 2 * _STROKE),
    "e": (0.5 + _STROKE / 2, 0.0, 0.5 - 1.5 * _STROKE, _STROKE),
    "f": (_STROKE, 0.0, 0.5 - 1.5 * _STROKE, _STROKE),
    "g": (0.5 - _STROKE / 2, _STROKE, _STROKE, _WIDTH - 2 * _STROKE),
}
"""Segment → top, left, height, width, from the digit's corner, in units of its height."""


class DisplayConfig(FrozenModel):
    """One seven-segment display: one digit per period, with an intensity that is a triangle 0 → 1 → 0."""

    digits: str = Field(pattern=r"^[0-9]+$", description="shown one after another, in a loop")
    row: Fraction = 0.5
    column: Fraction
    height: float = Field(default=0.7, gt=0, le=1, description="height of the digit; its width is 0.58 of it")
    phase_deg: float = Field(default=0.0, description="phase in degrees of the display's period")


class DigitsSceneConfig(SceneModel):
    """Seven-segment displays whose digits fade in and out with triangular intensity (Fig. 10)."""

    kind: Literal["digits"]
    period_s: float = Field(default=1.28e-3, gt=0)
    displays: tuple[DisplayConfig, ...] = Field(min_length=1)

    def build(self, size: int, substep_s: float) -> DigitScene:
        return DigitScene(self.displays, self.period_s, size, substep_s)


class DigitScene(MaskScene):
    """Displays side by side; ``period_s`` is the duration of one digit."""

    def __init__(
        self, displays: tuple[DisplayConfig, ...], period_s: float, size: int, substep_s: float
    ) -> None:
        self._displays, self._period_s, self._substep_s = displays, period_s, substep_s
        self.segments = [
            (display, name) for display in displays for name in _PLACES if bool(_shows(display, name).any())
        ]
        masks = []
        for display, name in self.segments:
            top, left, height, width = (display.height * length for length in _PLACES[name])
            top += display.row - display.height / 2
            left += display.column - display.height * _WIDTH / 2
            # the fraction of each pixel that the segment covers
            covered = overlap(size, top, height)[:, None] * overlap(size, left, width)
            masks.append(covered.astype(np.float32))
        self.masks = np.stack(masks)

    def intensity(self, first: int, count: int, substep_s: float | None = None) -> NDArray[np.float64]:
        """Return the intensity of each of the K segments: (K, count)."""
        step = (substep_s or self._substep_s) / self._period_s
        light = {}
        for display in self._displays:
            loop = len(display.digits)
            # by the loop's cycles, so that whole loops are dropped and the phase stays exact (`drives`)
            begin = phase(first, count, step / loop, display.phase_deg / loop) * loop
            # (digit, sub-step): time since each digit of the loop began, in periods
            at = begin - np.arange(loop)[:, None]
            # A sub-step may reach into the next loop, and may be longer than a whole one.
            rounds = range(int(np.ceil(step / loop)) + 1)
            areas = [
                triangle_within(at + step - turn * loop) - triangle_within(at - turn * loop)
                for turn in rounds
            ]
            light[display] = np.sum(areas, axis=0) / step
        return np.stack(
            [light[display][_shows(display, name)].sum(axis=0) for display, name in self.segments]
        )


def _shows(display: DisplayConfig, name: str) -> NDArray[np.bool_]:
    """Return for each of the display's digits whether it lights the segment: (digit,)."""
    return np.array([name in SEGMENTS[int(digit)] for digit in display.digits])
