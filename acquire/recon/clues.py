"""What the error of a video is estimated from (`error`): found by going on with its solver for a while."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.forward import DualArm
from acquire.recon.error import BY_LINES, BY_PRIOR, find_clues, from_clues, full_scale, rms_of
from acquire.recon.estimates import GoesOn
from acquire.recon.holdout import held_out_blocks

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon.clock import IterationClock
    from acquire.recon.error import VideoError
    from acquire.recon.estimates import Estimate
    from acquire.recon.problem import Problem
    from acquire.recon.result import Quality

ITERATIONS = 15
"""With which a video goes on."""
AS_LONG_AS = 18.0
"""Iterations of the solver's: that is kept of a budget for all of this, which makes fewer of them then."""
WITHHELD, WITHHELD_SEED = 0.25, 101
"""Share of the samples that are withheld, in blocks, and what draws these."""
FEWEST = 4
"""Iterations without them, at least, where a budget ends."""
GROWS = 0.25
"""Power of the number of iterations with which a picture moves, for those that were left out: 5 moved it by
0.6 to 1.1 of what 15 do."""
HEAVIER = 10**0.5
"""Factor of the prior's weight λ: a step of the search for it."""
FEWEST_HEAVIER = 2
"""Iterations under that prior, at least, where a budget ends."""
EARLY = (2, 5)
"""Iterations as it is that the drift at the end is held against, where that is twice as far."""
SUPPOSED = 0.5
"""Drift of what a budget cut, where it left no time to see it: the middle of those that were seen."""
NOTHING = "its solver gives nothing to tell it by"
NO_TIME = "the budget left no time for it"


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """To which dimensionless video, after how many iterations, and with which power of these it goes on."""

    video: NDArray[Any]
    made: int
    grows: float
    drifts: float = 0.0


def estimate_error(
    segment: Segment,
    problem: Problem,
    estimate: Estimate,
    video: NDArray[Any],
    quality: Quality,
    merges: tuple[int, int],
    clock: IterationClock,
    *,
    cut: bool,
) -> VideoError | str:
    """The error of ``video`` (T/T_m, n/N_m, n/N_m) in scene units, or why it cannot be told.

    ``cut``: the solver did not end by itself.
    """
    trusted = segment.geometry.trusted_frames(merges[1])
    if not range(len(video))[trusted]:
        return "no frame is sampled in full"
    if not (isinstance(estimate, GoesOn) and problem.held_out.any()):
        return NOTHING
    began_s = clock.processor_s
    facts = estimate.facts()
    rests = facts.get("prior") == "still" or bool(facts.get("change"))
    fine = rests and merges[0] < segment.geometry.substeps
    if cut or fine or "patterns" in facts:
        powers, missed = BY_PRIOR, float(np.nanmax([quality.misfit, quality.prediction]))
        move = _heavier(problem, estimate, video, trusted, clock)
    else:
        powers, missed = BY_LINES, quality.prediction
        move = _withheld(problem, estimate, clock)
    if clock.asked:
        return "the reconstruction was stopped"
    if isinstance(move, str):
        return move
    clues = find_clues(
        video,
        np.maximum(move.video * problem.scale, 0),
        white_error(segment, problem, missed, merges),
        trusted,
        powers,
        grown=(ITERATIONS / move.made) ** move.grows,
        drifts=move.drifts,
        fine=fine,
    )
    if clues is None:
        return "the video is dark"
    return replace(from_clues(clues, trusted), processor_s=clock.processor_s - began_s)


def _withheld(problem: Problem, estimate: GoesOn, clock: IterationClock) -> Move | str:
    """How the video moves when a further quarter of the lines is withheld."""
    onward = estimate.onward(problem.keeping(held_out_blocks(problem.usable, WITHHELD, WITHHELD_SEED)))
    if onward is None:
        return NOTHING
    made = 0
    for made, _ in enumerate(clock.afterwards(ITERATIONS), 1):  # noqa: B007
        onward.step()
    return Move(onward.video(), made, GROWS) if made >= FEWEST else NO_TIME


def _heavier(
    problem: Problem, estimate: GoesOn, video: NDArray[Any], trusted: slice, clock: IterationClock
) -> Move | str:
    """How the video moves under a heavier prior, and whether it moves on as it is."""
    drifted = _drift(problem, estimate, video, trusted, clock)
    onward = estimate.onward(problem, HEAVIER, still=True)
    if drifted is None or onward is None:
        return NOTHING
    made, most = 0, max(drifted, default=ITERATIONS)
    for made, _ in enumerate(clock.afterwards(max(most, FEWEST_HEAVIER), FEWEST_HEAVIER), 1):  # noqa: B007
        onward.step()
    if made < FEWEST_HEAVIER:
        return NO_TIME
    drifts = _power(drifted, BY_PRIOR.faint * full_scale(video[trusted]))
    if drifts is None:
        drifts = SUPPOSED if clock.ended == "budget" else 0.0
    return Move(onward.video(), made, max(drifts, 0.0), drifts)


def _drift(
    problem: Problem, estimate: GoesOn, video: NDArray[Any], trusted: slice, clock: IterationClock
) -> dict[int, float] | None:
    """How far the video moves as it is, by the number of iterations; empty where there is no time for it.

    Before, and not beside, what moves under another prior: both go on with one dual field of the denoiser.
    """
    onward = estimate.onward(problem, still=True)
    if onward is None:
        return None
    drifted: dict[int, float] = {}

    def moved() -> float:
        return rms_of(np.maximum(onward.video()[trusted] * problem.scale, 0) - video[trusted])

    made = 0
    for made, _ in enumerate(clock.afterwards(ITERATIONS, twice=2 * EARLY[0]), 1):
        onward.step()
        if made in EARLY:
            drifted[made] = moved()
    return drifted | {made: moved()} if made else {}


def _power(drifted: dict[int, float], faint: float) -> float | None:
    """With which a drift grows from a third or half of the iterations on, -1 to 1; None for too few."""
    last = max(drifted, default=0)
    early = max((each for each in drifted if each <= last / 2), default=None)
    if early is None:
        return None
    off = [np.hypot(drifted[each], max(faint, 1e-30)) for each in (early, last)]
    return float(np.clip(np.log(off[1] / off[0]) / np.log(last / early), -1, 1))


def white_error(segment: Segment, problem: Problem, missed: float, merges: tuple[int, int]) -> float:
    """The RMS of independent errors of all voxels, in scene units, that miss the lines by ``missed``."""
    operator = DualArm(
        segment.geometry, segment.code, *merges, alignment=segment.alignment, blur=segment.blur
    )
    signs = np.random.default_rng(0).integers(0, 2, operator.video_shape, np.int8).astype(np.float32)
    signs *= 2
    signs -= 1
    of_one = float(np.sqrt(np.square(operator.forward(signs)[problem.usable], dtype=np.float64).mean()))
    level = float(np.sqrt(np.square(problem.samples[problem.held_out], dtype=np.float64).mean()))
    return missed * level * problem.norm * problem.scale / max(of_one, 1e-30)
