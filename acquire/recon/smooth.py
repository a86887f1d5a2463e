"""Quadratic priors of a volume: what flows is smooth in space and time, and has no edges.

In cosines of rows, columns and time, they are a penalty of each coefficient, and their prox is Wiener's
filter.
"""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from acquire.arrays import Arrays, namespace
from acquire.errors import UsageError
from acquire.recon.basis import TemporalBasis
from acquire.recon.volume import one_weight

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.arrays import Array


class Wiener:
    """A quadratic penalty in cosines of space and time, as a denoiser of coefficients (K, row, column).

    ``penalty`` of K and n′, coefficient frames and pixels of a side, is that of each coefficient (K, n′, n′).
    """

    def __init__(self, penalty: Callable[[int, int], NDArray[np.float64]]) -> None:
        self._penalty = penalty
        self._made: tuple[Array, Array] | None = None
        """The cosines of a frame's side (n′, n′) and the penalty, held as the frames are."""

    def prox(self, frames: Array, weight: float | Array) -> Array:
        """argmin_θ ½‖θ − frames‖² + weight/2·Σ penalty·θ̂² with the cosines θ̂ of θ; one weight."""
        xp, weight = namespace(frames), one_weight(weight)
        if self._made is None:
            count, side, _ = frames.shape
            made = cosines_across(side), self._penalty(count, side)
            across, penalty = (xp.asarray(x, dtype=frames.dtype, device=frames.device) for x in made)
            self._made = across, penalty
        across, penalty = self._made
        # Frames are square: rows and columns have the same cosines.
        spectrum = across @ frames @ across.T
        # Without a weight, the way there and back would only round.
        return across.T @ (spectrum / (1 + weight * penalty)) @ across if weight else xp.asarray(frames)


class Smooth(Wiener):
    """Quadratic penalty of second differences along rows, columns and time: a prior for flames and fog.

    weight/2·‖(∂²/∂row² + ∂²/∂column² + (μ·∂/∂t)²)·x‖²
    """

    def __init__(self, pace: float = 1.0) -> None:
        if not 0 <= pace < math.inf:
            raise UsageError(f"a smooth volume cannot have pace {pace}", possible="a number of at least 0")
        super().__init__(partial(second_differences, pace))


def second_differences(pace: float, count: int, side: int) -> NDArray[np.float64]:
    """(k_r² + k_c² + μ²·k_t²)² in radians per pixel; the time axis counts as long as a side."""
    k = np.square(np.pi * np.arange(side) / side)
    t = np.square(pace * np.pi * np.arange(count) / side)
    return np.asarray(np.square(t[:, None, None] + k[:, None] + k))


def cosines_across(side: int) -> NDArray[np.float64]:
    """The orthonormal cosines of a frame's side (n′, n′)."""
    return TemporalBasis(side, side, Arrays(dtype="float64")).matrix()
