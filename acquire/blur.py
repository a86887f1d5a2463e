"""Width of the optics' blur in each arm: a Gaussian along the charge transfer and one across it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from acquire.errors import UsageError

LARGEST_SIGMA_PIXELS = 16.0


@dataclass(frozen=True, slots=True)
class Blur:
    """Standard deviations (along, across) of the blur of arms A and B, in fine pixels.

    Both directions refer to the transfer of the arm's own charge. 0 means that the axis is not blurred.
    Raises UsageError for an impossible width.
    """

    a: tuple[float, float]
    b: tuple[float, float]

    def __post_init__(self) -> None:
        if not all(math.isfinite(each) and 0 <= each <= LARGEST_SIGMA_PIXELS for each in (*self.a, *self.b)):
            raise UsageError(
                f"the blur is impossible: {self}",
                possible=f"standard deviations from 0 to {LARGEST_SIGMA_PIXELS:g} fine pixels",
            )

    def swapped(self) -> Blur:
        """Return the blur with the arms exchanged."""
        return Blur(self.b, self.a)
