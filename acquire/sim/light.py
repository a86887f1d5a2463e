"""The light that sources give: the exposure code AND each source's own drive.

::

    code bits (t) ──────┐
                         ×──▶ light (k, t) ──▶ what the effects of the sources make of it
    drives (k, t) ──────┘

A scene of K driven masks has K sources; any other scene stands in the light of a single one.
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

Series = Callable[[int, int], "NDArray[Any]"]
"""(first sub-step, count) → values, time on the last axis."""


@dataclass(frozen=True, slots=True)
class Illumination:
    """Light of K sources, asked for by stretches of sub-steps.

    ``bits`` (count,) is what of the code reaches the sources, ``drives`` (K, count) what each of them would
    give, ``light`` (K, count) what they give.
    """

    bits: Series
    drives: Series
    light: Series

    @classmethod
    def of(cls, scene: Scene, code: Code) -> Illumination:
        """Ideal sources: light = drive · bit."""
        drives: Series = scene.intensity if isinstance(scene, SeparableScene) else _one_source
        return cls.gated(code.bits, drives)

    @classmethod
    def gated(cls, bits: Series, drives: Series) -> Illumination:
        """Code AND drive."""
        return cls(bits, drives, lambda first, count: drives(first, count) * bits(first, count))

    def on_for(self, part: float) -> Illumination:
        """The same sources, on for a part of every lit sub-step."""
        if part == 1:
            return self
        whole = self.light
        return replace(self, light=lambda first, count: whole(first, count) * part)


class Tiled:
    """A series computed by tiles at fixed places, so that nothing depends on how it is asked for.

    The last tiles are kept for the call that continues in them.
    """

    def __init__(self, compute: Series, length: int = 1024, kept: int = 4) -> None:
        self._compute, self._length, self._kept = compute, length, kept
        self._tiles: dict[int, NDArray[Any]] = {}

    def __call__(self, first: int, count: int) -> NDArray[Any]:
        tiles = [self._tile(i) for i in range(first // self._length, (first + count - 1) // self._length + 1)]
        skip = first % self._length
        values: NDArray[Any] = np.concatenate(tiles, axis=-1)[..., skip : skip + count]
        return values

    def _tile(self, index: int) -> NDArray[Any]:
        if index not in self._tiles:
            self._tiles[index] = self._compute(index * self._length, self._length)
            while len(self._tiles) > self._kept:
                del self._tiles[next(iter(self._tiles))]
        return self._tiles[index]


def _one_source(first: int, count: int) -> NDArray[Any]:  # noqa: ARG001  # a series
    return np.ones((1, count))
