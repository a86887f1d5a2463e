"""Lines without a scene, at next to no cost, determined by their numbers alone.

Line ``l`` of an arm is row ``l mod rows`` of a table: noise around a profile, like a sensor's, so that a
codec compresses it as it compresses real lines. Every line can be checked independently. The pattern serves
load and endurance tests and the capacity test at arm time, which would otherwise measure the simulation of a
scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.lines import ARMS

if TYPE_CHECKING:
    from numpy.typing import NDArray

_TABLE_BYTES = 1 << 25
"""More than a processor's cache holds, so that copying lines costs as much as with a real camera."""
_MOST_ROWS = 1 << 16
_NOISE_REPEATS = 16
_FULL_WELL = 10_000.0
"""Electrons at the top of the range; the noise, their square root, limits the compression."""


@dataclass(frozen=True, slots=True)
class Pattern:
    """The lines of one arm: ``pixels`` samples of ``dtype`` each, none above ``white_dn`` - 1."""

    arm: str
    pixels: int
    dtype: str
    white_dn: int

    @property
    def rows(self) -> int:
        """Period of the pattern in lines: odd, so that no block's length divides it."""
        return min(_MOST_ROWS, _TABLE_BYTES // (self.pixels * np.dtype(self.dtype).itemsize)) | 1

    def lines(self, first_line: int, count: int) -> NDArray[Any]:
        """Return lines ``first_line .. first_line + count - 1`` (count, pixels), as a view if possible."""
        table, first = _table(self), first_line % self.rows
        if first + count <= len(table):
            return table[first : first + count]
        return table[(first + np.arange(count)) % self.rows]


@cache
def _table(pattern: Pattern) -> NDArray[Any]:
    """Return (row, pixel): one period and half of it again, so that few ranges cross its end."""
    rng = np.random.default_rng(ARMS.index(pattern.arm))
    # Few rows of noise, which are repeated: the drift makes each repetition differ.
    few = pattern.rows // _NOISE_REPEATS + 1
    profile = 0.4 + 0.2 * np.sin(np.linspace(0, 20, pattern.pixels, dtype=np.float32))
    noise = rng.standard_normal((few, pattern.pixels), np.float32) * np.sqrt(profile / _FULL_WELL)
    # Up to 90 % of the range, which leaves the drift the rest: no sample is white.
    dn = ((profile + noise) * pattern.white_dn).clip(1, 0.9 * pattern.white_dn - 1).astype(pattern.dtype)
    drift = np.linspace(0, 0.1 * pattern.white_dn, pattern.rows).astype(pattern.dtype)
    row = np.arange(pattern.rows + pattern.rows // 2) % pattern.rows
    table: NDArray[Any] = dn[row % few] + drift[row, None]
    return table
