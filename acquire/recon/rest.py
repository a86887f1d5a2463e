"""What rests, as well as the lines tell: a still of fine pixels, that what passes before it does not pull at.

A voxel of N_m > 1 that holds an edge cannot explain its lines; that error of the model is some percent, and a
still that is solved in fine pixels and merged has none of it. What passes, or flashes, is no normal noise: a
still of all samples alike takes some of it into every pixel, so that samples which are missed by far are
tried with less weight. Either is a candidate like any other: the held-out blocks choose.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from acquire.recon.workbench import FIRST_ITERATIONS, NEXT_ITERATIONS, SEARCH_SHARE, STILL, rounded

if TYPE_CHECKING:
    from acquire.recon.workbench import Candidate, Trial, Workbench

FINER_WEIGHT = 2
"""A still's weight grows with N_m to this power when its voxels become pixels: its edges become N_m times as
long in pixels, and its lines' response to one N_m to the third or fourth power less."""


def best_still(still: Trial, trials: int, *, merge: int) -> Trial:
    """The best of a still in voxels of ``merge`` fine pixels, in fine pixels, and in either made robust.

    Looked for until the search's share of a budget is spent.
    """
    bench, best = still.bench, still
    if merge > 1 and not bench.clock.spent(SEARCH_SHARE):
        weight = rounded(still.candidate.weight * merge)  # lower: it has no error of its own to hold back
        finer = replace(still.candidate, fine=True, weight=weight)
        fine = bench.on(bench.problem, fine=True).attempt(finer, FIRST_ITERATIONS, still)
        best = fine if fine.error < still.error else best
    best = best.bench.climb(best, trials)
    if bench.clock.spent(SEARCH_SHARE):
        return best
    doubting = best.bench.on(best.bench.problem.doubting(best.bench.predict(best)))
    robust = doubting.attempt(replace(best.candidate, robust=True), NEXT_ITERATIONS, best)
    return doubting.climb(robust, trials) if robust.error < best.error else best


def changing(bench: Workbench, still: Trial) -> Workbench:
    """A bench for what changes beside a still.

    Priors cost nothing where nothing changes, however fine the still, and the lines are free of its detail.
    """
    known = still.bench.predict(still).astype(bench.problem.samples.dtype)
    return bench.on(replace(bench.problem, known=known), still=still)


def told_by(still: Trial, candidate: Candidate) -> Candidate:
    """A volume to begin with, whose weight is larger or smaller as that of a fine still turned out to be.

    Noise makes both alike; a still in voxels has its model's error beside it and tells nothing.
    """
    if not still.candidate.fine:
        return candidate
    usual = STILL.weight * still.bench.merge**FINER_WEIGHT
    return replace(candidate, weight=rounded(candidate.weight * still.candidate.weight / usual))
