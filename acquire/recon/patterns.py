"""Scenes of a few patterns with a curve each, solved at full spatial resolution.

    X(r, c, t) = Σ_k u_k(t)·Z_k(r, c)             LEDs behind masks, displays, a blade before a target

A first reconstruction in voxels shows how many patterns there are; from then on patterns and curves are
refined in turn, each against all samples:

    Z given u    ADMM in the basis of the curves, with TV and sign       R·n² unknowns
    u given Z    least squares in the cosines, nothing that flattens     R·K unknowns

Two gains: the curves are not biased by a prior (total variation takes a quarter of a 5 kHz amplitude), and
edges lie where they are. A voxel of N_m > 1 that holds an edge cannot explain its lines: that error is some
percent, ten to fifty times the noise, and a solver that fits it spoils the picture (semi-convergence). At
N_m = 1 it is gone; voxels are averaged afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from acquire.forward import block_bounds, merge_video
from acquire.forward.kernels import blocks_to_pixels
from acquire.recon.admm import Admm, AdmmParameters
from acquire.recon.band import band_operator
from acquire.recon.basis import LearnedBasis

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon.basis import TemporalBasis
    from acquire.recon.problem import Operator, Problem

LARGEST_RANK = 12
TAIL = 16
"""Singular values from here on are taken as the floor of what the first reconstruction left over."""
ABOVE_TAIL = 3.0
LARGEST_REST = 0.02
"""Share of the energy that the patterns may leave out; more, and the scene is not one of a few patterns."""
FADING = 0.5
"""λ of a pattern is relative to (largest / its) singular value to this power: weak patterns are smoother."""

PARAMETERS = AdmmParameters(tv_penalty=2e-3, sign_penalty=6e-4, grid_per_coefficient=1)
ROUND = 10
"""ADMM iterations before the curves are fitted again."""
CURVE_STEPS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Patterns:
    """Θ = curves·patterns: (K, R) orthonormal columns, and (R, row, column) that fall off in energy."""

    curves: NDArray[Any]
    patterns: NDArray[Any]

    @classmethod
    def of(cls, curves: NDArray[Any], patterns: NDArray[Any]) -> Patterns:
        """The same product in that form (thin QR of both sides, SVD of what is between)."""
        rank, side, _ = patterns.shape
        left, r_left = np.linalg.qr(curves.astype(np.float64))
        right, r_right = np.linalg.qr(patterns.reshape(rank, -1).T.astype(np.float64))
        u, s, vt = np.linalg.svd(r_left @ r_right.T)
        shaped = ((s[:, None] * vt) @ right.T).reshape(rank, side, side)
        return cls((left @ u).astype(curves.dtype), shaped.astype(patterns.dtype))


def find_patterns(theta: NDArray[Any]) -> Patterns | None:
    """The patterns of coefficient frames (K, n′, n′); None where a few do not hold the scene."""
    count, side, _ = theta.shape
    if count <= TAIL:
        return None
    flat = theta.reshape(count, -1).astype(np.float64)
    energy, vectors = np.linalg.eigh(flat @ flat.T)
    energy, vectors = np.maximum(energy[::-1], 0), vectors[:, ::-1]
    rank = int(np.count_nonzero(energy[:TAIL] > ABOVE_TAIL**2 * energy[TAIL - 1]))
    if not 0 < rank <= LARGEST_RANK or energy[rank:].sum() > LARGEST_REST * energy.sum():
        return None
    curves = vectors[:, :rank].astype(theta.dtype)
    return Patterns(curves, (curves.T @ theta.reshape(count, -1)).reshape(rank, side, side))


class Refinement:
    """Refines patterns and curves in turn; `step` is an ADMM iteration, a round ends with the curves' fit."""

    def __init__(
        self,
        segment: Segment,
        problem: Problem,
        cosines: TemporalBasis,
        found: Patterns,
        merges: tuple[int, int],
        parameters: AdmmParameters = PARAMETERS,
    ) -> None:
        self._segment, self._problem, self._cosines = segment, problem, cosines
        self._spatial_merge, self._temporal_merge = merges
        self.parameters, self._steps = parameters, 0
        self._now = Patterns(found.curves, _hold(found.patterns, segment.geometry.size, merges[0]))
        self._begin_round()

    @property
    def rank(self) -> int:
        return len(self._now.patterns)

    @property
    def at_round_end(self) -> bool:
        return self._steps % ROUND == 0

    def step(self) -> None:
        """One iteration. Raises NumericsError for iterates that are not finite."""
        self._admm.step()
        self._now = Patterns(self._now.curves, self._admm.theta)
        self._steps += 1
        if self.at_round_end:
            self._fit_curves()
            self._begin_round()

    def predict(self) -> NDArray[Any]:
        """The lines of the estimate, as `Problem.samples`."""
        return self._operator.forward(self._now.patterns) / np.float32(self._problem.norm)

    def video(self) -> NDArray[Any]:
        """Dimensionless voxels (T/T_m, n/N_m, n/N_m)."""
        merged = merge_video(self._now.patterns, self._spatial_merge, 1)
        return LearnedBasis(self._cosines, self._now.curves).synthesize(merged)

    def _begin_round(self) -> None:
        basis = LearnedBasis(self._cosines, self._now.curves)
        geometry, code = self._segment.geometry, self._segment.code
        self._operator: Operator = band_operator(geometry, code, basis, 1, self._temporal_merge)
        size = np.sqrt(np.square(self._now.patterns, dtype=np.float64).sum((1, 2)))
        emphasis = (size.max() / np.maximum(size, 1e-6 * size.max() + 1e-30)) ** FADING
        self._admm = Admm(
            self._problem.masked(self._operator),
            self._problem.used_samples,
            (self.rank, geometry.size, geometry.size),
            basis,
            self.parameters,
            start=self._now.patterns,
            emphasis=emphasis,
        )

    def _fit_curves(self) -> None:
        now = Patterns.of(self._now.curves, self._now.patterns)
        # orthonormal patterns make the fit well conditioned; their sizes go to the curves
        size = np.maximum(np.linalg.norm(now.patterns, axis=(1, 2)), 1e-30)
        unit = now.patterns / size[:, None, None]
        curves = fit_curves(
            self._segment, self._problem, unit, self._cosines, self._temporal_merge, now.curves * size
        )
        self._now = Patterns.of(curves, unit)


