"""The default solver: it chooses the prior that predicts the held-out blocks best, then uses all samples.

    still      one frame, total variation                         for rest, or light too weak for more
    volume     few cosines, total variation of a volume           for motion; also times a free brightness
    smooth     few cosines, quadratic in second differences       for flow
    cosines    the whole band, total variation of coefficients    for lamps, then as patterns and curves

Where a still explains most of the lines and a volume is not clearly better, the cosines start from the still:
lines carry no information about sub-steps without light, so that a start from zero leaves the code in the
video. A stronger prior is preferred unless a weaker one is clearly better, because the noise that a weak
prior admits hardly shows in the lines, which are sums. Nothing here uses the truth, and no weight is fixed:
those in the code are starting points of searches.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

from acquire.arrays import host
from acquire.recon.blinking import EXPLAINED, first_look, refine, solve_in_cosines
from acquire.recon.estimates import Preferred
from acquire.recon.holdout import HeldOut
from acquire.recon.patterns import find_patterns
from acquire.recon.reuse import reuse_choice
from acquire.recon.solver import Preset, Solver
from acquire.recon.still import best_still, change_bench, weighted_like
from acquire.recon.workbench import (
    CALM,
    FIRST_ITERATIONS,
    LEAST_GAIN,
    SEARCH_SHARE,
    SMOOTH,
    STILL,
    VOLUME,
    Workbench,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from acquire.lines import Segment
    from acquire.recon.clock import IterationClock
    from acquire.recon.estimates import Estimate, InBand
    from acquire.recon.options import SolveOptions
    from acquire.recon.problem import Problem
    from acquire.recon.workbench import Trial

ITERATIONS_PER_TRIAL = 10
"""Iterations of a preset for each trial of a search."""
OUTDONE = 0.6
"""Largest error of the cosines, relative to the other candidates, that makes the search for a better volume
unnecessary."""
FAR = 1.25
"""Largest error of a smooth volume or a still, relative to the volume's, for which it is searched further."""
SMOOTHER = 0.85
"""Largest error of a smooth volume, relative to the volume's, for which it is preferred: a quadratic prior
admits more noise that does not show."""
CLEARLY = 0.97
"""Largest error of a volume, relative to a still's, for which it is preferred; the change from a still equals
the still where its prior is strong, and need only be better."""
CLOSE, DOUBTFUL = 1.1, 2.0
"""Largest error of the cosines, relative to the best trial's, for which they are continued, and for which
they are if clear patterns were found."""


class AdmmSolver(Solver):
    """Ridge ADMM with the prior that predicts best; the held-out samples may end it early."""

    iterations: ClassVar[Mapping[Preset, int]] = {"fast": 40, "balanced": 150, "best": 300}
    goes_on: ClassVar[bool] = True
    takes: ClassVar[frozenset[str]] = frozenset({"initial", "denoiser", "choice"})

    def solve(
        self, segment: Segment, problem: Problem, options: SolveOptions, clock: IterationClock
    ) -> Estimate:
        return solve_admm(segment, problem, options, clock)


