"""Detection of the fastest lamp of a scene, from the covariance of its lines.

Every cosine k of the frames' time axis contributes to the lines y (L_R,) of a pixel a covariance that is
known except for one number, the power of the light at that frequency. With rows of light that are independent
and alike,

    C = σ²·I + Σ_k p_k·F_k·F_kᵀ,     F_k (L_R, rows): what cosine k of each row adds to each line (`band`)

and every pixel of either arm is a sample of it. The p_k of maximum likelihood are approached by the
minorisation of Zhou, Hu, Zhou and Lange (J. Comput. Graph. Stat. 28, 350 (2019)). Then the energy that each
cosine would explain if it were not in C is compared with that for a cosine without light. C⁻¹ removes what is
slow and bright, whose residuals hide a fast lamp, more so the larger the sensor.

Rows of real scenes are alike, not independent, so that rest and slow motion leave a rough floor that falls
with k. A lamp stands out of its neighbouring cosines: one of steady rhythm is a peak of two or three of them.
The scatter of the others shows how high the highest of as many is by chance. Light of all frequencies up to
some limit has no peak and is not found here. The rows are as wide as pixels; coarser ones cannot represent
bright edges, whose residuals look like light of all frequencies.
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

LIKELIHOOD_STEPS, FEWEST_STEPS = 5, 3
"""Number of steps towards the largest likelihood, and of those that are made in a hurry."""
WINDOW, PEAK_WIDTH = 61, 3
"""Number of neighbouring cosines whose median is the floor, and number over which the light of a lamp
spreads."""
FALSE_ALARMS = 1e-3
"""Share of searches that mistake chance for light, if the logarithms about the floor were normal."""
SCATTER_QUANTILE = 0.9
"""Quantile that measures their upward scatter."""
LONGEST_PART = 520
"""Largest number of lines that are analysed together: the time grows with their square."""
SECONDS_EACH = 6e-10
"""Processor time for each cosine, row and pair of lines."""
LARGEST_FACTOR_BYTES, CHUNK_BYTES = 1 << 29, 1 << 26
LEAST_NOISE = 1e-7
"""Smallest noise variance relative to the samples' mean square: below it, rounding of float32 would be
light."""
LEAST_RESPONSE = 1e-6
"""Smallest response to a cosine, relative to the strongest, that the lines resolve; none is if the code is
dark."""
FEWEST_LOOKED_AT = 128
"""Fewest cosines to analyse, up to half of all: too few that include a lamp give no floor."""


def search_seconds(geometry: Geometry, temporal_merge: int, share: float) -> float:
    """Approximate processor time of `last_lamp`."""
    parts = -(-geometry.lines // LONGEST_PART)
    one = replace(geometry, lines=-(-geometry.lines // parts))
    cosines = share * one.video_shape(1, temporal_merge)[0]
    return float(SECONDS_EACH * parts * cosines * one.stages * one.lines**2)


def last_lamp(
    segment: Segment,
    problem: Problem,
    temporal_merge: int,
    share: float,
    hurry: Callable[[], bool] = lambda: False,
) -> int:
    """Number of cosines of the frames' time axis up to the fastest lamp; 0 if none stands out.

    The search covers the first ``share`` of them, with fewer iterations once ``hurry()``. ``problem`` is that
    of the segment, whatever its voxels.
    """
    frames = segment.geometry.video_shape(1, temporal_merge)[0]
    last = 0.0
    for lines in np.array_split(
        np.arange(segment.geometry.lines), -(-segment.geometry.lines // LONGEST_PART)
    ):
        geometry = replace(segment.geometry, lines=len(lines))
        first = int(lines[0]) * geometry.substeps
        code = segment.code[first : first + geometry.span]
        seen = problem.usable[:, lines]
        if seen.any():
            looked_at = geometry.video_shape(1, temporal_merge)[0]
            most = int(share * looked_at)
            factor = _factor(geometry, code, temporal_merge, most)
            energy = _relative_energy(factor, problem.samples[:, lines], seen, hurry)
            # The result is a share of the part's cosines: their spacing depends on its length.
            last = max(last, _end_of_peaks(energy, most) / looked_at)
    return round(last * frames)


def _relative_energy(
    factor: NDArray[np.float32],
    samples: NDArray[Any],
    usable: NDArray[np.bool_],
    hurry: Callable[[], bool],
) -> NDArray[np.float64]:
    """Energy that each cosine would explain in addition to the others (K,), relative to one without light.

    All 0 if the lines do not separate the cosines.
    """
    K, rows, L = factor.shape
    # The pixels of both arms are alike: C sums over rows, so that their order does not matter.
    pixels, seen = np.hstack(list(samples)), np.hstack(list(usable))
    kept = seen.any(0)
    pixels, seen = pixels[:, kept].astype(np.float32), seen[:, kept]
    # The mean square becomes 1, which the first values of light and noise presuppose.
    pixels /= max(np.sqrt(np.square(pixels, dtype=np.float64).sum() / seen.sum()), np.finfo(np.float32).tiny)
    response = np.square(factor).sum((1, 2), dtype=np.float64)
    if not response.min() > LEAST_RESPONSE * response.max():
        return np.zeros(K)
    # At first, all cosines have the same share, and together half of the mean square.
    light, noise = 0.5 * L / (K * response), 1e-3
    chunk = max(1, CHUNK_BYTES // (4 * rows * L))
    chunks = [slice(k, k + chunk) for k in range(0, K, chunk)]
    for made in range(LIKELIHOOD_STEPS):
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
            # This is rounding error: under a code that hardly changes, the lines do not separate cosines.
            return np.zeros(K)
        # The root is that of the minorisation: the likelihood rises in every step, whatever the start.
        light *= np.sqrt(explained / (samples_each * expected))
        left = np.square(white, dtype=np.float64).sum() / samples_each
        noise = max(LEAST_NOISE, noise * float(np.sqrt(left / trace)))
        if made + 1 >= FEWEST_STEPS and hurry():
            break
    inverse = _inverse(factor, chunks, light, noise)
    white = _whitened(inverse, pixels, seen)
    return np.array([_left_out(flat, light[k], inverse, white) for k, flat in enumerate(factor)])


def _factor(
    geometry: Geometry, code: NDArray[np.uint8], temporal_merge: int, most: int
) -> NDArray[np.float32]:
    """F_k of at least ``most`` cosines: (K, rows, L_R). The other arm's has its rows in reverse order."""
    frames = geometry.video_shape(1, temporal_merge)[0]
    count = max(most, min(frames // 2, FEWEST_LOOKED_AT))
    basis, merge = TemporalBasis(frames, count), geometry.substeps
    # Rows are as wide as pixels, or wider where the factor would take too much memory.
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
    """C⁻¹·y of every pixel, with samples of y that are not ``seen`` predicted from the rest; 0 there."""
    white = inverse @ np.where(seen, pixels, 0)
    holes = ~seen
    if not holes.any():
        return white
    # Pixels with the same holes share the inverse of a small matrix.
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
    """For one cosine (rows, L_R): energy that it explains if C is without it, relative to that by chance."""
    own = (flat @ inverse @ flat.T).astype(np.float64)
    # F_kᵀ·(C − p·F_k·F_kᵀ)⁻¹ = (I − p·F_kᵀ·C⁻¹·F_k)⁻¹·F_kᵀ·C⁻¹. The diagonal is slightly more than 1, because
    # a cosine that is all of C would make it singular.
    without = np.linalg.inv((1 + 1e-6) * np.eye(len(own)) - light * own)
    expected = float(np.einsum("ij,ji->", without, own))
    explained = float(np.square(without.astype(np.float32) @ (flat @ white)).sum(dtype=np.float64))
    return explained / (white.shape[1] * expected) if expected > 0 else 0.0


def _end_of_peaks(energy: NDArray[np.float64], most: int) -> int:
    """Number of cosines up to the last of the first ``most`` that stands out of its neighbours."""
    if not energy.min() > 0:
        return 0
    level = np.log(uniform_filter1d(energy, PEAK_WIDTH, mode="nearest"))
    level -= median_filter(level, WINDOW, mode="nearest")
    spread = np.quantile(level, SCATTER_QUANTILE) / ndtri(SCATTER_QUANTILE)
    above = np.flatnonzero(level[:most] > ndtri(1 - FALSE_ALARMS / len(level)) * spread)
    return int(above[-1]) + 1 if len(above) else 0
