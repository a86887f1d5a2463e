"""The paper's solver: two-step iterative shrinkage/thresholding (TwIST).

    minimise  ½‖W(B·θ − y)‖² + λ·Σ_k TV(θ_k),   ‖W·B‖₂ ≤ 1                          (Eq. 5)

with φ the isotropic 2-D TV of every frame of the video's DCT along time (Section 4), by

    θ_{k+1} = (1 − α)·θ_{k−1} + (α − β)·θ_k + β·Ψ_λ(θ_k + BᵀW(y − W·B·θ_k))

(Bioucas-Dias and Figueiredo, IEEE Trans. Image Process. 16, 2992 (2007), Eq. 18, 22–27). Where the objective
would rise above the running mean of its past (Zhang and Hager, SIAM J. Optim. 14, 1043 (2004)), the plain
step Ψ_λ(…) is taken instead, which requires a norm that is a true upper bound. The stricter criterion of the
reference's monotone variant costs 1 dB and more at equal time: the few iterations of the prox make the
objective ripple, and every plain step loses the acceleration.

The paper's λ of 0.1 … 10 is for an operator that is not normalised and light of about 1: divided by
norm² · scale (about 2000 for Fig. 9) it is 5e-5 … 5e-3 here.

With a ``basis`` the default solver's prior is added, so that the gains of its prior and of its algorithm can
be distinguished: θ is in the band, and every shrunk iterate is made non-negative on a grid of instants. That
is only approximately the prox of the sum, so the plain step is taken even if the objective rises a little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.arrays import dot, namespace
from acquire.errors import NumericsError
from acquire.recon.tv import FrameTv

if TYPE_CHECKING:
    from acquire.arrays import Array
    from acquire.recon.basis import Basis
    from acquire.recon.problem import MaskedOperator

PROX_REPEATS = 5
"""Largest number of times that the prox is continued: the plain step lowers the objective if it is exact
enough."""
MEMORY = 0.95
"""Weight of the past in the running mean that the objective must not exceed."""


@dataclass(frozen=True, slots=True)
class TwistParameters:
    """``tv_weight`` is λ, relative to samples and operator as `problem.build_problem` scales them.

    ``smallest_eigenvalue`` is ξ₁ of the reference, as for severely ill-conditioned operators: the norm of a
    non-negative Λ′ is that of a flat scene, and all detail is a hundred times below it. Both are the best
    compromise on a grid, λ = 1e-3 … 0.1, ξ₁ = 1e-5 … 1e-3, over Scene #1 and both voxel sizes
    of the goldfish at full size: within 1 dB of the best for each.
    """

    tv_weight: float = 2e-2
    smallest_eigenvalue: float = 3e-4
    tv_iterations: int = 10


class Twist:
    """Holds the iterates; `step` is one iteration, `theta` the current estimate (T/T_m, n′, n′).

    ``samples`` are 0 where the operator's weight is.
    """

    def __init__(
        self,
        operator: MaskedOperator,
        samples: Array,
        theta_shape: tuple[int, int, int],
        parameters: TwistParameters,
        basis: Basis | None = None,
    ) -> None:
        self._operator, self._samples = operator, samples
        self._xp = xp = namespace(samples)
        self._grid = None
        if basis is not None:
            self._grid = basis.arrays.asarray(basis.matrix(min(basis.frames, 2 * basis.cosines)))
        self._lambda = parameters.tv_weight
        self._tv = FrameTv(parameters.tv_iterations)
        root = math.sqrt(parameters.smallest_eigenvalue)
        rho = (1 - root) / (1 + root)
        self._alpha = 1 + rho**2
        self._beta = 2 * self._alpha / (parameters.smallest_eigenvalue + 1)
        self.theta = xp.zeros(theta_shape, dtype=samples.dtype, device=samples.device)
        self._before = self.theta
        self._gap = self._samples
        self.objective = self.ceiling = self._objective_of(self.theta, self._gap)

    def step(self) -> None:
        """One iteration.

        Raises
        ------
        NumericsError : the objective is not finite
        """
        target = self.theta + self._operator.adjoint(self._gap)
        shrunk = self._tv.prox(target, self._lambda)
        if self._grid is not None:  # set negative light to 0, as far as the band allows
            values = self._xp.maximum(self._xp.tensordot(self._grid.T, shrunk, axes=1), 0)
            shrunk = self._xp.tensordot(self._grid, values, axes=1)
        alpha, beta = self._alpha, self._beta
        self.ceiling += (1 - MEMORY) * (self.objective - self.ceiling)
        two_step = (1 - alpha) * self._before + (alpha - beta) * self.theta + beta * shrunk
        if self._accepted(two_step, self.ceiling):
            return
        highest = self.objective if self._grid is None else math.inf
        for _ in range(PROX_REPEATS):
            if self._accepted(shrunk, highest):
                return
            shrunk = self._tv.prox(target, self._lambda)  # continues from its last dual field: more exact
        # No step was accepted: the next one starts without momentum.
        self._before = self.theta

    def _accepted(self, theta: Array, highest: float) -> bool:
        """Move to ``theta`` unless the objective would be above ``highest``; return whether it did."""
        gap = self._samples - self._operator.forward(theta)
        objective = self._objective_of(theta, gap)
        if objective > highest:
            return False
        self._before, self.theta, self._gap, self.objective = self.theta, theta, gap, objective
        return True

    def _objective_of(self, theta: Array, gap: Array) -> float:
        value = 0.5 * float(dot(gap, gap)) + self._lambda * self._tv.value(theta)
        if not math.isfinite(value):
            raise NumericsError(
                "TwIST diverged: its objective is not finite", hint="check the segment's samples and λ"
            )
        return value
