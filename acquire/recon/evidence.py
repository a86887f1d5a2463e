"""Least squares with a prior that the lines choose: what fits of light over time have in common.

    minimise  ‖y − A·x‖²/σ² + Σ_k x_k²/γ_k

The energies γ and the noise σ² are those for which the lines are most likely (the evidence, MacKay, Neural
Comput. 4, 415 (1992)): an unknown's energy is its square over the share of it that the lines determine, and
the noise is what is left of the lines, over the number of samples that no unknown takes up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

FAINTEST = 1e-10
"""Smallest energy, noise and precision relative to the largest energy, the lines' and the mean eigenvalue:
smaller ones would never come back, or leave the equations singular."""
LEAST_DETERMINED = 0.01
"""Smallest share of an unknown that counts as determined by the lines; it bounds a step of its energy."""


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """AᵀA·x = Aᵀy: ``normal`` (K, K), ``right`` (K,), and ‖y‖², the ``energy`` of the ``samples`` y."""

    normal: Floats
    right: Floats
    energy: float
    samples: int

    def left(self, x: Floats) -> float:
        """‖y − A·x‖²."""
        return self.energy - 2 * float(x @ self.right) + float(x @ self.normal @ x)

    def noise(self, x: Floats, determined: Floats) -> float:
        """σ², given the share of each unknown that the lines determine."""
        least = FAINTEST * self.energy
        return max(self.left(x), least) / max(self.samples - float(determined.sum()), 1.0)


def determined_share(precision: Floats, inverse: NDArray[np.floating[Any]]) -> Floats:
    """Share of each unknown that the lines determine, for a ``precision`` σ²/γ and (AᵀA + σ²/γ)⁻¹."""
    return np.asarray(np.clip(1 - precision * np.diag(inverse), LEAST_DETERMINED, 1))
