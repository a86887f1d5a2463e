"""The brightness of a whole scene over time: g in X(r, c, t) = g(t)·V(r, c, t), from all lines at once.

With V known, a line is linear in g: Y(i, ·) = Σ_t g(t)·E(t)·V's light along the line's staircase (Eq. 1).
There are a few hundred unknowns for all samples. The lines carry no information about sub-steps without
light: with more cosines than g needs, least squares would let it run wild between two flashes. Each cosine of
g − 1 therefore has an energy γ that it shares with its neighbours; γ and the noise σ² are those for which the
lines are most likely (`evidence`). All of g is fitted, and not its change since the last fit, to whose errors
V has adapted, so that nothing would seem to need a change.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import uniform_filter1d

from acquire.forward import column_merging
from acquire.recon.basis import TemporalBasis
from acquire.recon.evidence import FAINTEST, NormalEquations, determined_share
from acquire.recon.views import seen_by_arms

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon.problem import Problem

START_RIDGE = 1e-3
"""Ridge of the start relative to the mean eigenvalue: it draws g to 1 where no line has information on it."""
MOST_STEPS = 12
"""Upper limit on the fixed-point steps of the prior."""
NEIGHBOURS = 9
"""Number of neighbouring cosines that share their energy: the light of one lamp is rarely in a single one."""
INDEPENDENT = 0.1
"""Share of the samples that count: most of their misfit is the video's own error, which neighbouring samples
have in common."""
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
    frame = np.arange(geometry.span) // temporal_merge
    lit = (basis[:, frame] * segment.code).T.astype(np.float32)
    merging = column_merging(geometry, spatial_merge).astype(np.float32)
    normal, right, energy, samples = np.zeros((cosines, cosines)), np.zeros(cosines), 0.0, 0
    # Arm B's rows are the scene's columns from right to left.
    blocks = (np.arange(n) // spatial_merge, np.arange(n)[::-1] // spatial_merge)
    for arm, (view, row) in enumerate(zip(_views(segment, video, spatial_merge), blocks, strict=True)):
        pixels = view @ merging
        for line in np.flatnonzero((problem.weight[arm] > 0).any(axis=1)):
            used = problem.weight[arm, line] > 0
            seen = np.zeros((len(used), cosines), np.float32)
            for u in range(S):
                # Step u of a line exposes row r in sub-step line·S + u + r.
                instants = line * S + u + np.arange(n)
                seen += pixels[frame[instants], row].T @ lit[instants]
            # The sums over all lines are in float64, since the normal matrix is inverted.
            rows = seen[used].astype(np.float64)
            normal += rows.T @ rows
            # Pixels are Λ′ itself applied to the video, without the norm that samples are divided by.
            lines = problem.samples[arm, line][used].astype(np.float64) * problem.norm
            right += rows.T @ lines
            energy, samples = energy + float(lines @ lines), samples + len(lines)
    if not normal.any():
        return np.ones(frames)  # a dark video explains nothing, however bright
    normal, right, energy = normal * INDEPENDENT, right * INDEPENDENT, energy * INDEPENDENT
    counted = max(1, round(samples * INDEPENDENT))
    # The prior draws to g = 1, so that g − 1 is solved for.
    flat = basis @ np.ones(frames)
    left = NormalEquations(normal, right, energy, counted).left(flat)
    change = _most_likely(NormalEquations(normal, right - normal @ flat, left, counted))
    brightness = np.maximum(basis.T @ (flat + change), DIMMEST)
    return np.asarray(brightness / brightness.mean())


def _views(segment: Segment, video: NDArray[Any], spatial_merge: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the video as each arm's sensor has it (time, block along the charge, block across)."""
    # A picture that does not change is one frame, repeated without being copied.
    frames = video[:1] if video.strides[0] == 0 else video
    views = seen_by_arms(segment, np.ascontiguousarray(frames, np.float32), spatial_merge)
    a, b = (np.broadcast_to(view, video.shape) for view in views)
    return a, b.transpose(0, 2, 1)


def _most_likely(equations: NormalEquations) -> NDArray[np.float64]:
    """Solve for x (K,) with the prior for which the lines are most likely (`evidence`)."""
    normal, right = equations.normal, equations.right
    diagonal = np.diag_indices_from(normal)
    damped, mean_eigenvalue = normal.copy(), np.trace(normal) / len(normal)
    damped[diagonal] += START_RIDGE * mean_eigenvalue
    x: NDArray[np.float64] = np.asarray(np.linalg.solve(damped, right), np.float64)
    share, noise = np.full(len(x), np.square(x).mean()), equations.energy / equations.samples
    for _ in range(MOST_STEPS):
        if share.max() < FAINTEST**2 or not noise > 0:
            break  # g is 1, or explains the lines exactly
        precision = noise / np.maximum(share, FAINTEST * share.max())
        precision = np.maximum(precision, FAINTEST * mean_eigenvalue)
        damped = normal.copy()
        damped[diagonal] += precision
        inverse = np.linalg.inv(damped)
        x = np.asarray(inverse @ right, np.float64)
        determined = determined_share(precision, inverse)
        share = uniform_filter1d(np.square(x) / determined, NEIGHBOURS, mode="nearest")
        noise = equations.noise(x, determined)
    return x
