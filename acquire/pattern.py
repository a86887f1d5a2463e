"""Lines without a scene, at next to no cost, which follow from their numbers alone.

Line ``l`` of an arm is row ``l mod rows`` of a table: noise around a profile, as a sensor has it, which a
codec packs as it packs real lines. Any line can be checked by itself. For loads, endurance and the proof
at arm time, where computing a scene would be what is measured.
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
"""More than a processor's cache holds: copying lines costs what it costs with a real camera."""
_MOST_ROWS = 1 << 16
_NOISE_REPEATS = 16
_FULL_WELL = 10_000.0
"""Electrons at the top of the range: what noise there is (its root) sets what can be packed."""


@dataclass(frozen=True, slots=True)
class Pattern:
    """The lines of one arm: ``pixels`` samples of ``dtype``, none above ``white_dn`` - 1."""

    arm: str
    pixels: int
    dtype: str
    white_dn: int

    @property
    def rows(self) -> int:
        """Lines after which the pattern repeats: odd, so that no block's length divides it."""
        return min(_MOST_ROWS, _TABLE_BYTES // (self.pixels * np.dtype(self.dtype).itemsize)) | 1

    def lines(self, first_line: int, count: int) -> NDArray[Any]:
        """Lines ``first_line .. first_line + count - 1`` (count, pixels); a view wherever it can be one."""
        table, first = _table(self), first_line % self.rows
        if first + count <= len(table):
            return table[first : first + count]
        return table[(first + np.arange(count)) % self.rows]


@cache
def _table(pattern: Pattern) -> NDArray[Any]:
    """(row, pixel): one round, and half of it again so that few stretches meet its end."""
    rng = np.random.default_rng(ARMS.index(pattern.arm))
    few = pattern.rows // _NOISE_REPEATS + 1
    profile = 0.4 + 0.2 * np.sin(np.linspace(0, 20, pattern.pixels, dtype=np.float32))
    noise = rng.standard_normal((few, pattern.pixels), np.float32) * np.sqrt(profile / _FULL_WELL)
    dn = ((profile + noise) * pattern.white_dn).clip(1, 0.9 * pattern.white_dn - 1).astype(pattern.dtype)
    drift = np.linspace(0, 0.1 * pattern.white_dn, pattern.rows).astype(pattern.dtype)
    row = np.arange(pattern.rows + pattern.rows // 2) % pattern.rows
    table: NDArray[Any] = dn[row % few] + drift[row, None]
    return table
