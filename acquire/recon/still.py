"""The best still: solved in fine pixels, and robust against what passes in front of it.

A voxel of N_m > 1 that holds an edge cannot explain its lines. This model error is some percent, and a still
that is solved in fine pixels and merged has none of it. An object that passes, or a flash, is not normal
noise and leaves a trace in every pixel of a still of all samples; samples with large residuals are therefore
tried with less weight. Both are candidates like any other: the held-out blocks choose.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from acquire.recon.candidates import STILL, rounded
from acquire.recon.workbench import FIRST_ITERATIONS, NEXT_ITERATIONS, SEARCH_SHARE

if TYPE_CHECKING:
    from acquire.recon.candidates import Candidate
    from acquire.recon.workbench import Trial, Workbench

FINER_WEIGHT = 2
"""Power of N_m with which a still's weight grows when its voxels become pixels: its edges become N_m times as
long in pixels, and the lines' response to one pixel N_m³ or N_m⁴ times smaller."""


def best_still(still: Trial, trials: int, *, merge: int) -> Trial:
    """Find the best still: in voxels of ``merge`` fine pixels or in fine pixels, and robust or not.

    The search ends when its share of the budget is spent.
    """
    bench, best = still.bench, still
    if merge > 1 and not bench.clock.spent(SEARCH_SHARE):
        # The weight is less than FINER_WEIGHT says: there is no model error to suppress.
        weight = rounded(still.candidate.weight * merge)
        finer = replace(still.candidate, fine=True, weight=weight)
        fine = bench.with_problem(bench.problem, fine=True).attempt(finer, FIRST_ITERATIONS, still)
        best = fine if fine.error < still.error else best
    best = best.bench.climb(best, trials)
    if bench.clock.spent(SEARCH_SHARE):
        return best
    # This comes after the climb: the residuals of a still that is not yet good are no outliers.
    robust_problem = best.bench.problem.with_robust_weights(best.bench.predict(best))
    robust_bench = best.bench.with_problem(robust_problem)
    robust = robust_bench.attempt(replace(best.candidate, robust=True), NEXT_ITERATIONS, best)
    return robust_bench.climb(robust, trials) if robust.error < best.error else best


def change_bench(bench: Workbench, still: Trial) -> Workbench:
    """A bench on which the change from a still is solved for, with the still's lines subtracted.

    The prior then costs nothing where nothing changes, however detailed the still is.
    """
    known = still.bench.predict(still).astype(bench.problem.samples.dtype)
    return bench.with_problem(replace(bench.problem, known_lines=known), still=still)


def weighted_like(still: Trial, candidate: Candidate) -> Candidate:
    """Scale the weight of a volume to start from as the search scaled that of a fine still.

    Noise shifts both weights alike. The weight of a still in voxels also reflects its model error and is
    ignored.
    """
    if not still.candidate.fine:
        return candidate
    usual = STILL.weight * still.bench.merge**FINER_WEIGHT
    return replace(candidate, weight=rounded(candidate.weight * still.candidate.weight / usual))
