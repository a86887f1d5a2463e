"""Light that is faster than what a video resolves: told, since it looks steady there, or slow.

A curve within the band can mimic most of what a fast lamp does to the lines: what a reconstruction leaves
of them then looks like noise, also where a lamp of 20 kHz is shown as steady. But a lamp shines nowhere else
than in its own picture. So each of the video's few strongest patterns is given a free curve, far beyond the
band, to explain what is left: what that takes for one cosine, in units of what white noise of the same size
would give, stands alone where there is a lamp, and is one of many where there is motion, texture or noise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import percentile_filter

from acquire.recon.bandwidth import COARSE_SIDE
from acquire.recon.basis import TemporalBasis
from acquire.recon.curves import CurveOperator

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon.clock import IterationClock
    from acquire.recon.problem import Problem

PATTERNS, WEAKEST = 4, 1e-3
"""At most, and of the strongest's size at least."""
STRIPS = 4
"""Of rows, and of columns: a small lamp is little of the whole."""
SHARE = 0.5
"""Of the sub-steps' cosines, those that are looked at: up to a quarter of their rate."""
DAMPING = 0.1
"""Of the mean eigenvalue: cosines that lines hardly see would take all that the others leave."""
WINDOW, OFTEN, STANDS_ALONE = 101, 90, 6.5
"""Cosines about one, the percentile of theirs that is usual, and how far beyond it light stands: 35 times for
a lamp of 20 kHz of its own pattern, up to 4.4 where there is none; 3.6 for one of 3 % of a textured picture's
area, which is not told."""
MARGIN = 1.25
"""Of the band, where looking begins: what is just beyond it is its end."""
SECONDS, SPAN = 2.0, 980
"""Of a processor for so many sub-steps; it grows with their cube."""
LARGEST_SPAN = 2048
"""Up to here it is about a tenth of a reconstruction's time, at 2900 sub-steps a third."""


def tell_faster_light(
    segment: Segment,
    problem: Problem,
    predicted: NDArray[Any],
    video: NDArray[Any],
    resolved_hz: float,
    clock: IterationClock,
) -> tuple[str, ...]:
    """A sentence where light of one frequency beyond ``resolved_hz`` stands out of what is left of the lines.

    ``predicted`` is as `Problem.samples`, ``video`` (frames, n′, n′) in any unit. Nothing where there is no
    time for it, or where the segment is long.
    """
    span = segment.geometry.span
    if span > LARGEST_SPAN or not clock.affords(SECONDS * (span / SPAN) ** 3):
        return ()
    rate_hz = 1e9 / segment.substep_ns
    first = int(np.ceil(MARGIN * resolved_hz * 2 * span / rate_hz))
    count = int(SHARE * span)
    usable = (problem.weight > 0) | problem.held_out
    left = np.where(usable, problem.samples - predicted, 0)
    patterns = _patterns(video, segment.geometry.size)
    if first + WINDOW > count or not patterns or not left.any():
        return ()
    basis = TemporalBasis(span, count)
    surprise = sum((_surprise(segment, each, left, basis) for each in patterns), np.zeros(count))
    usual = np.maximum(
        percentile_filter(surprise, OFTEN, WINDOW, mode="nearest"), np.percentile(surprise[first:], OFTEN)
    )
    highest = first + int(np.argmax((surprise / usual)[first:]))
    if not surprise[highest] > STANDS_ALONE * usual[highest]:
        return ()
    return (
        f"light changes at about {highest * rate_hz / (2 * span):.5g} Hz, faster than the "
        f"{resolved_hz:.5g} Hz that this reconstruction resolves: it is"
        " shown as steady, or as slower than it is",
    )


def _patterns(video: NDArray[Any], size: int) -> list[NDArray[np.float32]]:
    """The strongest of a video and strips of its mean, each (1, n, n) of unit norm."""
    frames, side, _ = video.shape
    step = -(-side // COARSE_SIDE)
    whole = side // step * step
    few = video[:, :whole, :whole].reshape(frames, whole // step, step, whole // step, step).mean((2, 4))
    curves = np.linalg.svd(few.reshape(frames, -1).astype(np.float64), full_matrices=False)[0][:, :PATTERNS]
    strongest = list(np.tensordot(curves.T.astype(video.dtype), video, axes=1))
    mean, strips = video.mean(0), []
    for rows in np.array_split(np.arange(side), STRIPS):
        strip = np.zeros_like(mean)
        strip[rows] = mean[rows]
        across = np.zeros_like(mean)
        across[:, rows] = mean[:, rows]
        strips += [strip, across]
    merge = -(-size // side)
    held = [each.repeat(merge, axis=0).repeat(merge, axis=1)[:size, :size] for each in strongest + strips]
    found = [each.astype(np.float32) for each in held]
    norms = [float(np.linalg.norm(each)) for each in found]
    return [each[None] / norm for each, norm in zip(found, norms, strict=True) if norm > WEAKEST * max(norms)]


def _surprise(
    segment: Segment, pattern: NDArray[np.float32], left: NDArray[Any], basis: TemporalBasis
) -> NDArray[np.float64]:
    """Squares of what each cosine of a pattern's curve takes of ``left``, over what noise makes of it."""
    operator = CurveOperator(segment, pattern, basis, 1)
    gram = np.asarray(operator.gram(), np.float64)
    right = np.asarray(operator.adjoint(left.astype(np.float32)), np.float64)[:, 0]
    inverse = np.linalg.inv(gram + DAMPING * np.trace(gram) / len(gram) * np.eye(len(gram)))
    variance = np.einsum("ij,ji->i", inverse @ gram, inverse) * np.square(left, dtype=np.float64).mean()
    ratio: NDArray[np.float64] = np.square(inverse @ right) / np.maximum(variance, np.finfo(np.float64).tiny)
    return ratio
