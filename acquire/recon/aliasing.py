"""Detection of light that is faster than what a video resolves, which then appears steady, or slow.

A curve within the band can mimic most of what a fast lamp does to the lines: the residual of a reconstruction
then looks like noise, even if a lamp of 20 kHz is shown as steady. But a lamp shines only within its own
pattern. So each of the video's few strongest patterns is given a free curve, far beyond the band, to explain
the residual. The energy of each of its cosines, relative to white noise of the same size, has an isolated
peak for a lamp, and many similar values for motion, texture or noise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import percentile_filter

from acquire.recon.bandwidth import COARSE_SIDE
from acquire.recon.basis import TemporalBasis
from acquire.recon.curves import CurveOperator

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon.given import Given

PATTERNS, WEAKEST = 4, 1e-3
"""Largest number of patterns, and the smallest norm of one relative to the strongest."""
STRIPS = 4
"""Number of strips of rows, and of columns: a small lamp is a small part of the whole."""
SHARE = 0.5
"""Share of the sub-steps' cosines that are searched: up to a quarter of the sub-step rate."""
DAMPING = 0.1
"""Damping relative to the mean eigenvalue: cosines that the lines hardly see would absorb all that is
left."""
RIVALS, OFTEN, STANDS_ALONE = 101, 90, 6.5
"""Number of neighbouring cosines, the percentile of theirs that is usual, and the ratio to it above which
light is detected: 35 for a lamp of 20 kHz with a pattern of its own, up to 4.4 where there is none; 3.6 for
one of 3 % of a textured picture's area, which is missed."""
CLEAR_OF_BAND = 1.25
"""Start of the search relative to the end of the band: what is just beyond it belongs to its end."""
SEARCH_S, SEARCHED_SPAN = 2.0, 980
"""Processor time for this number of sub-steps; it grows with their cube."""
LONGEST_SEARCHED = 2048
"""Largest number of sub-steps: up to here it is about a tenth of a reconstruction's time, at 2900 a third."""


def detect_unresolved_light(
    given: Given, predicted: NDArray[Any], video: NDArray[Any], resolved_hz: float
) -> tuple[str, ...]:
    """Return a sentence if light of one frequency beyond ``resolved_hz`` stands out of the residual."""
    found_hz = unresolved_hz(given, predicted, video, resolved_hz)
    if found_hz is None:
        return ()
    return (
        f"light changes at about {found_hz:.5g} Hz, faster than the {resolved_hz:.5g} Hz that this "
        "reconstruction resolves: the video shows it as steady or too slow",
    )


def unresolved_hz(
    given: Given, predicted: NDArray[Any], video: NDArray[Any], resolved_hz: float
) -> float | None:
    """Return the frequency beyond ``resolved_hz`` that stands out of the residual most, if one does.

    ``predicted`` is as `Problem.samples`, ``video`` (frames, n′, n′) in any unit. None is returned also if
    there is no time for the search, or if the segment is long.
    """
    segment, problem, span = given.segment, given.problem, given.segment.geometry.span
    if span > LONGEST_SEARCHED or not given.clock.affords(SEARCH_S * (span / SEARCHED_SPAN) ** 3):
        return None
    rate_hz = 1e9 / segment.substep_ns
    # Cosine k of the sub-steps is light of k·rate/(2·span).
    first = int(np.ceil(CLEAR_OF_BAND * resolved_hz * 2 * span / rate_hz))
    count = int(SHARE * span)
    residual = np.where(problem.usable, problem.samples - predicted, 0)
    patterns = _patterns(video, segment.geometry.size)
    # Without a window of cosines beyond the band there is nothing that light could stand out of.
    if first + RIVALS > count or not patterns or not residual.any():
        return None
    basis = TemporalBasis(span, count)
    # A lamp may be in several patterns, each with a curve of its own: the energies add up.
    energy = sum((_energy(segment, each, residual, basis) for each in patterns), np.zeros(count))
    usual = np.maximum(
        percentile_filter(energy, OFTEN, RIVALS, mode="nearest"), np.percentile(energy[first:], OFTEN)
    )
    highest = first + int(np.argmax((energy / usual)[first:]))
    return highest * rate_hz / (2 * span) if energy[highest] > STANDS_ALONE * usual[highest] else None


def name_gaps(bands_hz: Sequence[tuple[float, float]]) -> tuple[str, ...]:
    """Return a sentence if a video holds light of some bands only, and nothing of what lies between them."""
    if len(bands_hz) < 2:
        return ()
    *others, last = [f"{low:.0f} to {high:.0f}" for low, high in bands_hz]
    return (
        f"the video holds changes of {', '.join(others)} and {last} Hz only, where lamps were found: a "
        "bandwidth (reconstruct(bandwidth=)) admits all slower ones, with more noise",
    )


def _patterns(video: NDArray[Any], size: int) -> list[NDArray[np.float32]]:
    """The strongest patterns of a video, and strips of its mean, each (1, n, n) of unit norm."""
    frames, side, _ = video.shape
    step = -(-side // COARSE_SIDE)
    whole = side // step * step
    coarse = video[:, :whole, :whole].reshape(frames, whole // step, step, whole // step, step).mean((2, 4))
    curves = np.linalg.svd(coarse.reshape(frames, -1).astype(np.float64), full_matrices=False)[0][
        :, :PATTERNS
    ]
    # Coarse voxels are enough to find the curves; the patterns keep the voxels of the video.
    strongest = list(np.tensordot(curves.T.astype(video.dtype), video, axes=1))
    mean, strips = video.mean(0), []
    for rows in np.array_split(np.arange(side), STRIPS):
        strip = np.zeros_like(mean)
        strip[rows] = mean[rows]
        across = np.zeros_like(mean)
        # Frames are square: the indices of rows are those of columns, too.
        across[:, rows] = mean[:, rows]
        strips += [strip, across]
    # `CurveOperator` takes fine pixels; a voxel is held over its block.
    merge = -(-size // side)
    held = [each.repeat(merge, axis=0).repeat(merge, axis=1)[:size, :size] for each in strongest + strips]
    found = [each.astype(np.float32) for each in held]
    norms = [float(np.linalg.norm(each)) for each in found]
    return [each[None] / norm for each, norm in zip(found, norms, strict=True) if norm > WEAKEST * max(norms)]


def _energy(
    segment: Segment, pattern: NDArray[np.float32], residual: NDArray[Any], basis: TemporalBasis
) -> NDArray[np.float64]:
    """Energy of each cosine of a pattern's curve in the ``residual``, relative to that of white noise."""
    operator = CurveOperator(segment, pattern, basis, 1)
    gram = np.asarray(operator.gram(), np.float64)
    right = np.asarray(operator.adjoint(residual.astype(np.float32)), np.float64)[:, 0]
    inverse = np.linalg.inv(gram + DAMPING * np.trace(gram) / len(gram) * np.eye(len(gram)))
    # The variance of the damped fit to white noise is the diagonal of (G + δ)⁻¹·G·(G + δ)⁻¹·σ².
    variance = np.einsum("ij,ji->i", inverse @ gram, inverse) * np.square(residual, dtype=np.float64).mean()
    ratio: NDArray[np.float64] = np.square(inverse @ right) / np.maximum(variance, np.finfo(np.float64).tiny)
    return ratio
