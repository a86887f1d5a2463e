"""Samples that cannot be light of the scene, found before anything is solved.

One sample of 1e7, or one dead column, ruins every solver; masked, it costs a tenth of a decibel. The tests
are tolerant: a sample is an outlier only if no scene explains it.

    not finite    NaN or infinite
    spike         far from the median of its column's neighbouring lines, which share nearly all their light
                  unless it is that of a few rows, and far from what the column has in most lines
    hot column    its median is many times that of nearly all columns, and not that of a small lamp's light
    stuck column  the same value in every line, while columns vary
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import median_filter

from acquire.noise import robust_sigma

if TYPE_CHECKING:
    from numpy.typing import NDArray

SPIKE_LINES = 5
"""Number of lines in the running median: spikes of up to two lines do not change it."""
SPIKE_DEVIATIONS = 20.0
"""Height of a spike in robust standard deviations, which adds to `SPIKE_LEVEL`."""
SPIKE_LEVEL = 0.5
"""Smallest height of a spike, relative to the samples' 99th percentile, so that quiet scenes have none."""
FENCE = 1.5
"""Distance of a spike from the middle half of its column's samples, in their range (Tukey's inner fences)."""
HOT_RATIO = 10.0
"""Ratio of a hot column's median to the usual one, at least."""
DEFECT_SPREAD = 0.5 / 3**0.5
"""Relative standard deviation of a hot column's lines at most, times √M: light under a random code varies by
1/√(S·M) if it fills all rows, as a slit, and more if it fills fewer; defects need not vary at all."""
FEWEST_VARYING = 0.1
"""Share of an arm's columns that must vary for a constant one to be suspicious."""
FEWEST_TOGETHER = 3
"""Number of columns that must be constant at the lowest value for that to count as darkness."""
FEWEST_LINES = 16
"""Fewest lines for which columns are tested."""


def outliers(samples: NDArray[Any], mask: NDArray[np.bool_]) -> dict[str, NDArray[np.bool_]]:
    """Find outliers among the samples (arm, line, pixel) that ``mask`` admits; each has one cause."""
    found = {"not finite": mask & ~np.isfinite(samples)}
    left = mask & ~found["not finite"]
    for cause, test in (("hot column", _hot), ("stuck column", _stuck), ("spike", _spikes)):
        found[cause] = test(np.where(left, samples, 0).astype(np.float64), left) & left
        left = left & ~found[cause]
    return {cause: where for cause, where in found.items() if where.any()}


def _spikes(samples: NDArray[np.float64], left: NDArray[np.bool_]) -> NDArray[np.bool_]:
    if samples.shape[1] < SPIKE_LINES or not left.any():
        return np.zeros_like(left)
    # Only along lines: neighbouring lines share their light, neighbouring columns need not.
    deviation = np.abs(samples - median_filter(samples, size=(1, SPIKE_LINES, 1), mode="nearest"))
    spread = robust_sigma(deviation[left])
    level = np.quantile(np.abs(samples[left]), 0.99)
    far = SPIKE_DEVIATIONS * spread + SPIKE_LEVEL * level
    found = np.asarray(left & (deviation > far))

    # Of a lamp of a few rows, neighbouring lines share hardly any light: they differ by as much as all do.
    for arm, column in np.argwhere(found.any(axis=1)):
        values = samples[arm, :, column]
        low, high = np.quantile(values[left[arm, :, column]], (0.25, 0.75))
        fence = FENCE * (high - low) + far
        found[arm, :, column] &= np.maximum(values - high, low - values) > fence
    return found


def _hot(samples: NDArray[np.float64], left: NDArray[np.bool_]) -> NDArray[np.bool_]:
    if samples.shape[1] < FEWEST_LINES:
        return np.zeros_like(left)
    medians = np.median(np.abs(samples), axis=1, keepdims=True)
    # The usual level is that of nearly all columns, not of the middle one: most of a scene may be dark.
    usual = np.quantile(medians, 0.9, axis=2, keepdims=True)
    bright = (medians > HOT_RATIO * usual) & (usual > 0)
    if not bright.any():
        return np.zeros_like(left)

    # A lamp or a slit on dark ground is in few columns, too. It follows the code, and both arms see all of
    # its light: their totals agree better with it than without it. Medians are taken, which spikes do not
    # change.
    follows = bright & (
        samples.std(axis=1, keepdims=True) > DEFECT_SPREAD / samples.shape[2] ** 0.5 * medians
    )
    total, without = medians.sum(axis=2, keepdims=True), (medians * ~follows).sum(axis=2, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        seen_by_both = np.abs(np.log(total / total[::-1])) < np.abs(np.log(without / total[::-1]))
    return np.asarray(np.broadcast_to(bright & ~(follows & seen_by_both), samples.shape))


def _stuck(samples: NDArray[np.float64], left: NDArray[np.bool_]) -> NDArray[np.bool_]:
    if samples.shape[1] < FEWEST_LINES:
        return np.zeros_like(left)
    low = np.where(left, samples, np.inf).min(axis=1, keepdims=True)
    high = np.where(left, samples, -np.inf).max(axis=1, keepdims=True)
    usual = (high > low).mean(axis=2, keepdims=True) > FEWEST_VARYING
    still = high <= low
    # Unlit columns are at 0 or, if the black level is wrong, several of them share the lowest value.
    lowest = np.where(np.isfinite(low), low, np.inf).min(axis=2, keepdims=True)
    shared = (still & (high == lowest)).sum(axis=2, keepdims=True) >= FEWEST_TOGETHER
    darkness = np.where(shared, lowest, 0.0)
    brightest = np.abs(samples).max(axis=(1, 2), keepdims=True)
    dark = still & (np.abs(high - darkness) <= 1e-3 * brightest)
    # A single dark column between lit ones is stuck: dark parts of a scene are mostly wider.
    lit = np.median(np.abs(samples), axis=1, keepdims=True) > 0.1 * brightest
    # An outermost column has one neighbour: it stands for the other itself.
    padded = np.pad(lit, ((0, 0), (0, 0), (1, 1)), mode="edge")
    lonely = dark & padded[:, :, :-2] & padded[:, :, 2:]
    return np.asarray(np.broadcast_to(still & usual & (~dark | lonely), samples.shape))
