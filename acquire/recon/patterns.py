"""Scenes that are a sum of a few patterns, each with its curve, solved at full spatial resolution.

    X(r, c, t) = Σ_k u_k(t)·Z_k(r, c)             LEDs behind masks, displays, a blade before a target

A first reconstruction in voxels shows how many patterns there are; then patterns and curves are refined in
turn, each against all samples:

    Z given u    ADMM in the basis of the curves, with joint TV and sign R·n² unknowns
    u given Z    least squares with a prior that the lines choose         R·K unknowns

There are two gains. The curves are hardly biased (total variation takes a quarter of a 5 kHz amplitude),
and edges keep their position. A voxel of N_m > 1 that holds an edge cannot explain its lines:
this model error is some percent, ten to fifty times the noise, and fitting it spoils the picture
(semi-convergence). At N_m = 1 it is gone; voxels are averaged afterwards.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from acquire.arrays import host
from acquire.forward import merge_video
from acquire.recon.admm import Admm, AdmmParameters
from acquire.recon.band import segment_operator
from acquire.recon.basis import LearnedBasis
from acquire.recon.curves import CurveFit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.arrays import Array
    from acquire.recon.basis import TemporalBasis
    from acquire.recon.estimates import InBand
    from acquire.recon.given import Given
    from acquire.recon.problem import MaskedOperator, Operator, Problem

LARGEST_RANK = 12
"""Largest number of patterns; a scene that takes more is not one of patterns."""
TAIL = 16
"""Index of the singular value that is taken as the error floor of the first reconstruction."""
ABOVE_TAIL = 3.0
"""Smallest ratio of a pattern's singular value to the floor."""
LEAST_FOR_NOISE = 64
"""Least number of cosines whose median singular value is that of noise."""
NOISE_SPREAD, ABOVE_NOISE, GAP_IN_NOISE = 1.5, 2.0, 2.5
"""Ratio to it below which the floor is noise as well; `ABOVE_TAIL` then; smallest ratio of neighbours at
which patterns end. Noise reaches 1.8 floors. To miss a lamp costs 2 to 3 dB, a superfluous pattern 1 dB."""
GAP = 3.0
"""Smallest ratio of neighbouring singular values at which patterns end. An extra pattern is harmful: it
absorbs light that belongs to the others wherever the lines do not separate them, and the picture drifts
away."""
LARGEST_REST = 0.035
"""Largest share of the energy that the patterns may leave out for the scene to consist of a few of them."""
LARGEST_REST_AT_GAP = 0.005
"""The same for patterns that end at a gap; it is smaller, because a bright still can hide what moves before
it."""
NEEDED, SUPERFLUOUS = 2.2, 1.3
"""Rise of the held-out error beyond the noise, as energy, from which the weakest pattern is surely needed,
and up to which it surely is not. Without a lamp it rises to 2.5 times and more (1.9 in low light), without a
superfluous pattern to twice at most, and in most cases to 1.02 to 1.15."""
FADING = 0.5
"""Power of (largest / own singular value) by which a pattern's λ is larger: weak patterns are smoother."""

PARAMETERS = AdmmParameters(
    tv_weight=2.5e-3, tv_penalty=2e-3, sign_penalty=6e-4, grid_per_coefficient=1, joint_tv=True
)
"""The edge of a lamp is in every pattern, as these are mixed: joint total variation pays for it once. Frame
by frame, faint patterns lose their edges in the noise, the curves take up the error, and both together settle
2 dB lower."""
ROUND = 5
"""Number of ADMM iterations between two fits of the curves."""
CURVE_DAMPING = 3e-3
"""Levenberg's damping of the curves' fit: it slows the curves down, so that the patterns can follow, and does
not change the fixed point. With a tenth of it the two chase each other and diverge from the truth."""
PENALTY_DECAY, LAST_PENALTY = 0.8, 1 / 4
WEIGHT_DECAY, LAST_WEIGHT = 0.75, 1 / 16
"""Factors of the penalties ρ and of λ from round to round, and their limits: weights that stabilise the
iterates while patterns and curves are wrong would flatten them once they are right."""


@dataclass(frozen=True, slots=True, eq=False)
class Patterns:
    """Θ = curves·patterns: (K, R) orthonormal columns, and (R, row, column) of decreasing energy.

    Curves are on the host; patterns are on the device where they were computed. ``motion`` (K, n′, n′) are
    coefficients of what moves beside them, if that is solved for as well (`beside_motion`).
    """

    curves: NDArray[Any]
    patterns: Array
    motion: Array | None = None


