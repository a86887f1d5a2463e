"""Seven-segment displays whose digits come and go (Fig. 10).

::

      ─a─
     f   b      every period shows the next digit of its display; the light of its segments
      ─g─       rises from 0 to 1 and falls back, a triangle
     e   c
      ─d─

A segment is a source of its own: its intensity is the sum of the triangles of the digits that light it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.sim.drives import phase, triangle_within
from acquire.sim.scene import MaskScene
from acquire.sim.targets import overlap

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.config.scene import DisplayConfig

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
"""Segment → top, left, height, width, in heights of the digit from its corner."""


class DigitScene(MaskScene):
    """Displays side by side; ``period_s`` is what one digit lasts."""

    def __init__(
        self, displays: tuple[DisplayConfig, ...], period_s: float, size: int, substep_s: float
    ) -> None:
        self._displays, self._period_s, self._substep_s = displays, period_s, substep_s
        self.segments = [(display, name) for display in displays for name in _PLACES if _used(display, name)]
        self.masks = np.stack([_segment(display, name, size) for display, name in self.segments])

    def intensity(self, first: int, count: int, substep_s: float | None = None) -> NDArray[np.float64]:
        """(K, count), K segments."""
        step = (substep_s or self._substep_s) / self._period_s
        light = {display: _digit_light(display, first, count, step) for display in self._displays}
        return np.stack(
            [light[display][_shows(display, name)].sum(axis=0) for display, name in self.segments]
        )


def _shows(display: DisplayConfig, name: str) -> NDArray[np.bool_]:
    """(digit): whether the display's digits light the segment."""
    return np.array([name in SEGMENTS[int(digit)] for digit in display.digits])


def _used(display: DisplayConfig, name: str) -> bool:
    return bool(_shows(display, name).any())


def _digit_light(display: DisplayConfig, first: int, count: int, step: float) -> NDArray[np.float64]:
    """(digit, count): mean light over each sub-step of the triangle of every digit of the loop."""
    loop = len(display.digits)
    begin = phase(first, count, step / loop, display.phase_deg / loop) * loop
    at = begin - np.arange(loop)[:, None]
    rounds = range(int(np.ceil(step / loop)) + 1)
    area = sum(
        triangle_within(at + step - turn * loop) - triangle_within(at - turn * loop) for turn in rounds
    )
    mean: NDArray[np.float64] = np.asarray(area) / step
    return mean


def _segment(display: DisplayConfig, name: str, size: int) -> NDArray[np.float32]:
    top, left, height, width = (display.height * length for length in _PLACES[name])
    top += display.row - display.height / 2
    left += display.column - display.height * _WIDTH / 2
    covered = overlap(size, top, height)[:, None] * overlap(size, left, width)
    return covered.astype(np.float32)
