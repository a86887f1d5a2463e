"""The intensity of a scene that rests, from lines and the still picture: one number per sub-step.

With X(r, c, t) = s(t)·x(r, c), a line is linear in s. Line ``i`` of an arm weighs sub-step ``i·S + k`` with
``E·w_k``, where ``w_k`` (pixel) is what a sub-step of light adds to the charge that entered k sub-steps ago.
So the normal equations of s are banded, and each line adds the same matrix shifted by S::

    Σ_i  (E w)(E w)ᵀ · s  =  Σ_i  (E w)·y_i

No prior in time, so nothing limits the bandwidth: pulses of half the sub-steps' rate are followed. Where the
code is dark, s is not seen.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import solveh_banded

from acquire.errors import NumericsError, UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.geometry import Geometry
    from acquire.lines import Segment

RIDGE = 1e-6
"""Relative to the largest weight: sub-steps that no line sees stay near 0 instead of undefined."""


def intensity(segment: Segment, still: NDArray[Any]) -> NDArray[np.float64]:
    """s(t) (T,) of the still picture (n, n) as arm A sees it; NaN where the code is dark.

    Raises UsageError for a picture of another size, NumericsError for one without light.
    """
    geometry = segment.geometry
    if still.shape != (geometry.size, geometry.size):
        raise UsageError(f"still picture {still.shape}", possible=f"({geometry.size}, {geometry.size})")
    samples = segment.samples(np.float64)
    code = segment.code.astype(np.float64)
    reach = geometry.size + geometry.substeps - 1
    band = np.zeros((reach, geometry.span))
    right = np.zeros(geometry.span)
    for view, lines, mask in zip((still, np.rot90(still)), samples, segment.mask, strict=True):
        weight = _weights(np.asarray(view, np.float64), geometry)
        for line in range(geometry.lines):
            first = line * geometry.substeps
            lit = weight * code[first : first + reach, None] * mask[line]
            right[first : first + reach] += lit @ lines[line]
            gram = lit @ lit.T
            for lag in range(reach):
                band[lag, first : first + reach - lag] += np.diagonal(gram, lag)
    if not band[0].max() > 0:
        raise NumericsError("intensity of a still picture without light")
    band[0] += RIDGE * band[0].max()
    solved: NDArray[np.float64] = solveh_banded(band, right, lower=True)
    return np.where(code > 0, solved, np.nan)


def _weights(view: NDArray[np.float64], geometry: Geometry) -> NDArray[np.float64]:
    """w (n + S − 1, M): light of one sub-step on a line's charge, k sub-steps after it entered."""
    S = geometry.substeps
    pixels = view.reshape(geometry.size, geometry.stages, S).sum(axis=2)
    weight = np.zeros((geometry.size + S - 1, geometry.stages))
    for step in range(S):
        weight[step : step + geometry.size] += pixels
    return weight
