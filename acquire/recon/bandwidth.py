"""Estimate of the scene's bandwidth from the lines alone: from coarse voxels, and from the fastest lamp.

A few iterations on about 24 × 24 voxels with a quarter of the sub-steps' cosines take a second. What the
coarse voxels cannot represent spreads evenly over all coefficients, so that their upper half shows the height
of that floor; the bandwidth ends with the last coefficient that rises above it, plus a margin. A scene whose
light reaches into the upper half shows by peaks there; then the whole quarter is used.

A lamp of a few thousand hertz can drown in that floor, with some codes, and with all on a large sensor, where
a coarse voxel covers many pixels. A lamp of steady rhythm stands out in the covariance of the lines (`lamps`)
on sensors of any size, and the bandwidth reaches at least to the fastest of them. On a small sensor this is
searched only if the coarse voxels show fast light at all: what moves in a slow scene passes for a lamp.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import median_filter

from acquire.arrays import host
from acquire.recon.admm import Admm, AdmmParameters
from acquire.recon.band import segment_operator
from acquire.recon.basis import TemporalBasis, reachable
from acquire.recon.lamps import WINDOW, last_lamp, search_seconds
from acquire.recon.problem import build_problem

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.arrays import Arrays
    from acquire.geometry import Geometry
    from acquire.lines import Segment
    from acquire.recon.problem import Problem

COARSE_SIDE = 24
"""Largest number of coarse voxels along a side."""
HELD_BY = 3
"""Largest number of stages across a coarse voxel for which the floor is low enough without a search for lamps
(M = 72) in a slow scene: there it took a bullet and a runner for lamps."""
TENTATIVE_ITERATIONS, FEWEST_TENTATIVE = 12, 10
"""Number of iterations in coarse voxels, and the least in a hurry."""
PEAK = 25.0
"""Largest ratio of the floor's highest coefficient to its median: 5 to 15 for a floor, more for light."""
MARGIN = 1.25
"""Factor of the last coefficient above the floor: what is just below it belongs to the scene, too."""
FEWEST_COEFFICIENTS = 32
"""Number of cosines of the smallest band."""
STANDS_OUT = 9.0
"""Ratio to the median of the neighbouring cosines (`WINDOW`) above which light is detected; residuals without
light reach 5 to 8."""
LARGEST_SHARE, FASTEST_SHARE = 0.25, 0.5
"""Share of the sub-steps' cosines that a band may have, and in which single lamps are looked for."""


def estimate_coefficients(
    segment: Segment,
    problem: Problem,
    merges: tuple[int, int],
    hurry: Callable[[], bool] = lambda: False,
    affords: Callable[[float], bool] = lambda _: True,
) -> int:
    """Estimate the number of cosines that the scene needs; with fewer iterations once ``hurry()``.

    It is at least 32 (or the number of frames), at most a quarter of the sub-steps (or 32). ``problem`` is
    that of the segment; lamps are searched for on large sensors if ``affords`` accepts the processor time.
    """
    spatial_merge, temporal_merge = merges
    frames = segment.geometry.video_shape(spatial_merge, temporal_merge)[0]
    most = reachable(frames, temporal_merge, LARGEST_SHARE)
    # The answer would be the same whatever the lines show.
    if most <= FEWEST_COEFFICIENTS:
        return min(frames, FEWEST_COEFFICIENTS)
    merge = _coarse(segment.geometry, spatial_merge)
    # The dtype of the video does not matter: only the end of the signal is wanted.
    arrays = replace(problem.arrays, dtype="float32")
    theta = _tentative(segment, (merge, temporal_merge), most, hurry, arrays)
    energy = np.square(theta, dtype=np.float64).sum((1, 2))
    floor = energy[len(energy) // 2 :]
    above = np.flatnonzero(energy > floor.max())
    # It may be no floor, the more so if nothing is above it; in doubt the band is wide.
    doubtful = floor.max() > PEAK * np.median(floor) or not len(above)
    last = len(energy) if doubtful else int(above[-1]) + 1
    slow = MARGIN * last <= FEWEST_COEFFICIENTS
    if is_large(segment.geometry, spatial_merge) or not slow:
        last = max(last, fastest_lamp(segment, problem, temporal_merge, hurry, affords))
    return int(np.clip(MARGIN * last, FEWEST_COEFFICIENTS, most))


def is_large(geometry: Geometry, spatial_merge: int) -> bool:
    """Whether coarse voxels cover so many pixels that their errors may hide a fast lamp."""
    # This criterion needs no truth: it is the size of the coarse voxels relative to those they stand for.
    return _coarse(geometry, spatial_merge) > max(spatial_merge, HELD_BY * geometry.substeps)


def fastest_lamp(
    segment: Segment,
    problem: Problem,
    temporal_merge: int,
    hurry: Callable[[], bool],
    affords: Callable[[float], bool],
) -> int:
    """Number of cosines up to the fastest lamp of the lines' covariance; 0 if there is none, or no time."""
    share = min(1.0, LARGEST_SHARE * temporal_merge)
    if not affords(search_seconds(segment.geometry, temporal_merge, share)):
        return 0
    return last_lamp(segment, problem, temporal_merge, share, hurry)


def light_beyond(
    segment: Segment, problem: Problem, predicted: NDArray[Any], temporal_merge: int, count: int
) -> int | None:
    """The cosine beyond the first ``count`` that stands out in the residual of a prediction.

    The search for the band may overlook a lamp that is small or fast; once everything else is explained, the
    lamp dominates the residual. ``predicted`` is as `Problem.samples`. None if no cosine in the lower half
    stands out.
    """
    merge = -(-segment.geometry.size // COARSE_SIDE)
    frames = segment.geometry.video_shape(merge, temporal_merge)[0]
    # There would be too few cosines beyond the band to have a floor of their own.
    looked_at = reachable(frames, temporal_merge, FASTEST_SHARE)
    if looked_at <= count + WINDOW:
        return None
    basis = TemporalBasis(frames, looked_at)
    operator = segment_operator(segment, basis, merge, temporal_merge)
    residual = np.where(problem.weight > 0, problem.samples - predicted, 0).astype(np.float32)
    energy = np.square(operator.adjoint(residual), dtype=np.float64).sum((1, 2))
    floor = np.maximum(median_filter(energy, WINDOW, mode="nearest"), np.finfo(float).tiny)
    ratio = energy / floor
    ratio[:count] = 0
    highest = int(np.argmax(ratio))
    return highest if ratio[highest] > STANDS_OUT else None


def _coarse(geometry: Geometry, spatial_merge: int) -> int:
    """N_m of the coarse voxels."""
    return max(spatial_merge, -(-geometry.size // COARSE_SIDE))


def _tentative(
    segment: Segment, merges: tuple[int, int], count: int, hurry: Callable[[], bool], arrays: Arrays
) -> NDArray[Any]:
    """Coefficients (``count``, row, column) of a few iterations in coarse voxels."""
    merge, temporal_merge = merges
    frames, side, _ = segment.geometry.video_shape(merge, temporal_merge)
    basis = TemporalBasis(frames, count, arrays)
    # All samples are used: nothing is judged by prediction here.
    problem = build_problem(segment, merge, temporal_merge, hold_out=0.0, arrays=arrays)
    operator = problem.masked(segment_operator(segment, basis, merge, temporal_merge))
    parameters = AdmmParameters(grid_per_coefficient=1)
    solver = Admm(operator, problem.used_samples, (count, side, side), basis, parameters)
    for made in range(TENTATIVE_ITERATIONS):
        if made >= FEWEST_TENTATIVE and hurry():
            break
        solver.step()
    return host(solver.theta)
