"""The brightness of a whole scene over time: g in X(r, c, t) = g(t)·V(r, c, t), from all lines at once.

With V known, a line is linear in g: Y(i, ·) = Σ_t g(t)·E(t)·V's light along the line's staircase (Eq. 1).
There are a few hundred unknowns for all samples, so that least squares is enough; if V contains part of the
brightness already, g stays near 1.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.forward import column_merging
from acquire.recon.basis import TemporalBasis

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon.problem import Problem

RIDGE = 1e-3
"""Ridge relative to the mean eigenvalue: it draws g to 1 where the lines carry no information about it."""
DIMMEST = 0.02
"""Smallest brightness relative to the mean; dimmer instants would not be seen at all."""


def fit_brightness(
    segment: Segment,
    problem: Problem,
    video: NDArray[Any],
    merges: tuple[int, int],
    cosines: int,
) -> NDArray[np.float64]:
    """Fit g (frames,) of mean 1, in this many cosines, so that g·``video`` (frames, n′, n′) explains the
    lines.

    ``video`` is dimensionless, as in the solvers; ``merges`` are N_m and T_m.
    """
    spatial_merge, temporal_merge = merges
    geometry, frames = segment.geometry, len(video)
    n, S = geometry.size, geometry.substeps
    basis = TemporalBasis(frames, cosines).matrix().astype(np.float64)
    frame, row = np.arange(geometry.span) // temporal_merge, np.arange(n) // spatial_merge
    lit = (basis[:, frame] * segment.code).T.astype(np.float32)
    merging = column_merging(geometry, spatial_merge).astype(np.float32)
    normal, right = np.zeros((cosines, cosines)), np.zeros(cosines)
    for arm, view in enumerate((video, video.transpose(0, 2, 1)[:, ::-1])):
        pixels = view.astype(np.float32) @ merging
        for line in np.flatnonzero((problem.weight[arm] > 0).any(axis=1)):
            used = problem.weight[arm, line] > 0
            seen = np.zeros((len(used), cosines), np.float32)
            for u in range(S):
                instants = line * S + u + np.arange(n)
                seen += pixels[frame[instants], row].T @ lit[instants]
            rows = seen[used].astype(np.float64)
            normal += rows.T @ rows
            right += rows.T @ (problem.samples[arm, line][used] * problem.norm)
    if not normal.any():
        return np.ones(frames)  # a dark video explains nothing, however bright
    flat = basis @ np.ones(frames)
    damping = RIDGE * np.trace(normal) / cosines
    change = np.linalg.solve(normal + damping * np.eye(cosines), right - normal @ flat)
    brightness = np.maximum(basis.T @ (flat + change), DIMMEST)
    return np.asarray(brightness / brightness.mean())