def solve_admm(segment: Segment, problem: Problem, options: SolveOptions, clock: IterationClock) -> Estimate:
    """Solve with the prior that predicts best.

    If the options give a bandwidth, weight, denoiser or start, the cosines are solved for without a choice.
    """
    held_out = HeldOut(problem, segment.geometry)
    fixed = (options.denoiser, options.tv_weight, options.bandwidth, options.initial)
    if not held_out or any(each is not None for each in fixed):
        return solve_in_cosines(segment, problem, options, clock)
    bench = Workbench(segment, problem, options, clock, held_out)
    trials = max(4, options.iterations // ITERATIONS_PER_TRIAL)
    if options.choice is not None:
        reused = reuse_choice(bench, segment, options, trials)
        if reused is not None:
            return reused
    if bench.frames == 1:
        still = bench.attempt(STILL, FIRST_ITERATIONS)
        return bench.finish(best_still(still, trials, merge=options.spatial_merge))
    volume = bench.attempt(bench.fitting(VOLUME), FIRST_ITERATIONS)
    if clock.spent(SEARCH_SHARE):
        clock.shortcuts.append("the budget left no time to try more than one kind of motion")
        return bench.finish(volume)
    return _choose(bench, segment, options, volume, trials)


def _choose(
    bench: Workbench, segment: Segment, options: SolveOptions, volume: Trial, trials: int
) -> Estimate:
    """Compare a first volume with a still, the cosines and the other priors, and solve with the best.

    The cosines are tried before better stills are searched for: a scene that blinks needs most of a budget
    for them, and yet a still of it may explain the lines to 10 %.
    """
    problem, clock, held_out = bench.problem, bench.clock, bench.held_out
    still = plain = bench.attempt(bench.fitting(STILL), FIRST_ITERATIONS)
    at_rest = plain.error < EXPLAINED and not held_out.clearly_less(volume.errors, plain.errors)
    start = plain.coefficients if at_rest else None
    cosines = first_look(segment, problem, options, clock, start)
    bench.record_errors({"prior": "cosines"} | cosines.facts(), cosines.predict())
    best, error = _better(volume, plain), bench.error(cosines.predict())
    ahead = error <= OUTDONE * best.error
    blinks = ahead and _has_clear_patterns(cosines)
    if plain.error < min(EXPLAINED, FAR * volume.error) and not blinks:
        still = best_still(plain, trials, merge=options.spatial_merge)
        best = _better(volume, still)
        ahead = error <= OUTDONE * best.error
    if not ahead:
        best = _search(bench, plain, still, volume, cosines, trials)
    elif not clock.spent(SEARCH_SHARE) and not blinks:
        best = _challenge(bench, plain, cosines, trials) or best
    if _worth_refining(bench, cosines, still, best):
        refined = refine(segment, problem, options, clock, cosines)
        errors = bench.record_errors({"prior": "patterns"} | refined.facts(), refined.predict())
        if held_out.clearly_less(errors, best.errors):
            return Preferred(refined, bench.record)
    return bench.finish(best)


def _better(moving: Trial, still: Trial) -> Trial:
    most = 1 - LEAST_GAIN if moving.candidate.change else CLEARLY
    return moving if moving.error < most * still.error else still


def _search(
    bench: Workbench, plain: Trial, still: Trial, volume: Trial, cosines: InBand, trials: int
) -> Trial:
    """The best of stills, volumes, smooth volumes and volumes of changing brightness.

    ``plain`` is the first still, ``still`` the best one, which is the same if it was not searched for.
    """
    if still is plain and still.error < FAR * volume.error:
        plain = still = bench.climb(still, trials)
    calm = bench.attempt(bench.fitting(CALM), FIRST_ITERATIONS, still)
    bright = bench.brighten(plain, cosines.basis.count)
    moving = [volume, calm, bright or calm]
    if still is not plain:
        candidate = replace(weighted_like(still, bench.fitting(VOLUME)), change=True)
        moving.append(change_bench(bench, still).attempt(candidate, FIRST_ITERATIONS))
    volume = min(moving, key=lambda trial: trial.error)
    smooth = bench.attempt(bench.fitting(SMOOTH), FIRST_ITERATIONS)
    volume = volume.bench.climb(volume, trials)
    if smooth.error < FAR * volume.error:
        smooth = bench.climb(smooth, trials)
    flows = smooth.error < SMOOTHER * volume.error and bench.held_out.clearly_less(
        smooth.errors, still.errors
    )
    return _better(smooth if flows else volume, still)


def _challenge(bench: Workbench, plain: Trial, cosines: InBand, trials: int) -> Trial | None:
    """A scene that flickers as a whole or flows, if that predicts better than the cosines; else None.

    It is tried where the cosines are far ahead of a still and of a volume, but show no clear patterns.
    """
    rival = bench.error(cosines.predict())
    bright = bench.brighten(plain, cosines.basis.count, DOUBTFUL * rival)
    smooth = bench.attempt(bench.fitting(SMOOTH), FIRST_ITERATIONS)
    found = smooth if bright is None or smooth.error < SMOOTHER * bright.error else bright
    flows = found is smooth
    if found.error < FAR * rival:
        found = bench.climb(found, trials)
    return found if found.error < (SMOOTHER if flows else 1.0) * rival else None


def _worth_refining(bench: Workbench, cosines: InBand, still: Trial, best: Trial) -> bool:
    """Whether the first look in the cosines may still win, after more iterations or as patterns.

    If it predicts no better than a still, it has found nothing.
    """
    error = bench.error(cosines.predict())
    if error > still.error:
        return False
    if error < CLOSE * best.error:
        return True
    return error <= DOUBTFUL * best.error and _has_clear_patterns(cosines)


def _has_clear_patterns(cosines: InBand) -> bool:
    return find_patterns(host(cosines.solver.theta), beyond_doubt=True) is not None
