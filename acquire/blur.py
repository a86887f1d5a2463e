"""What each arm's optics do to its image: a Gaussian blur, less light towards the edges, a veil."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

LARGEST_SIGMA_PIXELS = 16.0
DARKEST = 0.05
"""Least light at an edge, relative to the centre."""
Shade = tuple[float, float, float, float]
EVEN: Shade = (0.0, 0.0, 0.0, 0.0)
MOST_VEIL = 0.5
"""Largest share of the light that a veil may spread over the field."""


@dataclass(frozen=True, slots=True)
class Blur:
    """Standard deviations (along, across) of the blur of arms A and B, in fine pixels.

    Both directions refer to the transfer of the arm's own charge. 0 means that the axis is not blurred.
    ``shade_a`` and ``shade_b`` are (r₁, r₂, c₁, c₂) of the light on row y and column x of an arm's image, in
    halves of the field from its centre: (1 + r₁·y + r₂·y²)·(1 + c₁·x + c₂·x²), relative to its maximum.
    ``veil`` is the share v of each arm's light that reflections in its lens spread evenly over the field:
    X ← (1 − v)·X + v·mean(X) (veiling glare, ISO 18844).
    Raises UsageError for an impossible width or veil, or for light that is not above 0.
    """

    a: tuple[float, float]
    b: tuple[float, float]
    shade_a: Shade = EVEN
    shade_b: Shade = EVEN
    veil: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not all(math.isfinite(each) and 0 <= each <= LARGEST_SIGMA_PIXELS for each in (*self.a, *self.b)):
            raise UsageError(
                f"the blur is impossible: {self}",
                possible=f"standard deviations from 0 to {LARGEST_SIGMA_PIXELS:g} fine pixels",
            )
        if not all(0 <= each <= MOST_VEIL for each in self.veil):
            raise UsageError(
                f"the veil is impossible: {self.veil}",
                possible=f"shares of the light from 0 to {MOST_VEIL:g}",
            )
        x = np.linspace(-1, 1, 65)
        pairs = [each[i : i + 2] for each in (self.shade_a, self.shade_b) for i in (0, 2)]
        # not "< DARKEST", which is false of NaN
        if not all(bool((falling(pair, x) >= DARKEST).all()) for pair in pairs):
            raise UsageError(
                f"the light on the field is impossible: {self}",
                possible=f"everywhere at least {DARKEST:g} of that in the centre",
            )

    def swapped(self) -> Blur:
        """Return the blur with the arms exchanged."""
        return Blur(self.b, self.a, self.shade_b, self.shade_a, (self.veil[1], self.veil[0]))


def falling(terms: tuple[float, ...], x: NDArray[Any]) -> NDArray[np.float64]:
    """Return the light 1 + t₁·x + t₂·x² at ``x``, from −1 to 1 over the field, relative to the centre."""
    first, second = terms
    return np.asarray(1 + first * x + second * x**2)


SHARP = Blur((0.0, 0.0), (0.0, 0.0))
"""Optics without an effect."""
