"""A choice of prior, weight and band that was made on one part of a scene, handed on to another.

Most of the time that a reconstruction takes is its search (`acquire.recon.choose`). What was found for one
tile, or one stretch, is tried first on the next, and stays where the held-out blocks are predicted there as
closely as where it was found, in units of the noise; larger weights are tried beside it, since noise that a
small one lets through hardly shows in the lines. Else a still is searched for from there on, and a video as
if nothing had been handed on. Beside a moving choice a still is tried, which costs little: what rests beside
what moves is not made to move.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

from acquire.recon.blinking import EXPLAINED, go_on, look_in_cosines
from acquire.recon.estimates import Preferred
from acquire.recon.result import EXPLAINED as EXPLAINED_NOISE
from acquire.recon.workbench import (
    FIRST_ITERATIONS,
    LARGEST_WEIGHT,
    NEXT_ITERATIONS,
    SEARCH_SHARE,
    STILL,
    WEIGHT_STEP,
    Candidate,
)

if TYPE_CHECKING:
    from acquire.lines import Segment
    from acquire.recon.clock import IterationClock
    from acquire.recon.estimates import Estimate
    from acquire.recon.options import SolveOptions
    from acquire.recon.problem import Problem
    from acquire.recon.result import Reconstruction
    from acquire.recon.workbench import Trial, Workbench

AS_CLOSELY = 1.05
"""Of the held-out error where a choice was made, in units of the noise, up to which it fits elsewhere: a step
of the search is taken for a gain of 2 %, and errors of a few hundred blocks differ by as much by chance."""
COSINES = "cosines"


@dataclass(frozen=True, slots=True)
class Choice:
    """What was chosen, and how well it predicted: ``error`` and ``noise`` are relative to the samples.

    ``prior`` is that of a candidate, or `COSINES`, of which only their number is handed on. ``brightness`` is
    the number of cosines in that of the whole scene; 0: it is constant.
    """

    prior: str
    coefficients: int
    weight: float
    pace: float
    error: float
    noise: float
    brightness: int = 0
    fine: bool = False

    @classmethod
    def of(cls, result: Reconstruction) -> Self | None:
        """That of a reconstruction; None where nothing was chosen, or what was hangs on what passes there."""
        found = result.parameters
        if "candidates" not in found or found.get("robust") or found.get("change"):
            return None
        curve = [each["temporal_coefficients"] for each in found["candidates"] if each["prior"] == COSINES]
        weight, pace = (0.0, 0.0) if found["prior"] == COSINES else (found["weight"], found["pace"])
        prior, count, quality = found["prior"], found["temporal_coefficients"], result.quality
        brightness = curve[0] if found.get("brightness") and curve else 0
        told = quality.prediction, quality.noise, brightness, bool(found.get("fine"))
        return cls(prior, count, weight, pace, *told)

    def fits(self, error: float, noise: float) -> bool:
        """Whether samples are predicted as closely as where it was chosen, of noise where that is known; a
        choice that did not explain its own is no measure."""
        if self.noise > 0 and noise > 0:
            return error / noise <= AS_CLOSELY * min(self.error / self.noise, EXPLAINED_NOISE)
        return error <= AS_CLOSELY * self.error

    def kept(self, parameters: dict[str, Any]) -> bool:
        """Whether a reconstruction of these parameters is what it says."""
        same = parameters.get("prior") == self.prior
        if not same or bool(parameters.get("brightness")) != bool(self.brightness):
            return False
        return self.prior == COSINES or (parameters["weight"], parameters["pace"]) == (self.weight, self.pace)

    def candidate(self, frames: int) -> Candidate:
        """As it is tried on so many frames."""
        cosines = min(self.coefficients, frames)
        bright, fine = bool(self.brightness), self.fine
        return Candidate(self.prior, cosines, self.weight, self.pace, bright, fine=fine)  # type: ignore[arg-type]  # not cosines


def follow(
    bench: Workbench,
    segment: Segment,
    problem: Problem,
    options: SolveOptions,
    clock: IterationClock,
    trials: int,
) -> Estimate | None:
    """What the handed choice leads to; None where it does not fit, and all is to be searched."""
    choice, frames = options.choice, bench.frames
    assert choice is not None
    noise, resting = problem.noise(segment), choice.prior == STILL.prior
    if resting:
        still = bench.on(bench.problem, fine=choice.fine).attempt(choice.candidate(frames), FIRST_ITERATIONS)
    else:
        still = bench.attempt(bench.fitting(STILL), FIRST_ITERATIONS)
    fits = resting and choice.fits(still.error, noise)
    if fits or still.error <= AS_CLOSELY * noise or clock.spent(SEARCH_SHARE):
        return bench.finish(_strengthened(still, clock))
    if resting:
        return bench.finish(still.bench.climb(still, trials)) if frames == 1 else None
    if choice.prior == COSINES:
        return _in_cosines(bench, still, segment, problem, options, clock)
    lit = bench.brighten(still, choice.brightness) if choice.brightness else None
    if lit is None and choice.brightness:
        return None
    moving = bench.attempt(choice.candidate(frames), FIRST_ITERATIONS, lit)
    best = moving if bench.held_out.clearly_less(moving.errors, still.errors) else still
    return bench.finish(_strengthened(best, clock)) if choice.fits(best.error, noise) else None


def _strengthened(best: Trial, clock: IterationClock) -> Trial:
    """With a larger weight, as far as the prediction gets no worse by it."""
    while not clock.spent(SEARCH_SHARE) and best.candidate.weight * WEIGHT_STEP <= LARGEST_WEIGHT:
        weight = float(f"{best.candidate.weight * WEIGHT_STEP:.3g}")
        found = best.bench.attempt(replace(best.candidate, weight=weight), NEXT_ITERATIONS, best)
        if not found.error < best.error:
            break
        best = found
    return best


def _in_cosines(
    bench: Workbench,
    still: Trial,
    segment: Segment,
    problem: Problem,
    options: SolveOptions,
    clock: IterationClock,
) -> Estimate | None:
    """As `choose` goes on from a still where cosines are ahead, in the handed band."""
    assert options.choice is not None
    band = replace(options, bandwidth=min(1.0, options.choice.coefficients / bench.frames))
    start = still.admm.theta if still.error < EXPLAINED else None
    first = look_in_cosines(segment, problem, band, clock, start)
    bench.note({"prior": COSINES} | first.facts(), first.predict())
    found = go_on(segment, problem, options, clock, first)
    errors = bench.note({"prior": "patterns"} | found.facts(), found.predict())
    ahead = bench.held_out.clearly_less(errors, still.errors)
    if ahead and options.choice.fits(bench.held_out.relative(errors), problem.noise(segment)):
        return Preferred(found, bench.record)
    clock.begin_anew()  # the search has all of its iterations before it
    return None
