"""The default: whichever prior predicts the held-out blocks best, then all samples.

    still      one frame, total variation                         what rests, or light too weak for more
    volume     few cosines, total variation of a volume           what moves; also times a free brightness
    smooth     few cosines, quadratic in second differences       what flows
    cosines    the whole band, total variation of coefficients    what blinks, then as patterns and curves

Where a still explains most, and a volume is not clearly better, cosines begin from it: lines say nothing of
sub-steps without light, so that what begins in darkness stays lit with the code. A stronger prior is
preferred to one that is not clearly better: noise that a weak one lets through hardly shows in the lines,
which are sums. Nothing here sees the truth, and no weight is fixed: those in the code are where searches
begin.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

from acquire.arrays import host
from acquire.recon.blinking import EXPLAINED, go_on, look_in_cosines, solve_blinking
from acquire.recon.estimates import Preferred
from acquire.recon.handed import follow
from acquire.recon.holdout import HeldOut
from acquire.recon.patterns import find_patterns
from acquire.recon.rest import best_still, changing, told_by
from acquire.recon.solver import Preset, Solver
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
"""Of a preset's iterations, for each trial of a search."""
OUTDONE = 0.6
"""Of the others' held-out error, what cosines must stay below to spare the search for a better volume."""
FAR = 1.25
"""Of a volume's error, beyond which a smooth one or a still is not searched."""
SMOOTHER = 0.85
"""Of a volume's error, what a smooth one must reach: a quadratic prior lets more noise through unseen."""
CLEARLY = 0.97
"""Of a still's error, what a volume must reach to be preferred; one of what changes beside it, which is the
still where its prior is strong, need only be better."""
CLOSE, DOUBTFUL = 1.1, 2.0
"""Of the best trial's error: where cosines are gone on with, and where they are if patterns stand out."""


class AdmmSolver(Solver):
    """Ridge ADMM with whichever prior predicts best; ends sooner when the held-out samples say so."""

    iterations: ClassVar[Mapping[Preset, int]] = {"fast": 40, "balanced": 150, "best": 300}
    goes_on: ClassVar[bool] = True
    takes: ClassVar[frozenset[str]] = frozenset({"initial", "denoiser", "choice"})

    def solve(
        self, segment: Segment, problem: Problem, options: SolveOptions, clock: IterationClock
    ) -> Estimate:
        return solve_admm(segment, problem, options, clock)


