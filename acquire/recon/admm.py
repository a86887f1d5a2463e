"""The default solver: masked ridge ADMM in the temporal subspace.

    minimise  ½‖W(B·θ − y)‖² + λ·Σ_k TV(θ_k) + ι(Dᵀ·θ ≥ 0)

over the coefficients θ (K, n′, n′), with the splits  z = θ  (TV prox) and  v = D_gᵀ·θ  (non-negativity, on a
time grid g of twice the bandwidth). The data step

    argmin_θ ½‖W(B·θ − y)‖² + ρ/2·‖θ − c‖²  =  c + BᵀW·w,   (W·B·BᵀW + ρ)·w = y − W·B·c

is solved in the space of the lines by a few conjugate-gradient steps from the last w. That system is well
conditioned (the rows of Λ′ are nearly orthogonal); the difficulty of the problem is its null space, which
the two priors fill. Over-relaxed by 1.7 (Eckstein and Bertsekas, Math. Program. 55, 293 (1992)).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import NumericsError
from acquire.recon.tv import FrameTv

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.recon.basis import TemporalBasis
    from acquire.recon.problem import MaskedOperator


@dataclass(frozen=True, slots=True)
class AdmmParameters:
    """Weights are relative to samples and operator as `problem.pose` scales them.

    ``tv_weight`` is λ; ``tv_penalty`` and ``sign_penalty`` are the splits' ρ.
    """

    tv_weight: float = 1e-3
    tv_penalty: float = 2e-4
    sign_penalty: float = 6e-5
    relaxation: float = 1.7
    gradient_steps: int = 3
    tv_iterations: int = 10
    grid_per_coefficient: int = 2


class Admm:
    """Holds the iterates; `step` is one iteration, `theta` the current estimate (K, n′, n′).

    ``samples`` are 0 where the operator's weight is.
    """

    name = "admm"

    def __init__(
        self,
        operator: MaskedOperator,
        samples: NDArray[Any],
        theta_shape: tuple[int, int, int],
        basis: TemporalBasis,
        parameters: AdmmParameters,
    ) -> None:
        self._operator, self._samples, self._parameters = operator, samples, parameters
        self._tv = FrameTv(theta_shape, parameters.tv_iterations, samples.dtype)
        grid = min(basis.frames, parameters.grid_per_coefficient * basis.count)
        self._grid = basis.matrix(grid)
        self.theta = np.zeros(theta_shape, samples.dtype)
        self._tv_multiplier = np.zeros_like(self.theta)
        self._sign = np.zeros((grid, *theta_shape[1:]), samples.dtype)
        self._sign_multiplier = np.zeros_like(self._sign)
        self._w = np.zeros_like(samples)

    def step(self) -> None:
        """One iteration.

        Raises
        ------
        NumericsError : the iterates are not finite
        """
        p = self._parameters
        theta = self._data_step()
        relaxed = p.relaxation * theta + (1 - p.relaxation) * self.theta
        self.theta = self._tv.prox(relaxed + self._tv_multiplier, p.tv_weight / p.tv_penalty)
        self._tv_multiplier += relaxed - self.theta
        values = np.tensordot(self._grid.T, relaxed, 1) + self._sign_multiplier
        np.maximum(values, 0, out=self._sign)
        np.subtract(values, self._sign, out=self._sign_multiplier)

    def _data_step(self) -> NDArray[Any]:
        p, operator = self._parameters, self._operator
        rho = p.tv_penalty + p.sign_penalty
        centre = p.tv_penalty * (self.theta - self._tv_multiplier)
        centre += p.sign_penalty * np.tensordot(self._grid, self._sign - self._sign_multiplier, 1)
        centre /= rho
        gap = self._samples - operator.forward(centre)
        if not np.isfinite(np.vdot(gap, gap)):
            raise NumericsError(
                "ADMM left the finite numbers", hint="check the segment's samples and weights"
            )
        self._w = conjugate_gradients(
            lambda w: operator.forward(operator.adjoint(w)) + rho * w, gap, self._w, p.gradient_steps
        )
        theta: NDArray[Any] = centre + operator.adjoint(self._w)
        return theta


def conjugate_gradients(
    apply: Callable[[NDArray[Any]], NDArray[Any]], right: NDArray[Any], start: NDArray[Any], steps: int
) -> NDArray[Any]:
    """``steps`` conjugate-gradient steps on ``apply(x) = right`` from ``start`` (positive definite)."""
    x = start.copy()
    residual = right - apply(x)
    direction = residual.copy()
    energy = np.vdot(residual, residual)
    for _ in range(steps):
        if energy == 0:
            break
        image = apply(direction)
        length = energy / np.vdot(direction, image)
        x += length * direction
        residual -= length * image
        energy, before = np.vdot(residual, residual), energy
        direction = residual + (energy / before) * direction
    return x
