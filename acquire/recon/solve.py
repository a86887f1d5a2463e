"""How each solver goes about a problem: its stages, and when it has seen enough.

    admm        cosines ── few patterns? ── yes ─▶ patterns and curves at full resolution
                                └────────── no ──▶ more of the same
    twist       the paper's, on all frames
    twist-band  the same algorithm with admm's band and sign
    (static image known)  one curve, least squares

Held-out samples end the refinement, and the round that predicted them best is the result: at full resolution
the model has no error of its own to fit, so they are predicted better as long as the picture gets better.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from acquire.arrays import host
from acquire.forward import merge_video
from acquire.recon.admm import Admm, AdmmParameters
from acquire.recon.band import InBasis, band_operator
from acquire.recon.bandwidth import FEWEST_COEFFICIENTS, estimate_coefficients
from acquire.recon.basis import TemporalBasis
from acquire.recon.curves import CurveFit, CurveOperator
from acquire.recon.patterns import ROUND, Refinement, find_patterns
from acquire.recon.twist import Twist, TwistParameters

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.arrays import Array
    from acquire.lines import Segment
    from acquire.recon.basis import Basis
    from acquire.recon.clock import IterationClock
    from acquire.recon.problem import Operator, Problem
    from acquire.recon.request import Request

FIRST_LOOK, LONGER_LOOK = 60, 90
"""Iterations in the cosines before patterns are looked for; longer where these are in doubt."""
FIRST_LOOK_SHARE = 0.9
"""Of a budget, the most that the first look may take."""
TENTATIVE_SHARE = 0.15
"""Of a budget, after which the search for the bandwidth hurries."""
UNSEARCHED_SHARE = 0.2
"""Of a budget: where posing the problem alone took more, the bandwidth is not looked for."""
PLAIN_ITERATIONS = 90
"""Of scenes that are not a few patterns: from here on, more iterations fit what voxels cannot hold."""
USUAL_FRAMES = 980
FEW_FRAMES = 32
HELD_BACK = 100.0
"""Factor of the penalties for few frames, as long as they do not explain the lines."""
TRIAL = 20
"""Iterations after which few frames are asked whether they do."""
EXPLAINED = 0.1
"""Relative error of prediction below which they do."""
STILL = AdmmParameters(tv_weight=5e-6, tv_penalty=1e-5, sign_penalty=3e-6, gradient_steps=6)
"""For a single frame. All sub-steps add up in it, so that the mean light has an eigenvalue some thousand
times that of a detail: lower penalties let details through, more gradient steps reach them."""
LEAST_GAIN = 0.003
"""Relative gain of the held-out prediction in a round below which the round was in vain."""
PATIENCE = 6
"""Rounds in vain that end a refinement."""


class Estimate(Protocol):
    """A solver's state of knowledge: dimensionless video, and the lines that it predicts."""

    def predict(self) -> NDArray[Any]: ...

    def video(self) -> NDArray[Any]: ...

    def facts(self) -> dict[str, Any]: ...


class InBand:
    """Coefficient frames of an iterative solver as an estimate."""

    def __init__(
        self,
        solver: Admm | Twist,
        operator: Operator,
        basis: Basis,
        problem: Problem,
        parameters: AdmmParameters | TwistParameters,
    ) -> None:
        self.solver, self._parameters = solver, parameters
        self.basis, self._operator, self._problem = basis, operator, problem

    def predict(self) -> NDArray[Any]:
        return host(self._operator.forward(self.solver.theta)) / self._problem.norm

    def video(self) -> NDArray[Any]:
        return host(self.basis.synthesize(self.solver.theta))

    def facts(self) -> dict[str, Any]:
        return {"temporal_coefficients": self.basis.count} | asdict(self._parameters)


class Refined:
    """A refinement as an estimate."""

    def __init__(self, refinement: Refinement, coefficients: int) -> None:
        self._refinement, self._coefficients = refinement, coefficients

    def predict(self) -> NDArray[Any]:
        return self._refinement.predict()

    def video(self) -> NDArray[Any]:
        return self._refinement.video()

    def facts(self) -> dict[str, Any]:
        found = {"temporal_coefficients": self._coefficients, "patterns": self._refinement.rank}
        return found | asdict(self._refinement.parameters)