def solve_admm(segment: Segment, problem: Problem, options: SolveOptions, clock: IterationClock) -> Estimate:
    """The chosen prior's video; as asked where the options fixes bandwidth, weight, denoiser or start."""
    held_out = HeldOut(problem, segment.geometry)
    asked = (options.denoiser, options.tv_weight, options.bandwidth, options.initial)
    if not held_out or any(each is not None for each in asked):
        return solve_blinking(segment, problem, options, clock)
    bench = Workbench(segment, problem, options, clock, held_out)
    trials = max(4, options.iterations // ITERATIONS_PER_TRIAL)
    if options.choice is not None:
        followed = follow(bench, segment, problem, options, clock, trials)
        if followed is not None:
            return followed
    if bench.frames == 1:
        still = bench.attempt(STILL, FIRST_ITERATIONS)
        return bench.finish(best_still(still, trials, merge=options.spatial_merge))
    volume = bench.attempt(bench.fitting(VOLUME), FIRST_ITERATIONS)
    if clock.spent(SEARCH_SHARE):
        clock.shortcuts.append("the budget left no time to try more than one kind of motion")
        return bench.finish(volume)
    return _beside_cosines(bench, segment, options, volume, trials)


def _beside_cosines(
    bench: Workbench, segment: Segment, options: SolveOptions, volume: Trial, trials: int
) -> Estimate:
    """A still, cosines and whatever else may win beside a first volume.

    Cosines come before the better stills: what blinks needs most of a budget for itself, and a still of it
    may explain the lines to 10 % all the same.
    """
    problem, clock, held_out = bench.problem, bench.clock, bench.held_out
    still = plain = bench.attempt(bench.fitting(STILL), FIRST_ITERATIONS)
    rests = plain.error < EXPLAINED and not held_out.clearly_less(volume.errors, plain.errors)
    first = look_in_cosines(segment, problem, options, clock, plain.coefficients if rests else None)
    bench.note({"prior": "cosines"} | first.facts(), first.predict())
    best, error = _better(volume, plain), bench.error(first.predict())
    ahead = error <= OUTDONE * best.error
    blinks = ahead and _in_patterns(first)
    if plain.error < min(EXPLAINED, FAR * volume.error) and not blinks:
        still = best_still(plain, trials, merge=options.spatial_merge)
        best = _better(volume, still)
        ahead = error <= OUTDONE * best.error
    if not ahead:
        best = _search(bench, plain, still, volume, first, trials)
    elif not clock.spent(SEARCH_SHARE) and not blinks:
        best = _challenge(bench, plain, first, trials) or best
    if _worth_going_on(bench, first, still, best):
        blinking = go_on(segment, problem, options, clock, first)
        errors = bench.note({"prior": "patterns"} | blinking.facts(), blinking.predict())
        if held_out.clearly_less(errors, best.errors):
            return Preferred(blinking, bench.record)
    return bench.finish(best)


def _better(moving: Trial, still: Trial) -> Trial:
    most = 1 - LEAST_GAIN if moving.candidate.change else CLEARLY
    return moving if moving.error < most * still.error else still


def _change(bench: Workbench, still: Trial) -> Trial:
    candidate = replace(told_by(still, bench.fitting(VOLUME)), change=True)
    return changing(bench, still).attempt(candidate, FIRST_ITERATIONS)


def _search(bench: Workbench, plain: Trial, still: Trial, volume: Trial, first: InBand, trials: int) -> Trial:
    """The best of stills, volumes, smooth ones and those of changing brightness."""
    if still is plain and still.error < FAR * volume.error:
        plain = still = bench.climb(still, trials)
    calm = bench.attempt(bench.fitting(CALM), FIRST_ITERATIONS, still)
    bright = bench.brighten(plain, first.basis.count)
    change = calm if still is plain else _change(bench, still)
    volume = min([volume, calm, bright or calm, change], key=lambda trial: trial.error)
    smooth = bench.attempt(bench.fitting(SMOOTH), FIRST_ITERATIONS)
    volume = volume.bench.climb(volume, trials)
    if smooth.error < FAR * volume.error:
        smooth = bench.climb(smooth, trials)
    flows = smooth.error < SMOOTHER * volume.error and bench.held_out.clearly_less(
        smooth.errors, still.errors
    )
    return _better(smooth if flows else volume, still)


def _challenge(bench: Workbench, plain: Trial, first: InBand, trials: int) -> Trial | None:
    """A scene that flickers as a whole, or one that flows, where cosines are far ahead of a still and of a
    volume and yet no patterns; None where neither predicts better than they."""
    rival = bench.error(first.predict())
    bright = bench.brighten(plain, first.basis.count, DOUBTFUL * rival)
    smooth = bench.attempt(bench.fitting(SMOOTH), FIRST_ITERATIONS)
    found = smooth if bright is None or smooth.error < SMOOTHER * bright.error else bright
    flows = found is smooth
    if found.error < FAR * rival:
        found = bench.climb(found, trials)
    return found if found.error < (SMOOTHER if flows else 1.0) * rival else None


def _worth_going_on(bench: Workbench, first: InBand, still: Trial, best: Trial) -> bool:
    """Whether a first look in the cosines, which more iterations and patterns would improve, may yet win.

    One that predicts no better than a first still has found nothing.
    """
    error = bench.error(first.predict())
    if error > still.error:
        return False
    if error < CLOSE * best.error:
        return True
    if error > DOUBTFUL * best.error:
        return False
    return _in_patterns(first)


def _in_patterns(first: InBand) -> bool:
    return find_patterns(host(first.solver.theta), beyond_doubt=True) is not None