def find_patterns(theta: NDArray[Any], *, beyond_doubt: bool = False) -> Patterns | None:
    """Find the patterns of coefficient frames (K, n′, n′); None if the scene is not a sum of a few patterns.

    With ``beyond_doubt``, a gap has to follow them; otherwise it is enough that they rise above the floor.
    """
    count, side, _ = theta.shape
    if count <= TAIL:
        return None
    flat = theta.reshape(count, -1).astype(np.float64)
    # The matrix is K × K: there are many more pixels than cosines.
    energy, vectors = np.linalg.eigh(flat @ flat.T)
    energy, vectors = np.maximum(energy[::-1], 0), vectors[:, ::-1]
    # Energies are squares of singular values, for whose ratios the limits are given.
    gaps = np.flatnonzero(energy[: TAIL - 1] > GAP**2 * energy[1:TAIL]) + 1
    rank = int(gaps[-1]) if len(gaps) else 0
    if not _is_enough(rank, energy, LARGEST_REST_AT_GAP):
        if beyond_doubt:
            return None
        # Noise has most of the singular values to itself, and a share of each; few do not determine it.
        noise = np.median(energy) if count >= LEAST_FOR_NOISE else 0.0
        rank = _above_floor(energy[:TAIL], noise)
        if not _is_enough(rank, energy - noise, LARGEST_REST):
            return None
    curves = vectors[:, :rank].astype(theta.dtype)
    return Patterns(curves, (curves.T @ theta.reshape(count, -1)).reshape(rank, side, side))


def has_clear_patterns(look: InBand) -> bool:
    """Whether the scene is evidently a sum of a few patterns."""
    return find_patterns(host(look.solver.theta), beyond_doubt=True) is not None


def _above_floor(energy: NDArray[np.float64], noise: float) -> int:
    """Number of patterns that rise above the last of these squared singular values, the floor.

    If the floor is noise, and not what the first look has left, fainter ones count, unless they follow a gap.
    """
    floor = energy[-1]
    clear = int(np.count_nonzero(energy > ABOVE_TAIL**2 * floor))
    if floor >= NOISE_SPREAD**2 * noise:
        return clear
    rank = int(np.count_nonzero(energy > ABOVE_NOISE**2 * floor))
    return clear if energy[clear - 1] > GAP_IN_NOISE**2 * energy[clear] else rank


def _is_enough(rank: int, energy: NDArray[np.float64], rest: float) -> bool:
    """Whether the first ``rank`` squared singular values are few and leave out at most a share ``rest``."""
    return bool(0 < rank <= LARGEST_RANK and energy[rank:].sum() <= rest * energy.sum())


class Unknowns(Protocol):
    """What the solver of a refinement solves for: `PatternsAlone`, or a volume as well (`beside_motion`).

    Everything in which these refinements differ is here. ``found`` are patterns in pixels.
    """

    share: float
    """Factor of λ and ρ."""
    loosens: bool
    """Whether λ is lowered from round to round."""

    def stacked(self, found: Patterns) -> Array:
        """All unknowns in one array θ, as the solver holds them."""
        ...

    def unstacked(self, theta: Array, found: Patterns) -> Patterns:
        """θ as patterns, with the curves of what was ``found``."""
        ...

    def operator(self, patterns: Operator, found: Patterns, /) -> Operator:
        """Lines of θ, given the operator of the patterns."""
        ...

    def priors(
        self, found: Patterns, basis: LearnedBasis, parameters: AdmmParameters, /, *, emphasis: Array
    ) -> dict[str, Any]:
        """Arguments of `Admm` for its priors; ``emphasis`` are factors of each pattern's λ."""
        ...

    def other_lines(self, found: Patterns, /) -> Array | None:
        """Lines of all that is no pattern, before their division by the problem's norm."""
        ...

    def other_video(self, found: Patterns, /) -> NDArray[Any] | None:
        """Voxels of all that is no pattern."""
        ...


class PatternsAlone:
    """Nothing beside the patterns: these are θ."""

    share, loosens = 1.0, True

    def stacked(self, found: Patterns) -> Array:
        """Return the patterns (K, n′, n′) themselves."""
        return found.patterns

    def unstacked(self, theta: Array, found: Patterns) -> Patterns:
        """Return θ with the curves it was solved for."""
        return Patterns(found.curves, theta)

    def operator(self, patterns: Operator, _found: Patterns, /) -> Operator:
        """Return the operator of the patterns itself."""
        return patterns

    def priors(
        self, _found: Patterns, _basis: LearnedBasis, _parameters: AdmmParameters, /, *, emphasis: Array
    ) -> dict[str, Any]:
        """Return the emphasis alone: sign and total variation are those that `Admm` has anyway."""
        return {"emphasis": emphasis}

    def other_lines(self, _found: Patterns, /) -> None:
        """Return None: nothing else makes lines."""

    def other_video(self, _found: Patterns, /) -> None:
        """Return None: nothing else is in the video."""


PATTERNS_ALONE = PatternsAlone()


