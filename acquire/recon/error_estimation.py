"""Measurement of the indicators of a video's error (`error`), by continuing its solver."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.forward import DualArm
from acquire.recon.error import BY_LINES, BY_PRIOR, error_from, full_scale, measure_indicators, rms_of
from acquire.recon.estimates import Continuable
from acquire.recon.holdout import held_out_blocks

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon.clock import IterationClock
    from acquire.recon.error import VideoError
    from acquire.recon.estimates import Estimate
    from acquire.recon.given import Given
    from acquire.recon.problem import Problem
    from acquire.recon.result import Quality

EXTRA_ITERATIONS = 15
"""Number of extra iterations used to estimate the error."""
RESERVED_ITERATIONS = 18.0
"""Time reserved in a budget for the estimate, in iterations of the solver; fewer extra ones fit into it."""
WITHHELD, WITHHELD_SEED = 0.25, 101
"""Share of the samples that are withheld in addition, in blocks, and the seed that draws the blocks."""
FEWEST = 4
"""Fewest iterations without the withheld samples when a budget ends them."""
GROWTH = 0.25
"""Exponent of the video's change over the number of iterations, to extrapolate to those that were left out: 5
iterations moved it by 0.6 to 1.1 of what 15 do."""
HEAVIER = 10**0.5
"""Factor of the prior's weight λ: one step of the search for it."""
FEWEST_HEAVIER = 2
"""Fewest iterations under the heavier prior when a budget ends them."""
EARLY = (2, 5)
"""Numbers of unchanged iterations that the final drift is compared with; the latter must be at least twice as
many."""
ASSUMED_DRIFT = 0.5
"""Drift assumed for a video that a budget cut and left no time to measure: the middle of those measured."""
UNSUPPORTED = "its solver offers no way to estimate it"
NO_TIME = "the budget left no time for it"


@dataclass(frozen=True, slots=True, eq=False)
class Continued:
    """A dimensionless ``video`` after ``made`` more iterations, and the exponents of its further change."""

    video: NDArray[Any]
    made: int
    growth: float
    drift: float = 0.0


def estimate_error(
    given: Given, estimate: Estimate, *, video: NDArray[Any], quality: Quality, cut: bool
) -> VideoError | str:
    """Estimate the error of ``video`` (T/T_m, n/N_m, n/N_m) in scene units, or return why there is none.

    ``cut`` says that the solver was ended before it converged.
    """
    segment, problem, clock, (N_m, T_m) = given.segment, given.problem, given.clock, given.merges
    trusted = segment.geometry.trusted_frames(T_m)
    if not range(len(video))[trusted]:
        return "no frame is sampled in full"
    if not (isinstance(estimate, Continuable) and problem.held_out.any()):
        return UNSUPPORTED
    began_s = clock.processor_s
    # It is measured before there is a second video: of a large sensor, each is a gigabyte.
    white = white_error(segment, problem, given.merges)
    facts = estimate.facts()
    at_rest = facts.get("prior") == "still" or bool(facts.get("change"))
    fine = at_rest and N_m < segment.geometry.substeps
    if cut or fine or "patterns" in facts:
        exponents, residual = BY_PRIOR, float(np.nanmax([quality.misfit, quality.prediction]))
        continued = _under_heavier_prior(problem, estimate, video, trusted, clock)
    else:
        exponents, residual = BY_LINES, quality.prediction
        continued = _with_fewer_lines(problem, estimate, clock)
    if clock.stop_requested:
        return "the reconstruction was stopped"
    if isinstance(continued, str):
        return continued
    indicators = measure_indicators(
        video,
        _shown(continued.video, problem),
        residual * white,
        trusted,
        exponents,
        growth=(EXTRA_ITERATIONS / continued.made) ** continued.growth,
        drift=continued.drift,
        fine=fine,
    )
    if indicators is None:
        return "the video is dark"
    return replace(error_from(indicators, trusted), processor_s=clock.processor_s - began_s)


