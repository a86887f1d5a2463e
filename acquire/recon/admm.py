"""The default solver: masked ridge ADMM in a temporal subspace.

    minimise  ½‖W(B·θ − y)‖² + Σ_k λ_k·TV(θ_k) + ι(Dᵀ·θ ≥ 0)

over the coefficients θ (K, n′, n′), with the splits  z = θ  (TV prox, or another denoiser) and  v = D_gᵀ·θ
(non-negativity, on a coarse time grid g). The data step

    argmin_θ ½‖W(B·θ − y)‖² + ρ/2·‖θ − c‖²  =  c + BᵀW·w,   (W·B·BᵀW + ρ)·w = y − W·B·c

is solved in the space of the lines by a few conjugate-gradient steps from the last w. For the whole video
that system is well conditioned (the rows of Λ′ are nearly orthogonal); the difficulty of the problem is its
null space, which the two priors fill. In a basis of a few cosines, neighbouring lines are nearly equal, and a
preconditioner (`band.BandOperator.near_inverse`) replaces hundreds of steps. BᵀW·w is updated along with w,
so that an iteration costs one product with B and, per gradient step, one with B and one with Bᵀ. The
iteration is over-relaxed by 1.7 (Eckstein and Bertsekas, Math. Program. 55, 293 (1992)).
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from acquire.arrays import dot, namespace
from acquire.errors import NumericsError
from acquire.recon.denoisers import CheckedDenoiser
from acquire.recon.sign import SignSplit
from acquire.recon.tv import FrameTv

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.arrays import Array
    from acquire.recon.basis import Basis
    from acquire.recon.denoisers import Denoiser
    from acquire.recon.problem import MaskedOperator
    from acquire.recon.sign import Sign


@dataclass(frozen=True, slots=True)
class AdmmParameters:
    """Weights are relative to samples and operator as `problem.build_problem` scales them.

    ``tv_weight`` is λ; ``tv_penalty`` and ``sign_penalty`` are the splits' ρ. ``preconditioned`` makes the
    data step nearly exact in a few gradient steps; without it the iterates reach weak details last, which
    suppresses noise as a higher weight would. The data step ends after ``gradient_steps``, or as soon as
    ``gradient_share`` of the residual is left. ``joint_tv`` is for coefficient frames with edges in common.
    """

    tv_weight: float = 1e-3
    tv_penalty: float = 2e-4
    sign_penalty: float = 6e-5
    relaxation: float = 1.7
    gradient_steps: int = 2
    gradient_share: float = 0.0
    tv_iterations: int = 10
    grid_per_coefficient: int = 1
    preconditioned: bool = False
    joint_tv: bool = False

    @property
    def penalty(self) -> float:
        """ρ of the data step, which has both splits."""
        return self.tv_penalty + self.sign_penalty

    def times(self, factor: float) -> AdmmParameters:
        """The same with λ and both ρ multiplied: thresholds stay as they are."""
        weight, penalty, sign = self.tv_weight, self.tv_penalty, self.sign_penalty
        return replace(
            self, tv_weight=factor * weight, tv_penalty=factor * penalty, sign_penalty=factor * sign
        )


class Admm:
    """Holds the iterates; `step` is one iteration, `theta` the current estimate (K, n′, n′).

    ``samples`` are 0 where the operator's weight is. ``start`` is a first estimate, ``emphasis`` (K,)
    multiplies λ per coefficient frame, ``denoiser`` replaces total variation. ``background`` (K, n′, n′) is
    light that is known already: its sum with the estimate is not negative. ``sign`` replaces the sign's split
    where θ is no array of coefficient frames (`joined`).
    """

    def __init__(
        self,
        operator: MaskedOperator,
        samples: Array,
        theta_shape: tuple[int, ...],
        basis: Basis,
        parameters: AdmmParameters,
        *,
        start: Array | None = None,
        emphasis: Array | float = 1.0,
        denoiser: Denoiser | None = None,
        background: Array | None = None,
        sign: Sign | None = None,
    ) -> None:
        self._samples, self._parameters = samples, parameters
        tv = FrameTv(parameters.tv_iterations, joint=parameters.joint_tv)
        self._denoiser = CheckedDenoiser(denoiser) if denoiser else tv
        self._xp, arrays = namespace(samples), basis.arrays
        self._emphasis = arrays.asarray(emphasis)
        # λ/ρ for each frame: the split's prox has λ·TV over ρ/2·‖·‖².
        self._strength = self._emphasis * (parameters.tv_weight / parameters.tv_penalty)
        self._operator = operator
        self.theta = arrays.zeros(theta_shape) if start is None else arrays.asarray(start)
        self._w, self._lifted = arrays.zeros(samples.shape), arrays.zeros(theta_shape)
        self._tv_multiplier = arrays.zeros(theta_shape)
        self._sign: Sign = sign or SignSplit(self.grid_of(basis, parameters), self.theta, background)
        self._prepare()

    def rebase(self, operator: MaskedOperator, basis: Basis, theta: Array) -> None:
        """Continue in another basis with the same number of rows and cosines, close to the last one.

        Multipliers and w stay valid: those of the sign belong to instants, w to the lines, and those of TV
        follow slowly.
        """
        self._operator, self.theta = operator, basis.arrays.asarray(theta)
        self._lifted = operator.adjoint(self._w)  # BᵀW·w
        self._sign.rebase(self.grid_of(basis, self._parameters), self.theta.shape)
        self._prepare()

    @staticmethod
    def grid_of(basis: Basis, parameters: AdmmParameters) -> Array:
        """The basis at the instants of the sign's split, in cosines also for a basis of fewer curves.

        On fewer instants its rows would not be orthonormal.
        """
        instants = min(basis.frames, parameters.grid_per_coefficient * basis.cosines)
        return basis.arrays.asarray(basis.matrix(instants))

    def reweigh(self, parameters: AdmmParameters) -> None:
        """Continue with other weights; what is stored divided by ρ, multipliers and w, keeps its value."""
        old, self._parameters = self._parameters, parameters
        self._w *= old.penalty / parameters.penalty
        self._lifted *= old.penalty / parameters.penalty
        self._tv_multiplier *= old.tv_penalty / parameters.tv_penalty
        self._sign.rescale(old.sign_penalty / parameters.sign_penalty)
        self._strength = self._emphasis * (parameters.tv_weight / parameters.tv_penalty)
        self._prepare()

    def resume(self, other: Admm) -> None:
        """Start from the state of another solver with as many coefficients, whatever its weights."""
        old, new = other._parameters, self._parameters
        self.theta = self._xp.asarray(other.theta, copy=True)
        self.adopt(other)
        self._tv_multiplier = other._tv_multiplier * (old.tv_penalty / new.tv_penalty)
        # The splits are in units of θ; only multipliers are divided by ρ.
        self._sign.resume(other._sign)
        self._sign.rescale(old.sign_penalty / new.sign_penalty)

    def adopt(self, other: Admm) -> None:
        """Take over w, which belongs to the lines, from a solver in any basis."""
        # w is the residual of the lines divided by ρ.
        self._w = other._w * (other._parameters.penalty / self._parameters.penalty)
        self._lifted = self._operator.adjoint(self._w)

    def with_problem(self, operator: MaskedOperator, samples: Array, heavier: float = 1.0) -> Admm:
        """A solver that continues from here with other samples or another mask, and a ``heavier`` prior.

        This one stays as it is, except for the denoiser's dual field, which both share.
        """
        # `step` changes w, BᵀW·w and the multipliers in place; what it replaces can be shared.
        other = copy(self)
        other._parameters = replace(self._parameters, tv_weight=heavier * self._parameters.tv_weight)
        other._strength = self._strength * heavier
        other._samples, other._operator = samples, operator
        other._tv_multiplier = self._xp.asarray(self._tv_multiplier, copy=True)
        other._sign = self._sign.copied()
        other._w = self._xp.asarray(self._w, copy=True)
        other._lifted = operator.adjoint(other._w)
        other._prepare()
        return other

    def _prepare(self) -> None:
        """Set up the preconditioner for the present operator and penalties."""
        p = self._parameters
        known = self._operator.near_inverse(p.penalty) if p.preconditioned else None
        self._precondition: Callable[[Array], Array] = known or (lambda lines: lines)

    def step(self) -> None:
        """One iteration.

        Raises
        ------
        NumericsError : the iterates are not finite
        """
        # In place wherever the old value is not needed: these arrays are larger than the caches, so that
        # each temporary one costs as much as the sum that it holds. What others may hold is replaced.
        relaxation = self._parameters.relaxation
        relaxed = self._data_step()
        relaxed *= relaxation
        relaxed += (1 - relaxation) * self.theta
        self._sign.advance(relaxed)
        self.theta = self._denoiser.prox(relaxed + self._tv_multiplier, self._strength)
        relaxed -= self.theta
        self._tv_multiplier += relaxed

    def _data_step(self) -> Array:
        p = self._parameters
        rho = p.penalty
        # The grid's rows are orthonormal, so that both splits together are one ρ/2·‖θ − centre‖².
        centre = self.theta - self._tv_multiplier
        centre *= p.tv_penalty
        centre += p.sign_penalty * self._sign.pull()
        centre /= rho
        # This is y − W·B·c − (W·B·BᵀW + ρ)·w with a single product, since `_lifted` is BᵀW·w.
        residual = self._samples - self._operator.forward(centre + self._lifted) - rho * self._w
        # It is checked here: a NaN would end `_descend` as a residual of 0 does, without a word.
        if not self._xp.isfinite(dot(residual, residual)):
            raise NumericsError(
                "ADMM diverged: its iterates are not finite", hint="check the segment's samples and weights"
            )
        self._descend(residual, rho)
        centre += self._lifted
        return centre

    def _descend(self, residual: Array, rho: float) -> None:
        """Make conjugate-gradient steps on (W·B·BᵀW + ρ)·w; ``residual`` is overwritten."""
        scaled = self._precondition(residual)
        # This is a copy: without a preconditioner `scaled` is the residual itself, which changes in place.
        direction, energy = self._xp.asarray(scaled, copy=True), dot(residual, scaled)
        # The bound is squared, as the energy is.
        enough = self._parameters.gradient_share**2 * energy
        for _ in range(self._parameters.gradient_steps):
            if not energy > 0:  # zero, or not a number
                return
            lifted = self._operator.adjoint(direction)
            image = self._operator.forward(lifted) + rho * direction
            curvature = dot(direction, image)
            if not curvature > 0:  # the direction is so short that its square vanishes
                return
            length = energy / curvature
            self._w += length * direction
            lifted *= length
            self._lifted += lifted
            residual -= length * image
            scaled = self._precondition(residual)
            energy, before = dot(residual, scaled), energy
            if energy <= enough:
                return
            direction = scaled + (energy / before) * direction
