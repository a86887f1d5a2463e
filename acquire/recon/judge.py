"""What can be said of a video without the truth: an error per frame, and what a user should be told."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.recon.suspects import black_level_off, unusable

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.geometry import Geometry
    from acquire.lines import Segment
    from acquire.recon.problem import Problem
    from acquire.recon.result import Quality

POOR_MISFIT = 0.15
"""Too few iterations, and lines that are no TDI's, end above it. Below it all may be wrong nevertheless: a
wrong code or orientation ends at 2 to 7 %, since the voxels are many; `diagnosis` tells them apart."""
WORTH_SAYING = 0.01
"""Of the lines, beyond their noise: less is a detail, 40 dB below them, which noise-free lines have, too."""
POOR_COVERAGE = 0.8
DENSITY = (0.1, 0.9)
"""Codes outside leave frames unseen, or all alike."""


def frame_error(
    problem: Problem, predicted: NDArray[Any], geometry: Geometry, temporal_merge: int
) -> NDArray[np.float32]:
    """Relative RMS residual of the samples that saw each frame (⌈T/T_m⌉,); NaN where none did.

    It tells lines that are not explained from those that are, and no more. Lines cannot see all of a frame:
    on simulated scenes the voxels' relative error was 1.5 to 13 times it, and the frames with the largest
    residual were not always the worst.
    """
    usable = (problem.weight > 0) | problem.held_out
    off = np.where(usable, predicted - problem.samples, 0).astype(np.float64)
    per_line = np.stack(
        [np.square(off).sum((0, 2)), np.square(np.where(usable, problem.samples, 0.0)).sum((0, 2))]
    )
    begun = np.concatenate([np.zeros((2, 1)), np.cumsum(per_line, axis=1)], axis=1)
    S, L = geometry.substeps, geometry.lines
    begins = np.arange(0, geometry.span, temporal_merge)
    ends = np.minimum(begins + temporal_merge, geometry.span)
    first = np.clip(-(-(begins - (geometry.size + S - 2)) // S), 0, L)
    last = np.clip((ends - 1) // S + 1, 0, L)
    residual, level = begun[:, last] - begun[:, first]
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.sqrt(np.maximum(residual, 0) / level)
    return np.where(level > 0, ratio, np.nan).astype(np.float32)


def judge(segment: Segment, problem: Problem, quality: Quality, trusted: slice) -> tuple[str, ...]:
    """Sentences for the user: why this video may not be believed."""
    found = [
        each.words for each in (*unusable(segment), *black_level_off(segment)) if each.kind != "constant_code"
    ]
    missed = float(np.nanmax([quality.misfit, quality.prediction]))
    if missed > POOR_MISFIT:
        found.append(
            f"the video misses the lines by {missed:.0%}: too few iterations, or the code's place, "
            "the arms' orientation or the black level is wrong"
        )
    if quality.standing == "over-fitted":
        found.append(
            f"the video follows the noise of its lines: it misses {quality.misfit:.2%} of the samples used, "
            f"where noise alone is {quality.noise:.2%}, and {quality.prediction:.2%} of those kept from the "
            "solver; larger voxels have less of it"
        )
    if quality.standing == "not explained" and WORTH_SAYING < missed <= POOR_MISFIT:
        found.append(
            f"the video misses {missed:.2%} of the lines, and noise is {quality.noise:.2%} of them: what is "
            "left may be light faster than the frames, finer than the pixels, or in need of more time"
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
    if trusted.start >= trusted.stop and segment.geometry.lines < segment.geometry.stages:
        found.append("no frame is sampled in full: the segment has fewer lines than stages")
    return tuple(found)