class Refinement:
    """Refines patterns and curves in turn: `step` is an ADMM iteration; a round ends with the curves' fit.

    ``loosens`` tells whether λ is still lowered from round to round.
    """

    def __init__(
        self,
        given: Given,
        cosines: TemporalBasis,
        found: Patterns,
        parameters: AdmmParameters = PARAMETERS,
        unknowns: Unknowns = PATTERNS_ALONE,
    ) -> None:
        self._given, self._cosines, self.unknowns = given, cosines, unknowns
        self.parameters = self._first = parameters.times(unknowns.share)
        self.loosens = unknowns.loosens
        self._steps = 0
        self._fit = self._new_fit()
        n, merge = given.segment.geometry.size, given.options.spatial_merge
        # A voxel is held over its pixels; the last may stand out of the picture.
        fine = found.patterns.repeat(merge, axis=1).repeat(merge, axis=2)[:, :n, :n]
        self._start(replace(found, patterns=fine))

    def _start(self, found: Patterns) -> None:
        """Begin ADMM, with the current parameters, at patterns in pixels."""
        self.found = found
        operator, basis = self._operators()
        fine, start = host(found.patterns), self._theta
        size = np.sqrt(np.square(fine, dtype=np.float64).sum((1, 2)))
        # With 1e-6, the weight of a pattern that has faded altogether stays finite.
        emphasis = (size.max() / np.maximum(size, 1e-6 * size.max() + 1e-30)) ** FADING
        self._admm = Admm(
            operator,
            self._given.problem.used_samples,
            start.shape,
            basis,
            self.parameters,
            start=start,
            **self.unknowns.priors(found, basis, self.parameters, emphasis=emphasis),
        )
        self._take()

    def _take(self) -> None:
        """Take what the solver has now."""
        self.found = self.unknowns.unstacked(self._admm.theta, self.found)

    def _new_fit(self) -> CurveFit:
        given = self._given
        merge = given.options.temporal_merge
        return CurveFit(given.segment, given.problem, self._cosines, merge, CURVE_DAMPING, learns=True)

    @property
    def _theta(self) -> Array:
        """What is found, as the solver holds it."""
        return self.unknowns.stacked(self.found)

    @property
    def rank(self) -> int:
        """Number of patterns."""
        return int(self.found.curves.shape[1])

    @property
    def rounds(self) -> int:
        """Number of rounds made so far."""
        return self._steps // ROUND

    @property
    def at_round_end(self) -> bool:
        """Whether the latest iteration was the last one of a round, after which the curves are fitted."""
        return self._steps % ROUND == 0

    def step(self) -> None:
        """Make one iteration. Raises NumericsError if the iterates are not finite."""
        self._admm.step()
        self._take()
        self._steps += 1
        if self.at_round_end:
            self._fit_curves()
            self._admm.rebase(*self._operators(), self._theta)
            self._take()
            if self.loosens:
                weight = max(WEIGHT_DECAY * self.parameters.tv_weight, LAST_WEIGHT * self._first.tv_weight)
                self._reweigh(weight)

    def hold(self, weight: float) -> None:
        """Continue with weight λ, at most that of the first round, and no longer lower it."""
        self.loosens = False
        self._reweigh(min(weight, self._first.tv_weight))

    def _reweigh(self, weight: float) -> None:
        """Set λ, and lower the penalties by one step."""
        now, first = self.parameters, self._first
        penalty = max(PENALTY_DECAY * now.tv_penalty, LAST_PENALTY * first.tv_penalty)
        sign_penalty = first.sign_penalty * penalty / first.tv_penalty
        self.parameters = replace(now, tv_weight=weight, tv_penalty=penalty, sign_penalty=sign_penalty)
        self._admm.reweigh(self.parameters)

    def return_to(self, found: Patterns) -> None:
        """Make ``found``, the result of an earlier round, the estimate."""
        self.found = found
        # This sets the operator of these curves, which `predict` needs.
        self._operators()

    def restricted(self, found: Patterns, unknowns: Unknowns | None = None) -> Refinement:
        """A refinement that continues from here with fewer patterns, in pixels, or with other unknowns.

        This one stays as it is.
        """
        other = copy(self)
        other.unknowns = unknowns or self.unknowns
        # It starts from the present state: fewer patterns that start from voxels have not yet taken their
        # light back.
        other._start(found)
        other._fit = other._new_fit()
        other._fit.prior = self._fit.prior
        return other

    def with_problem(self, problem: Problem, heavier: float = 1.0) -> Refinement:
        """A refinement that continues from here with another problem's samples and a ``heavier`` prior.

        This one stays as it is.
        """
        other = copy(self)
        other.parameters = replace(self.parameters, tv_weight=heavier * self.parameters.tv_weight)
        other._first = replace(self._first, tv_weight=heavier * self._first.tv_weight)
        other._given, other._steps = replace(self._given, problem=problem), 0
        other._fit = other._new_fit()
        other._fit.prior = self._fit.prior
        operator, basis = other._operators()
        other._admm = self._admm.with_problem(operator, problem.used_samples, heavier)
        other._admm.rebase(operator, basis, self._theta)
        return other

    def needed(self, rise: float = NEEDED) -> Patterns:
        """The strongest current patterns, in pixels, without those that the held-out samples may not need.

        These are the weakest, as long as the error without the next of them rises by less than ``rise``.

        A pattern of the scene is needed by far, whereas one too many only absorbs errors of the others.
        Without held-out samples all are needed.
        """
        found, flat = self.found, host(self.found.patterns).reshape(self.rank, -1).astype(np.float64)
        _, turn = np.linalg.eigh(flat @ flat.T)
        # In principal axes, strongest first, the last patterns hold the least light.
        turn = turn[:, ::-1].astype(found.curves.dtype)

        def strongest(count: int) -> Patterns:
            kept = turn[:, :count]
            patterns = (kept.T @ flat).reshape(-1, *found.patterns.shape[1:])
            patterns = self._given.problem.arrays.asarray(patterns.astype(kept.dtype))
            return replace(found, curves=found.curves @ kept, patterns=patterns)

        excess, needed = self.excess(), self.rank
        while needed > 1:
            # This is only to predict with fewer: the present ones come back below.
            self.return_to(strongest(needed - 1))
            without = self.excess()
            if not without < rise * excess:
                break
            excess, needed = without, needed - 1
        self.return_to(found)
        return found if needed == self.rank else strongest(needed)

    def excess(self) -> float:
        """The energy of the held-out error beyond that of the noise; NaN without held-out samples."""
        noise = self._given.noise
        floor = noise**2 if noise < np.inf else 0.0  # NaN if it is unknown
        return self._given.problem.prediction_error(self.predict()) ** 2 - floor

    def predict(self) -> NDArray[Any]:
        """The lines of the estimate, as `Problem.samples`."""
        return host(self._operator.forward(self._theta)) / self._given.problem.norm

    def taken_back(self, lines: NDArray[Any]) -> NDArray[Any]:
        """Bᵀ of lines (2, L_R, M): in each pattern (R, n, n), the light that they come from."""
        return host(self._in_patterns.adjoint(self._given.problem.arrays.asarray(lines)))

    def video(self) -> NDArray[Any]:
        """Dimensionless voxels (T/T_m, n/N_m, n/N_m)."""
        merged = merge_video(host(self.found.patterns), self._given.options.spatial_merge, 1)
        basis = LearnedBasis(self._cosines, self.found.curves)
        video = host(basis.synthesize(basis.arrays.asarray(merged)))
        other = self.unknowns.other_video(self.found)
        return video if other is None else np.asarray(video + other)

    def _operators(self) -> tuple[MaskedOperator, LearnedBasis]:
        """The solver's operator, and the basis of the patterns' curves, for the present curves."""
        given, basis = self._given, LearnedBasis(self._cosines, self.found.curves)
        self._in_patterns = segment_operator(given.segment, basis, 1, given.options.temporal_merge)
        self._operator = self.unknowns.operator(self._in_patterns, self.found)
        return given.problem.masked(self._operator), basis

    def _fit_curves(self) -> None:
        """Fit the curves to the patterns, and make them orthonormal again with the least rotation."""
        problem, patterns = self._given.problem, self.found.patterns
        arrays, exact = problem.arrays, problem.arrays.exact()
        flat = exact.xp.reshape(exact.asarray(patterns), (self.rank, -1))
        gram = host(flat @ flat.T)
        # The ridge keeps patterns that have become alike, or dark, from making it singular.
        root = np.linalg.cholesky(gram + 1e-6 * np.trace(gram) * np.eye(self.rank))
        # Orthonormal patterns make the fit well conditioned; the curves take over their sizes for it.
        unit = arrays.xp.reshape(arrays.asarray(exact.asarray(np.linalg.inv(root)) @ flat), patterns.shape)
        other = self.unknowns.other_lines(self.found)
        known = None if other is None else host(other) / problem.norm
        # These are the curves of unit patterns, and then (solve) of the patterns as they were.
        fitted = self._fit(unit, self.found.curves @ root, known)
        left, middle, right = np.linalg.svd(np.linalg.solve(root.T, fitted.T).T, full_matrices=False)
        # Left·right is the nearest orthonormal matrix; the patterns take the rest, so that Θ stays the same.
        rotated = exact.asarray((right.T * middle) @ right) @ flat
        patterns = arrays.xp.reshape(arrays.asarray(rotated), patterns.shape)
        self.found = replace(self.found, curves=(left @ right).astype(arrays.dtype), patterns=patterns)
