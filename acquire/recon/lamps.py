"""The fastest lamp of a scene, from the covariance of its lines.

Every cosine k of the frames' time axis adds to the lines y (L_R,) of a pixel a covariance that is known but
for one number, how much of the light changes with it: with rows of light taken as independent and alike,

    C = σ²·I + Σ_k p_k·F_k·F_kᵀ,     F_k (L_R, rows): what cosine k of each row adds to each line (`band`)

and every pixel of either arm is a sample of it. The p_k that make them likely are climbed to by the
minorisation of Zhou, Hu, Zhou and Lange (J. Comput. Graph. Stat. 28, 350 (2019)). Then each cosine is asked
what it would explain of the lines if it were not in C, over what that would be if it held no light. C⁻¹
takes away what is slow and bright, under whose remains a fast lamp hides, more so the larger the sensor.

Rows are alike in truth, so that what rests and what is slow leave a floor that falls with k and is rough. A
lamp is what stands out of the cosines about it: one of steady rhythm is a peak of two or three of them. How
far the others scatter tells how high the highest of so many comes by chance. Light of all frequencies up to
some has no peak, and is not found here. The rows are those of pixels; coarser ones cannot hold bright edges,
and what they leave of these looks like light of all frequencies.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.special import ndtri

from acquire.forward import block_bounds
from acquire.recon.band import lit_cosines, staircase
from acquire.recon.basis import TemporalBasis

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.geometry import Geometry
    from acquire.lines import Segment
    from acquire.recon.problem import Problem

ITERATIONS, FEWEST_ITERATIONS = 5, 3
WINDOW, PEAK_WIDTH = 61, 3
"""Cosines about one whose median is its floor, and over how many the light of a lamp spreads."""
FALSE_ALARMS = 1e-3
"""Of so many searches, one that takes chance for light, were the logarithms about the floor normal."""
USUAL = 0.9
"""The quantile that says how far they scatter upwards."""
LONGEST = 520
"""Lines that are looked at together, at most: the time grows with their square."""
SECONDS = 6e-10
"""Of a processor for each cosine, row and pair of lines."""
LARGEST_FACTOR_BYTES, CHUNK_BYTES = 1 << 29, 1 << 26
LEAST_NOISE = 1e-7
"""Variance, of the samples' mean square: rounding of float32 would be light below it."""
LEAST_RESPONSE = 1e-6
"""Of a cosine beside the strongest, below which the lines do not see it; none where the code is dark."""
FEWEST_LOOKED_AT = 128
"""Cosines, of up to half of all: a floor of few that holds a lamp besides is none."""


