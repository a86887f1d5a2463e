"""Judgement of a video without the truth: a residual for each frame, and warnings for the user."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.recon.sanity import black_level_off, unusable

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.geometry import Geometry
    from acquire.lines import Segment
    from acquire.recon.problem import Problem
    from acquire.recon.result import Quality

POOR_MISFIT = 0.15
"""Relative residual above which a video is certainly bad: too few iterations, and lines that are not from
TDI cameras, end above it. A video below it may still be wrong: a wrong code or orientation ends at 2 to 7 %,
because there are many voxels; `diagnosis` tells these apart."""
WORTH_SAYING = 0.01
"""Smallest relative residual to report: less is a detail, 40 dB below the lines, that noise-free lines have,
too."""
TOO_EARLY = {"stopped": "it was interrupted too early", "budget": "its budget was too short"}
"""What ended the iterations → that cause of a misfit in words, where others are possible."""
POOR_COVERAGE = 0.8
"""Share of usable samples below which a video comes with a warning."""
DENSITY = (0.1, 0.9)
"""Range of the share of lit sub-steps; codes outside leave frames unseen, or make them all alike."""


def frame_error(
    problem: Problem, predicted: NDArray[Any], geometry: Geometry, temporal_merge: int
) -> NDArray[np.float32]:
    """Relative RMS residual of the samples that saw each frame (⌈T/T_m⌉,); NaN if none did.

    It separates lines that are explained from those that are not, and no more, because lines do not determine
    all of a frame: on simulated scenes the voxels' relative error was 1.5 to 13 times this residual, and the
    frames with the largest residual were not always the worst.
    """
    usable = problem.usable
    error = np.where(usable, predicted - problem.samples, 0).astype(np.float64)
    per_line = np.stack(
        [np.square(error).sum((0, 2)), np.square(np.where(usable, problem.samples, 0.0)).sum((0, 2))]
    )
    # A frame is seen by n/S lines and more: differences of running sums are taken instead of sums of their
    # own.
    running = np.concatenate([np.zeros((2, 1)), np.cumsum(per_line, axis=1)], axis=1)
    # The lines whose exposure overlaps each frame are first .. last − 1.
    S, L = geometry.substeps, geometry.lines
    begins = np.arange(0, geometry.span, temporal_merge)
    ends = np.minimum(begins + temporal_merge, geometry.span)
    # Line ℓ exposes the sub-steps ℓS .. ℓS + n + S − 2.
    first = np.clip(-(-(begins - (geometry.size + S - 2)) // S), 0, L)
    last = np.clip((ends - 1) // S + 1, 0, L)
    residual, level = running[:, last] - running[:, first]
    with np.errstate(invalid="ignore", divide="ignore"):
        # Differences of running sums can be slightly negative by rounding.
        ratio = np.sqrt(np.maximum(residual, 0) / level)
    return np.where(level > 0, ratio, np.nan).astype(np.float32)


def judge(segment: Segment, problem: Problem, quality: Quality, ended: str) -> tuple[str, ...]:
    """Return the reasons not to trust a video that was ``ended`` thus, as sentences for the user."""
    # A constant code is reported below, by its density.
    found = [
        each.words for each in (*unusable(segment), *black_level_off(segment)) if each.kind != "constant_code"
    ]
    residual = float(np.nanmax([quality.misfit, quality.prediction]))
    if residual > POOR_MISFIT:
        too_early = TOO_EARLY.get(ended, "there were too few iterations")
        found.append(
            f"the video misses the lines by {residual:.0%}: {too_early}, or the code's position, the arms' "
            "orientation or the black level is wrong"
        )
    if quality.standing == "over-fitted":
        found.append(
            f"the video fits the noise of its lines: it misses the used samples by {quality.misfit:.2%}, "
            f"where noise alone is {quality.noise:.2%}, and the held-out samples by "
            f"{quality.prediction:.2%}; larger voxels have less noise"
        )
    # Above `POOR_MISFIT` the first warning says more.
    if quality.standing == "not explained" and WORTH_SAYING < residual <= POOR_MISFIT:
        found.append(
            f"the video misses the lines by {residual:.2%}, and their noise is {quality.noise:.2%}: the rest "
            "may be light that changes faster than the frames or is finer than the pixels, or more time is "
            "needed"
        )
    if quality.coverage < POOR_COVERAGE:
        causes = ", ".join(f"{cause} {count}" for cause, count in problem.masked_by.items() if count)
        found.append(f"only {quality.coverage:.0%} of the samples could be used ({causes})")
    density = float(segment.code.mean())
    if not DENSITY[0] <= density <= DENSITY[1]:
        found.append(
            f"the light is on in {density:.0%} of the sub-steps: 50 % resolves fast changes best, "
            "very few leave frames unseen and very many leave them alike"
        )
    if segment.geometry.lines < segment.geometry.stages:
        found.append("no frame is sampled in full: the segment has fewer lines than stages")
    return tuple(found)
