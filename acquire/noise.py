"""Temporal noise of a camera's samples: the residual of a perfect reconstruction."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

QUANTISATION_DN2 = 1 / 12
"""Variance of rounding to whole DN."""


def robust_sigma(deviations: NDArray[Any]) -> float:
    """Return the standard deviation of normal noise with this median of absolute values.

    Outliers hardly change it.
    """
    return float(1.4826 * np.median(np.abs(deviations)))


@dataclass(frozen=True, slots=True)
class Noise:
    """σ² = σ_q² + σ_d² + K·(light in DN), EMVA 1288 release 4.0, Eq. (9) with K·σ_d in DN.

    Attributes
    ----------
    dn_per_electron : K of arms a and b
    dark_noise_dn : standard deviation without light, of arms a and b
    """

    dn_per_electron: tuple[float, float]
    dark_noise_dn: tuple[float, float]

    def __post_init__(self) -> None:
        numbers = np.array([*self.dn_per_electron, *self.dark_noise_dn])
        if not (np.isfinite(numbers).all() and (numbers >= 0).all()):
            raise UsageError(f"the noise is impossible: {self}", possible="finite numbers, 0 or more")

    def variance_dn2(self, light_dn: NDArray[Any]) -> NDArray[np.float64]:
        """Return the variance of samples (arm, line, pixel) that are ``light_dn`` above their black level."""
        K, dark = (np.reshape(each, (2, 1, 1)) for each in (self.dn_per_electron, self.dark_noise_dn))
        # Noise takes dark samples below the black level, where light would be negative.
        variance: NDArray[np.float64] = QUANTISATION_DN2 + dark**2 + K * np.maximum(light_dn, 0.0)
        return variance

    def swapped(self) -> Noise:
        """Return the noise with the arms exchanged."""
        return Noise(self.dn_per_electron[::-1], self.dark_noise_dn[::-1])

    def merged(self, count: int) -> Noise:
        """Return the noise of sums of ``count`` × ``count`` samples."""
        # Variances add up, and K relates sums of light and of variance alike. Each sample was rounded; one
        # rounding is added by `variance_dn2`, and the others are part of the sum's dark noise.
        rounding = (count**2 - 1) * QUANTISATION_DN2
        a, b = (math.sqrt((dark * count) ** 2 + rounding) for dark in self.dark_noise_dn)
        return Noise(self.dn_per_electron, (a, b))

    def with_ambient(self, light_dn: tuple[float, float]) -> Noise:
        """Return the noise with the shot noise of each arm's ambient light added to the dark noise."""
        rows = zip(self.dn_per_electron, self.dark_noise_dn, light_dn, strict=True)
        a, b = (float(np.sqrt(dark**2 + K * max(light, 0.0))) for K, dark, light in rows)
        return Noise(self.dn_per_electron, (a, b))