def search_seconds(geometry: Geometry, temporal_merge: int, share: float) -> float:
    """About what `last_lamp` takes of a processor."""
    stretches = -(-geometry.lines // LONGEST)
    one = replace(geometry, lines=-(-geometry.lines // stretches))
    cosines = share * one.video_shape(1, temporal_merge)[0]
    return float(SECONDS * stretches * cosines * one.stages * one.lines**2)


def last_lamp(
    segment: Segment,
    problem: Problem,
    temporal_merge: int,
    share: float,
    hurry: Callable[[], bool] = lambda: False,
) -> int:
    """How many of the first cosines of the frames' time axis reach the fastest lamp; 0 where none stands out.

    Looked for in the first ``share`` of them; sooner done where ``hurry()``. ``problem`` is that of the
    segment, whatever its voxels.
    """
    frames = segment.geometry.video_shape(1, temporal_merge)[0]
    last = 0.0
    for lines in np.array_split(np.arange(segment.geometry.lines), -(-segment.geometry.lines // LONGEST)):
        geometry = replace(segment.geometry, lines=len(lines))
        first = int(lines[0]) * geometry.substeps
        code = segment.code[first : first + geometry.span]
        seen = problem.usable[:, lines]
        if seen.any():
            looked_at = geometry.video_shape(1, temporal_merge)[0]
            most = int(share * looked_at)
            factor = _factor(geometry, code, temporal_merge, most)
            surprise = _surprise(factor, problem.samples[:, lines], seen, hurry)
            last = max(last, _end_of_peaks(surprise, most) / looked_at)
    return round(last * frames)


def _surprise(
    factor: NDArray[np.float32],
    samples: NDArray[Any],
    usable: NDArray[np.bool_],
    hurry: Callable[[], bool],
) -> NDArray[np.float64]:
    """What each cosine would explain beside the others (K,), over what it would if it held no light.

    0 where the lines say nothing of one beside the others.
    """
    K, rows, L = factor.shape
    pixels, seen = np.hstack(list(samples)), np.hstack(list(usable))
    kept = seen.any(0)
    pixels, seen = pixels[:, kept].astype(np.float32), seen[:, kept]
    pixels /= max(np.sqrt(np.square(pixels, dtype=np.float64).sum() / seen.sum()), np.finfo(np.float32).tiny)
    response = np.square(factor).sum((1, 2), dtype=np.float64)
    if not response.min() > LEAST_RESPONSE * response.max():
        return np.zeros(K)
    light, noise = 0.5 * L / (K * response), 1e-3
    chunk = max(1, CHUNK_BYTES // (4 * rows * L))
    chunks = [slice(k, k + chunk) for k in range(0, K, chunk)]
    for made in range(ITERATIONS):
        inverse = _inverse(factor, chunks, light, noise)
        white = _whitened(inverse, pixels, seen)
        explained, expected = np.empty(K), np.empty(K)
        for part in chunks:
            flat = factor[part].reshape(-1, L)
            found = np.square(flat @ white).reshape(-1, rows * white.shape[1])
            explained[part] = found.sum(1, dtype=np.float64)
            expected[part] = ((flat @ inverse) * flat).reshape(-1, rows * L).sum(1, dtype=np.float64)
        trace = float(np.trace(inverse, dtype=np.float64))
        samples_each = seen.mean() * seen.shape[1]
        largest = float(np.finfo(np.float32).max) * min(trace, float(expected.min())) * samples_each
        if not (light * explained).max() < largest:
            return np.zeros(K)  # rounding: under a code that hardly changes the lines tell no cosines apart
        light *= np.sqrt(explained / (samples_each * expected))
        left = np.square(white, dtype=np.float64).sum() / samples_each
        noise = max(LEAST_NOISE, noise * float(np.sqrt(left / trace)))
        if made + 1 >= FEWEST_ITERATIONS and hurry():
            break
    inverse = _inverse(factor, chunks, light, noise)
    white = _whitened(inverse, pixels, seen)
    surprise = [_left_out(flat, light[k], inverse, white) for k, flat in enumerate(factor)]
    return np.array(surprise)


def _factor(
    geometry: Geometry, code: NDArray[np.uint8], temporal_merge: int, most: int
) -> NDArray[np.float32]:
    """F_k of at least ``most`` cosines: (K, rows, L_R). The other arm's has its rows in the other order."""
    frames = geometry.video_shape(1, temporal_merge)[0]
    count = max(most, min(frames // 2, FEWEST_LOOKED_AT))
    basis, merge = TemporalBasis(frames, count), geometry.substeps
    while 4 * basis.count * geometry.lines * geometry.size > LARGEST_FACTOR_BYTES * merge:
        merge += geometry.substeps
    starts, lengths = block_bounds(geometry.size, merge)
    factor = staircase(lit_cosines(code, basis, temporal_merge), starts, lengths, geometry)
    return np.ascontiguousarray(factor.transpose(2, 1, 0))


def _inverse(
    factor: NDArray[np.float32], chunks: list[slice], light: NDArray[np.float64], noise: float
) -> NDArray[np.float32]:
    """C⁻¹ (L_R, L_R)."""
    L = factor.shape[2]
    covariance = noise * np.eye(L)
    for part in chunks:
        scaled = (factor[part] * np.sqrt(light[part]).astype(np.float32)[:, None, None]).reshape(-1, L)
        covariance += scaled.T @ scaled
    inverse: NDArray[np.float32] = np.linalg.inv(covariance).astype(np.float32)
    return inverse


def _whitened(
    inverse: NDArray[np.float32], pixels: NDArray[np.float32], seen: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """C⁻¹·y of every pixel, for what is not ``seen`` of y what the rest foretells; 0 there."""
    white = inverse @ np.where(seen, pixels, 0)
    holes = ~seen
    if not holes.any():
        return white
    patterns, of = np.unique(holes, axis=1, return_inverse=True)
    for number, hole in enumerate(patterns.T):
        if hole.any():
            alike = np.flatnonzero(of.ravel() == number)
            inner = inverse[np.ix_(hole, hole)].astype(np.float64)
            missing = np.linalg.solve(inner, white[np.ix_(hole, alike)]).astype(np.float32)
            white[:, alike] -= inverse[:, hole] @ missing
            white[np.ix_(hole, alike)] = 0
    return white


def _left_out(
    flat: NDArray[np.float32], light: float, inverse: NDArray[np.float32], white: NDArray[np.float32]
) -> float:
    """For one cosine (rows, L_R): what it explains where C is without it, over what it would by chance."""
    own = (flat @ inverse @ flat.T).astype(np.float64)
    # F_kᵀ·(C − p·F_k·F_kᵀ)⁻¹ = (I − p·F_kᵀ·C⁻¹·F_k)⁻¹·F_kᵀ·C⁻¹
    without = np.linalg.inv((1 + 1e-6) * np.eye(len(own)) - light * own)
    expected = float(np.einsum("ij,ji->", without, own))
    explained = float(np.square(without.astype(np.float32) @ (flat @ white)).sum(dtype=np.float64))
    return explained / (white.shape[1] * expected) if expected > 0 else 0.0


def _end_of_peaks(surprise: NDArray[np.float64], most: int) -> int:
    """The cosine after the last of the first ``most`` that stands out of those about it."""
    if not surprise.min() > 0:
        return 0
    level = np.log(uniform_filter1d(surprise, PEAK_WIDTH, mode="nearest"))
    level -= median_filter(level, WINDOW, mode="nearest")
    spread = np.quantile(level, USUAL) / ndtri(USUAL)
    above = np.flatnonzero(level[:most] > ndtri(1 - FALSE_ALARMS / len(level)) * spread)
    return int(above[-1]) + 1 if len(above) else 0
