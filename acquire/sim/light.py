"""The light of the sources: the exposure code AND each source's own drive.

::

    code bits (t) ──────┐
                         ×──▶ light (k, t) ──▶ the effects on the sources
    drives (k, t) ──────┘

A scene of K driven masks has K sources; any other scene is lit by a single one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.sim.scene import SeparableScene

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.codes import Code
    from acquire.sim.scene import Scene

_LARGEST = np.float32(np.finfo(np.float32).max).view(np.uint32)
Series = Callable[[int, int], "NDArray[Any]"]
"""(first sub-step, count) → values, time on the last axis."""


@dataclass(frozen=True, slots=True)
class Illumination:
    """Light of K sources, evaluated over ranges of sub-steps.

    ``bits`` (count,) is the code as it reaches the sources, ``drives`` (K, count) the light that each source
    would emit without the code, and ``light`` (K, count) the light that it does emit.
    """

    bits: Series
    drives: Series
    light: Series

    @classmethod
    def of(cls, scene: Scene, code: Code) -> Illumination:
        """Return ideal sources: light = drive · bit."""
        if isinstance(scene, SeparableScene):
            return cls.gated(code.bits, scene.intensity)
        return cls.gated(code.bits, lambda _first, count: np.ones((1, count)))  # one source, always on

    @classmethod
    def gated(cls, bits: Series, drives: Series) -> Illumination:
        """Return sources whose light is code AND drive."""
        return cls(bits, drives, lambda first, count: drives(first, count) * bits(first, count))

    def on_for(self, part: float) -> Illumination:
        """Return the same sources, on for the fraction ``part`` of every lit sub-step."""
        if part == 1:
            return self
        whole = self.light
        return replace(self, light=lambda first, count: whole(first, count) * part)


class Tiled:
    """A series computed in tiles at fixed positions, so that values do not depend on the split into calls.

    The most recent tiles are kept, because the next call usually continues in them.
    """

    def __init__(self, compute: Series, length: int = 1024, kept: int = 4) -> None:
        self._compute, self._length, self._kept = compute, length, kept
        self._tiles: dict[int, NDArray[Any]] = {}

    def __call__(self, first: int, count: int) -> NDArray[Any]:
        tiles = []
        for index in range(first // self._length, (first + count - 1) // self._length + 1):
            if index not in self._tiles:
                self._tiles[index] = self._compute(index * self._length, self._length)
                while len(self._tiles) > self._kept:
                    del self._tiles[next(iter(self._tiles))]  # the oldest
            tiles.append(self._tiles[index])
        skip = first % self._length
        values: NDArray[Any] = np.concatenate(tiles, axis=-1)[..., skip : skip + count]
        return values


def first_unfit(light: NDArray[Any]) -> tuple[int, ...] | None:
    """Return the index of the first value that is negative, infinite or not a number; None if none is."""
    # One pass over the bits of float32: a sign, an infinity and a NaN are all above the largest number. So is
    # -0.0, which is then found to be fit. A comparison and a test for finite numbers take six times as long.
    by_bits = light.dtype == np.float32 and light.flags.c_contiguous
    if not light.size or (by_bits and light.view(np.uint32).max() <= _LARGEST):
        return None
    unfit = np.flatnonzero(~((light >= 0) & np.isfinite(light)))
    return tuple(int(i) for i in np.unravel_index(unfit[0], light.shape)) if len(unfit) else None