def fit_curves(
    segment: Segment,
    problem: Problem,
    patterns: NDArray[Any],
    cosines: TemporalBasis,
    temporal_merge: int,
    start: NDArray[Any],
    steps: int = CURVE_STEPS,
) -> NDArray[Any]:
    """Curves (K, R) that explain the samples best with ``patterns`` (R, n, n), by conjugate gradients."""
    operator = problem.masked(CurveOperator(segment, patterns, cosines, temporal_merge))
    curves: NDArray[Any] = start.astype(np.float32)
    residual = problem.used_samples - operator.forward(curves)
    gradient = operator.adjoint(residual)
    direction, energy = gradient, float(np.vdot(gradient, gradient))
    for _ in range(steps):
        image = operator.forward(direction)
        power = float(np.vdot(image, image))
        if not power:
            break
        curves = curves + (energy / power) * direction
        residual = residual - (energy / power) * image
        gradient = operator.adjoint(residual)
        energy, before = float(np.vdot(gradient, gradient)), energy
        direction = gradient + (energy / before) * direction
    return curves


class CurveOperator:
    """Lines of patterns whose curves are the unknown: (K, R) → (2, L_R, M), and the transpose.

    Line i is Σ_{k,s} E(iS + s)·u_k(iS + s)·P_k(s), with P_k the pattern's rows summed over S steps: one
    matrix product, of windows of the lit curves with P.
    """

    def __init__(
        self, segment: Segment, patterns: NDArray[Any], cosines: TemporalBasis, temporal_merge: int
    ) -> None:
        self._geometry, self._code, self._cosines = segment.geometry, segment.code, cosines
        self._frame = np.arange(segment.geometry.span) // temporal_merge
        self._begins = block_bounds(segment.geometry.span, temporal_merge)[0]
        views = (patterns, np.rot90(patterns, 1, axes=(1, 2)))
        self._profiles = [_profiles(np.ascontiguousarray(view), segment) for view in views]
        self._matrix = cosines.matrix()

    def forward(self, curves: NDArray[Any]) -> NDArray[Any]:
        """Lines of the curves (K, R)."""
        lit = (self._matrix.T @ curves)[self._frame] * self._code[:, None].astype(curves.dtype)
        width = self._geometry.size + self._geometry.substeps - 1
        windows = sliding_window_view(lit, width, axis=0)[:: self._geometry.substeps]
        flat = windows[: self._geometry.lines].reshape(self._geometry.lines, -1)
        return np.stack([flat @ profile for profile in self._profiles])

    def adjoint(self, lines: NDArray[Any]) -> NDArray[Any]:
        """(2, L_R, M) → (K, R)."""
        width = self._geometry.size + self._geometry.substeps - 1
        back = lines[0] @ self._profiles[0].T + lines[1] @ self._profiles[1].T
        windows = back.reshape(self._geometry.lines, -1, width).transpose(0, 2, 1)
        light = np.zeros((self._geometry.span, windows.shape[2]), lines.dtype)
        for i, window in enumerate(windows):
            light[i * self._geometry.substeps :][:width] += window
        light *= self._code[:, None].astype(lines.dtype)
        curves: NDArray[Any] = self._matrix @ np.add.reduceat(light, self._begins, axis=0)
        return curves


def _profiles(view: NDArray[Any], segment: Segment) -> NDArray[Any]:
    """P_k(s) = Σ_u Z_k(s − u), columns merged to pixels: (R·(n + S − 1), M)."""
    rank, n, _ = view.shape
    S = segment.geometry.substeps
    pixels = blocks_to_pixels(view.reshape(rank * n, n), n, S, 1).reshape(rank, n, -1)
    summed = np.zeros((rank, n + S - 1, pixels.shape[2]), view.dtype)
    for u in range(S):
        summed[:, u : u + n] += pixels
    return summed.reshape(-1, pixels.shape[2])


def _hold(patterns: NDArray[Any], n: int, merge: int) -> NDArray[Any]:
    """Coarse frames at full resolution, every voxel held over its block."""
    return patterns.repeat(merge, axis=1).repeat(merge, axis=2)[:, :n, :n]
