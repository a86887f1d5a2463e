"""A dark ground about lamps: pixels that are held dark unless the lines show light there.

    lit: a tenth of the brightest ─▶ rounds with the others dark ─▶ where light is missing, they are lit, too

Since light is not negative, noise in a dark ground has a positive mean. It is small in every pixel, but adds
up to a percent of the light, which the lamps then lack; and whatever is wrong with a lamp goes into the
ground in its rows and columns. Held dark, the ground takes nothing. A faint lamp or a dim ground is not dark:
what it sends is then missing in the lines, whose residual, taken back to the pixels, exceeds that of noise.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import binary_dilation, uniform_filter

from acquire.arrays import host

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.arrays import Array, Arrays
    from acquire.recon.given import Given
    from acquire.recon.patterns import Patterns, Refinement, Unknowns
    from acquire.recon.problem import Operator

LIT, BRIGHTEST = 0.1, 0.99
"""Amplitude, relative to that of the brightest pixels, above which a pixel is lit at first; and the quantile
that these are. From 0.05 to 0.2 the results differ by less than a decibel: the lines decide on the rest."""
LEAST_DARK = 0.05
"""Share of pixels that have to become dark for a trial."""
BESIDE = 1
"""Pixels about the lit ones that are lit as well: an edge is found to a pixel."""
AVERAGED, DRAWS = 3, 4
"""Side of the squares of pixels whose light is looked for, and number of draws of noise to compare with."""
SAME_NOISE = 9
"""Side of the squares over which the noise is taken to be equal."""


def lit_pixels(found: Patterns) -> NDArray[np.bool_]:
    """The pixels (n, n) in which patterns are not faint, and those beside them."""
    amplitude = np.sqrt(np.square(host(found.patterns), dtype=np.float64).sum(0))
    return _with_neighbours(amplitude > LIT * np.quantile(amplitude, BRIGHTEST))


def with_light_missing(given: Given, refinement: Refinement, lit: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The ``lit`` pixels and those of the dark ones (n, n) where the lines show light that is not explained.

    The residual, taken back to the patterns, is compared with the same residual with random signs: noise is
    as likely with either sign, but light that is missing has the same sign in all its lines.
    """
    # The same draws every time: equal lines give equal videos.
    problem, rng = given.problem, np.random.default_rng(0)
    residual = np.where(problem.weight > 0, problem.samples - refinement.predict(), 0)
    light = _taken_back(refinement, residual)
    draws = [_taken_back(refinement, residual * rng.choice([-1, 1], residual.shape)) for _ in range(DRAWS)]
    variance = uniform_filter(np.mean(np.square(draws), 0), (0, SAME_NOISE, SAME_NOISE))
    # No line sees some of the pixels: without noise or light, they are no evidence.
    variance += np.finfo(variance.dtype).tiny

    def relative(each: NDArray[Any]) -> NDArray[Any]:
        squares: NDArray[Any] = (np.square(each) / variance).sum(0)
        return squares

    # Thousands of pixels are compared: what noise reaches in any of them, in any draw, is no light.
    chance = max(relative(draw)[~lit].max(initial=0) for draw in draws)
    return lit | _with_neighbours(~lit & (relative(light) > chance))


def _taken_back(refinement: Refinement, lines: NDArray[Any]) -> NDArray[Any]:
    """Bᵀ of lines in the patterns, averaged over squares of pixels."""
    return np.asarray(uniform_filter(refinement.taken_back(lines), (0, AVERAGED, AVERAGED), mode="constant"))


def _with_neighbours(pixels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.asarray(binary_dilation(pixels, iterations=BESIDE))


def gains_darkness(unknowns: Unknowns, lit: NDArray[np.bool_]) -> bool:
    """Whether enough pixels would be dark if only the ``lit`` ones (n, n) were not, and more than are now."""
    now = unknowns.lit.mean() if isinstance(unknowns, LitPixels) else 1.0
    return bool(now - lit.mean() >= LEAST_DARK)


def in_pixels(given: Given, unknowns: Unknowns, lit: NDArray[np.bool_]) -> LitPixels:
    """The unknowns with patterns that are dark in all but the ``lit`` pixels (n, n)."""
    free = unknowns.free if isinstance(unknowns, LitPixels) else unknowns
    return LitPixels(free, lit, given.problem.arrays)


class LitPixels:
    """Unknowns whose patterns are dark in all pixels but the ``lit`` ones (n, n)."""

    def __init__(self, unknowns: Unknowns, lit: NDArray[np.bool_], arrays: Arrays) -> None:
        self.free, self.share, self.loosens = unknowns, unknowns.share, unknowns.loosens
        self.lit, self._lit = lit, arrays.asarray(lit.astype(arrays.dtype))
        self.stacked, self.priors = unknowns.stacked, unknowns.priors
        self.other_lines, self.other_video = unknowns.other_lines, unknowns.other_video

    def unstacked(self, theta: Array, found: Patterns) -> Patterns:
        """Return the patterns with 0 in the pixels that are dark."""
        every = self.free.unstacked(theta, found)
        return replace(every, patterns=every.patterns * self._lit)

    def operator(self, patterns: Operator, found: Patterns, /) -> Operator:
        """Return the operator of the lit pixels alone."""
        return self.free.operator(_InLitPixels(patterns, self._lit), found)


class _InLitPixels:
    """B·diag(lit) and its transpose."""

    def __init__(self, operator: Operator, lit: Array) -> None:
        self._operator, self._lit = operator, lit

    def forward(self, theta: Array) -> Array:
        return self._operator.forward(theta * self._lit)

    def adjoint(self, lines: Array) -> Array:
        return self._operator.adjoint(lines) * self._lit