def solve_admm(segment: Segment, problem: Problem, request: Request, clock: IterationClock) -> Estimate:
    """The default: cosines first, then patterns and curves where the scene is of a few."""
    frames = segment.geometry.video_shape(request.spatial_merge, request.temporal_merge)[0]
    basis = TemporalBasis(frames, _coefficients(segment, problem, request, clock), problem.arrays)
    estimate = _first_look(segment, problem, request, basis, clock)
    refined = None if request.denoiser else _refine(segment, problem, request, estimate, clock)
    if refined is not None:
        return refined
    for _ in clock.run(PLAIN_ITERATIONS - clock.done, "solve", video=estimate.video):
        estimate.solver.step()
    return estimate


def _first_look(
    segment: Segment, problem: Problem, request: Request, basis: TemporalBasis, clock: IterationClock
) -> InBand:
    """In the cosines; few frames with lower penalties from where they turn out to explain the lines."""
    N_m, T_m = request.spatial_merge, request.temporal_merge
    frames, side, _ = segment.geometry.video_shape(N_m, T_m)
    operator = band_operator(segment.geometry, segment.code, basis, N_m, T_m, segment.alignment)

    def begin(start: Array | None, *, explained: bool = False) -> InBand:
        parameters = _weighted(_defaults(frames, explained=explained), request.tv_weight)
        solver = Admm(
            problem.masked(operator),
            problem.used_samples,
            (basis.count, side, side),
            basis,
            parameters,
            start=start,
            denoiser=request.denoiser,
        )
        return InBand(solver, operator, basis, problem, parameters)

    start = None
    if request.initial is not None:
        start = basis.analyze(problem.arrays.asarray(request.initial / problem.scale))
    estimate = begin(start)
    if 1 < frames <= FEW_FRAMES:
        for _ in clock.run(TRIAL, "first look", FIRST_LOOK_SHARE, estimate.video):
            estimate.solver.step()
        if problem.prediction_error(estimate.predict()) < EXPLAINED:
            estimate = begin(estimate.solver.theta, explained=True)
    for look in (FIRST_LOOK, LONGER_LOOK):
        most = min(look, -(-4 * request.iterations // 5))
        for _ in clock.run(most - clock.done, "first look", FIRST_LOOK_SHARE, estimate.video):
            estimate.solver.step()
        if find_patterns(host(estimate.solver.theta), beyond_doubt=True):
            break
    return estimate


def _refine(
    segment: Segment,
    problem: Problem,
    request: Request,
    first: InBand,
    clock: IterationClock,
) -> Estimate | None:
    """Patterns and curves from a first look; None where the scene is not made of a few."""
    goes_on = clock.done < clock.iterations and clock.affords(ROUND * clock.longest_s)
    found = find_patterns(host(first.solver.theta)) if goes_on else None
    if found is None:
        return None
    basis = TemporalBasis(first.basis.frames, first.basis.count, problem.arrays)
    merges = (request.spatial_merge, request.temporal_merge)
    refinement = Refinement(segment, problem, basis, found, merges)
    best, kept, idle = np.inf, refinement.found, 0
    for _ in clock.run(clock.iterations - clock.done, "refine", video=refinement.video):
        refinement.step()
        if not refinement.at_round_end:
            continue
        now = problem.prediction_error(refinement.predict())
        idle = idle + 1 if now >= (1 - LEAST_GAIN) * best else 0  # without held-out samples: NaN, go on
        if not now >= best:
            best, kept = now, refinement.found
        if idle == PATIENCE:
            clock.converged()
            break
    refinement.return_to(kept)
    if problem.prediction_error(first.predict()) < best < np.inf:
        return None
    return Refined(refinement, basis.count)


def solve_twist(segment: Segment, problem: Problem, request: Request, clock: IterationClock) -> Estimate:
    """The paper's solver; ``twist-band`` with the band and the sign of the default."""
    N_m, T_m = request.spatial_merge, request.temporal_merge
    shape = segment.geometry.video_shape(N_m, T_m)
    banded = request.solver == "twist-band"
    count = _coefficients(segment, problem, request, clock) if banded else shape[0]
    basis = TemporalBasis(shape[0], count, problem.arrays)
    make = band_operator if banded else InBasis
    operator = make(segment.geometry, segment.code, basis, N_m, T_m, segment.alignment)
    parameters = TwistParameters()
    if request.tv_weight is not None:
        parameters = replace(parameters, tv_weight=request.tv_weight)
    solver = Twist(
        problem.masked(operator),
        problem.used_samples,
        (basis.count, *shape[1:]),
        parameters,
        basis if banded else None,
    )
    estimate = InBand(solver, operator, basis, problem, parameters)
    for _ in clock.run(request.iterations, "solve", video=estimate.video):
        solver.step()
    return estimate


class Lit:
    """A known image with a curve: X = s(t)·image.

    Frames that the code leaves dark are not observed: their light is interpolated from those beside them.
    """

    def __init__(
        self, segment: Segment, problem: Problem, request: Request, image: NDArray[Any], clock: IterationClock
    ) -> None:
        frames = segment.geometry.video_shape(request.spatial_merge, request.temporal_merge)[0]
        self._problem = problem = problem.on_host()
        arrays = problem.arrays
        self._image, self._merge = image.astype(arrays.dtype), request.spatial_merge
        basis = TemporalBasis(frames, frames, arrays)
        patterns = self._image[None] / np.linalg.norm(self._image)
        self._operator = CurveOperator(segment, patterns, basis, request.temporal_merge)
        coefficients = np.zeros((frames, 1))
        for _ in clock.run(1, "light"):
            coefficients = CurveFit(segment, problem, basis, request.temporal_merge)(patterns, coefficients)
        self._coefficients = arrays.asarray(coefficients)
        seen = np.add.reduceat(segment.code, np.arange(0, len(segment.code), request.temporal_merge)) > 0
        light = basis.synthesize(self._coefficients)[:, 0] / np.linalg.norm(self._image)
        self._light = np.interp(np.arange(frames), np.flatnonzero(seen), light[seen]).astype(arrays.dtype)

    def predict(self) -> NDArray[Any]:
        return host(self._operator.forward(self._coefficients)) / self._problem.norm

    def video(self) -> NDArray[Any]:
        video: NDArray[Any] = self._light[:, None, None] * merge_video(self._image[None], self._merge, 1)
        return video

    def facts(self) -> dict[str, Any]:
        return {"patterns": 1}


def _coefficients(segment: Segment, problem: Problem, request: Request, clock: IterationClock) -> int:
    N_m, T_m = request.spatial_merge, request.temporal_merge
    if request.bandwidth is None and clock.spent(UNSEARCHED_SHARE):
        frames = segment.geometry.video_shape(N_m, T_m)[0]
        few = min(frames, FEWEST_COEFFICIENTS)
        limit_hz = few / (2e-9 * segment.substep_ns * T_m * frames)
        clock.shortcuts.append(
            f"the budget left no time to look for the scene's bandwidth: only what is slower than "
            f"{limit_hz:.3g} Hz is in the video"
        )
        return few
    if request.bandwidth is None:
        return estimate_coefficients(segment, N_m, T_m, lambda: clock.spent(TENTATIVE_SHARE), problem.arrays)
    frames = segment.geometry.video_shape(N_m, T_m)[0]
    return min(frames, max(1, round(request.bandwidth * frames)))


def _defaults(frames: int, *, explained: bool = False) -> AdmmParameters:
    """Parameters for a video of so many frames.

    Coefficients grow with the root of the frames, and so does the threshold λ/ρ that suits them. A handful
    of frames of a moving scene cannot explain its lines: its penalties are higher, which fits less of that.
    Where they do (``explained``), the scene rests, as a still does.
    """
    if frames == 1:
        return STILL
    usual = AdmmParameters()
    threshold = usual.tv_weight / usual.tv_penalty * min(1.0, frames / USUAL_FRAMES) ** 0.5
    penalty = usual.tv_penalty * (HELD_BACK if frames <= FEW_FRAMES and not explained else 1.0)
    return replace(
        usual,
        tv_weight=threshold * penalty,
        tv_penalty=penalty,
        sign_penalty=usual.sign_penalty * penalty / usual.tv_penalty,
        gradient_steps=STILL.gradient_steps if explained else usual.gradient_steps,
    )


def _weighted(parameters: AdmmParameters, tv_weight: float | None) -> AdmmParameters:
    return parameters if tv_weight is None else replace(parameters, tv_weight=tv_weight)