def _with_fewer_lines(problem: Problem, estimate: Continuable, clock: IterationClock) -> Continued | str:
    """The video with another quarter of the lines withheld."""
    # It gets blocks of its own: those that the solver was judged by are in use meanwhile.
    withheld = held_out_blocks(problem.usable, WITHHELD, WITHHELD_SEED)
    continuation = estimate.continue_with(problem.holding_out(withheld))
    if continuation is None:
        return UNSUPPORTED
    made = 0
    for made, _ in enumerate(clock.run_reserved(EXTRA_ITERATIONS), 1):  # noqa: B007 (the count is used after the loop)
        continuation.step()
    return Continued(continuation.video(), made, GROWTH) if made >= FEWEST else NO_TIME


def _under_heavier_prior(
    problem: Problem, estimate: Continuable, video: NDArray[Any], trusted: slice, clock: IterationClock
) -> Continued | str:
    """The video under a heavier prior, and its drift under its own."""
    distances = _drift_distances(problem, estimate, video, trusted, clock)
    continuation = estimate.continue_with(problem, HEAVIER, still=True)
    if distances is None or continuation is None:
        return UNSUPPORTED
    made, most = 0, max(distances, default=EXTRA_ITERATIONS)
    reserved = clock.run_reserved(max(most, FEWEST_HEAVIER), FEWEST_HEAVIER)
    for made, _ in enumerate(reserved, 1):  # noqa: B007 (the count is used after the loop)
        continuation.step()
    if made < FEWEST_HEAVIER:
        return NO_TIME
    # The drift is the growth over the last half or more of the iterations.
    last = max(distances, default=0)
    early = max((each for each in distances if each <= last / 2), default=None)
    if early is None:
        drift = ASSUMED_DRIFT if clock.ended == "budget" else 0.0
    else:
        floor = max(BY_PRIOR.floor * full_scale(video[trusted]), 1e-30)
        change = [np.hypot(distances[each], floor) for each in (early, last)]
        drift = float(np.clip(np.log(change[1] / change[0]) / np.log(last / early), -1, 1))
    # A negative drift is that of a solver that converges: its change is not extrapolated to a smaller one.
    return Continued(continuation.video(), made, max(drift, 0.0), drift)


def _drift_distances(
    problem: Problem, estimate: Continuable, video: NDArray[Any], trusted: slice, clock: IterationClock
) -> dict[int, float] | None:
    """RMS change of the video as its solver continues unchanged, by the number of iterations.

    Empty if there is no time for it. It has to run before the heavier prior and not in turn with it, because
    all continuations of an estimate share one dual field of the denoiser.
    """
    continuation = estimate.continue_with(problem, still=True)
    if continuation is None:
        return None
    distances: dict[int, float] = {}

    def distance() -> float:
        shown = _shown(continuation.video()[trusted], problem)
        shown -= video[trusted]
        return rms_of(shown)

    made = 0
    for made, _ in enumerate(clock.run_reserved(EXTRA_ITERATIONS, repeat=2 * EARLY[0]), 1):
        continuation.step()
        if made in EARLY:
            distances[made] = distance()
    return distances | {made: distance()} if made else {}


def _shown(video: NDArray[Any], problem: Problem) -> NDArray[Any]:
    """A dimensionless video in scene units, in its place, clipped as is the video it is compared with."""
    video *= problem.scale
    np.maximum(video, 0, out=video)
    return video


def white_error(segment: Segment, problem: Problem, merges: tuple[int, int]) -> float:
    """RMS of independent errors of all voxels, in scene units, relative to the residual that they cause."""
    operator = DualArm(
        segment.geometry, segment.code, *merges, alignment=segment.alignment, blur=segment.blur
    )
    # Random signs show the energy of independent errors, Σ of Λ′'s squared elements, without the matrix, and
    # their RMS is exactly 1. They are made from int8 and in place, because a video can be large.
    signs = np.random.default_rng(0).integers(0, 2, operator.video_shape, np.int8).astype(np.float32)
    signs *= 2
    signs -= 1
    of_one = float(np.sqrt(np.square(operator.forward(signs)[problem.usable], dtype=np.float64).mean()))
    level = float(np.sqrt(np.square(problem.samples[problem.held_out], dtype=np.float64).mean()))
    return level * problem.norm * problem.scale / max(of_one, 1e-30)
