"""Scenes that blink: cosines of the whole band first, then patterns and curves where they are of a few.

    cosines ── few patterns? ── yes ─▶ patterns and curves at full resolution
                └────────────── no ──▶ more of the same

Held-out samples end the refinement, and the round that predicted them best is the result: at full resolution
the model has no error of its own to fit, so they are predicted better as long as the picture gets better.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from acquire.arrays import host
from acquire.recon.admm import Admm, AdmmParameters
from acquire.recon.band import band_operator
from acquire.recon.bandwidth import FEWEST_COEFFICIENTS, MARGIN, estimate_coefficients, light_beyond
from acquire.recon.basis import TemporalBasis, resized
from acquire.recon.estimates import InBand, Refined
from acquire.recon.patterns import ROUND, Refinement, find_patterns

if TYPE_CHECKING:
    from acquire.arrays import Array
    from acquire.lines import Segment
    from acquire.recon.clock import IterationClock
    from acquire.recon.estimates import Estimate
    from acquire.recon.options import SolveOptions
    from acquire.recon.problem import Problem

FIRST_LOOK, LONGER_LOOK = 60, 90
"""Iterations in the cosines before patterns are looked for; longer where these are in doubt."""
FIRST_LOOK_SHARE = 0.7
"""Of a budget, the most that the first look may take."""
BEYOND_S = 2e-6
"""What it takes to look for light beyond the band, for each line and frame; not done with less to spare."""
WIDER_SHARE = 0.5
"""Of a budget, after which nothing is made again in a wider band."""
TENTATIVE_SHARE = 0.15
"""Of a budget, after which the search for the bandwidth hurries."""
LAMPS_SHARE = 0.3
"""Of a budget: where the fastest lamp would not be found before, it is not looked for."""
UNSEARCHED_SHARE = 0.4
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
"""Relative error of prediction below which they do, and a still is what cosines begin from."""
STILL = AdmmParameters(tv_weight=5e-6, tv_penalty=1e-5, sign_penalty=3e-6, gradient_steps=6)
"""For a single frame. All sub-steps add up in it, so that the mean light has an eigenvalue some thousand
times that of a detail: lower penalties let details through, more gradient steps reach them."""
LEAST_GAIN = 0.003
"""Relative gain of the held-out prediction in a round below which the round was in vain."""
PATIENCE = 6
"""Rounds in vain that end a refinement."""


def solve_blinking(
    segment: Segment, problem: Problem, options: SolveOptions, clock: IterationClock
) -> Estimate:
    """Cosines first, then patterns and curves where the scene is of a few."""
    return go_on(segment, problem, options, clock, look_in_cosines(segment, problem, options, clock))


def look_in_cosines(
    segment: Segment,
    problem: Problem,
    options: SolveOptions,
    clock: IterationClock,
    still: Array | None = None,
) -> InBand:
    """A first look in the band that was asked for or found, from the coefficients (1, n′, n′) of a still."""
    count = find_band(segment, problem, options, clock)
    return _look(segment, problem, options, clock, count, still)


def go_on(
    segment: Segment, problem: Problem, options: SolveOptions, clock: IterationClock, first: InBand
) -> Estimate:
    """Patterns, or more of the same; once more in a wider band where the lines show light beyond this one."""
    found = _go_on(segment, problem, options, clock, first)
    if not clock.affords(BEYOND_S * segment.geometry.lines * first.basis.frames):
        return found
    predicted = found.predict()
    beyond = light_beyond(segment, problem, predicted, options.temporal_merge, first.basis.count)
    if beyond is None:
        return found
    if options.bandwidth is not None or clock.spent(WIDER_SHARE):
        rate_hz = 1e9 / (segment.substep_ns * options.temporal_merge)
        clock.shortcuts.append(
            f"the lines hold light of about {beyond * rate_hz / (2 * first.basis.frames):.3g} Hz, which is "
            "faster than what the video may hold: a longer budget or another bandwidth shows it"
        )
        return found
    clock.begin_anew()
    still = first.solver.theta[:1, ...]
    first = _look(segment, problem, options, clock, round(MARGIN * (beyond + 1)), still)
    wider = _go_on(segment, problem, options, clock, first)
    better = problem.prediction_error(wider.predict()) < problem.prediction_error(predicted)
    return wider if better else found


def _look(
    segment: Segment,
    problem: Problem,
    options: SolveOptions,
    clock: IterationClock,
    count: int,
    still: Array | None = None,
) -> InBand:
    frames = segment.geometry.video_shape(options.spatial_merge, options.temporal_merge)[0]
    basis = TemporalBasis(frames, min(frames, count), problem.arrays)
    return _first_look(segment, problem, options, basis, clock, still)


def _go_on(
    segment: Segment, problem: Problem, options: SolveOptions, clock: IterationClock, first: InBand
) -> Estimate:
    refined = None if options.denoiser else _refine(segment, problem, options, first, clock)
    if refined is not None:
        return refined
    for _ in clock.run(PLAIN_ITERATIONS - clock.done, "solve", video=first.video):
        first.solver.step()
    return first


def _first_look(
    segment: Segment,
    problem: Problem,
    options: SolveOptions,
    basis: TemporalBasis,
    clock: IterationClock,
    still: Array | None,
) -> InBand:
    """In the cosines; few frames with lower penalties from where they turn out to explain the lines.

    From darkness the least video that explains the lines is lit with the code, since they say nothing of
    sub-steps without light, and total variation leaves flat light as it is. From a still, the least change
    that explains them is looked for.
    """
    N_m, T_m = options.spatial_merge, options.temporal_merge
    frames, side, _ = segment.geometry.video_shape(N_m, T_m)
    operator = band_operator(segment.geometry, segment.code, basis, N_m, T_m, segment.alignment, segment.blur)

    def begin(start: Array | None, *, explained: bool = False) -> InBand:
        parameters = _weighted(_defaults(frames, explained=explained), options.tv_weight)
        solver = Admm(
            problem.masked(operator),
            problem.used_samples,
            (basis.count, side, side),
            basis,
            parameters,
            start=start,
            denoiser=options.denoiser,
        )
        return InBand(solver, operator, basis, problem, parameters)

    start = None if still is None else resized(still, basis)
    if options.initial is not None:
        start = basis.analyze(problem.arrays.asarray(options.initial / problem.scale))
    estimate = begin(start)
    if 1 < frames <= FEW_FRAMES:
        for _ in clock.run(TRIAL, "first look", FIRST_LOOK_SHARE, estimate.video):
            estimate.solver.step()
        if problem.prediction_error(estimate.predict()) < EXPLAINED:
            estimate = begin(estimate.solver.theta, explained=True)
    for look in (FIRST_LOOK, LONGER_LOOK):
        most = min(look, -(-4 * options.iterations // 5))
        for _ in clock.run(most - clock.done, "first look", FIRST_LOOK_SHARE, estimate.video):
            estimate.solver.step()
        if find_patterns(host(estimate.solver.theta), beyond_doubt=True):
            break
    return estimate


def _refine(
    segment: Segment,
    problem: Problem,
    options: SolveOptions,
    first: InBand,
    clock: IterationClock,
) -> Estimate | None:
    """Patterns and curves from a first look; None where the scene is not made of a few."""
    goes_on = clock.done < clock.iterations and clock.affords(ROUND * clock.longest_s)
    found = find_patterns(host(first.solver.theta)) if goes_on else None
    if found is None:
        return None
    basis = TemporalBasis(first.basis.frames, first.basis.count, problem.arrays)
    merges = (options.spatial_merge, options.temporal_merge)
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


def find_band(segment: Segment, problem: Problem, options: SolveOptions, clock: IterationClock) -> int:
    N_m, T_m = options.spatial_merge, options.temporal_merge
    if options.bandwidth is None and clock.spent(UNSEARCHED_SHARE):
        frames = segment.geometry.video_shape(N_m, T_m)[0]
        few = min(frames, FEWEST_COEFFICIENTS)
        limit_hz = few / (2e-9 * segment.substep_ns * T_m * frames)
        clock.shortcuts.append(
            f"the budget left no time to look for the scene's bandwidth: only what is slower than "
            f"{limit_hz:.3g} Hz is in the video"
        )
        return few
    if options.bandwidth is None:
        return estimate_coefficients(
            segment,
            problem,
            (N_m, T_m),
            hurry=lambda: clock.spent(TENTATIVE_SHARE),
            affords=lambda seconds: clock.affords(seconds, LAMPS_SHARE),
        )
    frames = segment.geometry.video_shape(N_m, T_m)[0]
    return min(frames, max(1, round(options.bandwidth * frames)))


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
