"""The light of known patterns: what each shone at every instant, from all lines by least squares.

    y = Σ_k Λ·(u_k ⊗ Z_k),     u_k = Dᵀ·(column k of the unknown),     no prior on the amplitudes

Line i is Σ_{k,s} E(iS + s)·u_k(iS + s)·P_k(s), with P_k the pattern's rows summed over S steps. The system is
small, R·K unknowns for all samples, but fast light hides in the sum over n steps: plain conjugate gradients
need hundreds of steps. With all samples in use the normal matrix is known in closed form, for sub-steps t, t'

    G[t, k; t', k'] = E(t)·E(t')·Σ_i Q_{kk'}(t − iS, t' − iS),     Q_{kk'} = P_k·P_{k'}ᵀ of both arms

and its Cholesky factor is the preconditioner that makes a few steps enough where some samples are masked.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import cho_factor, cho_solve

from acquire.forward import block_bounds
from acquire.forward.kernels import blocks_to_pixels

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon.basis import TemporalBasis
    from acquire.recon.problem import Problem

RIDGE = 1e-5
"""Of the mean eigenvalue: what no line sees stays as it was."""
STEPS = 6
PLAIN_STEPS = 60
LARGEST_SPAN = 8192
"""Sub-steps; beyond, the normal matrix takes too much memory and plain steps are made."""
LARGEST_UNKNOWNS = 4096


def fit_curves(
    segment: Segment,
    problem: Problem,
    patterns: NDArray[Any],
    cosines: TemporalBasis,
    temporal_merge: int,
    start: NDArray[Any],
    ridge: float = RIDGE,
) -> NDArray[np.float64]:
    """Curves (K, R) that explain the samples best with ``patterns`` (R, n, n), near ``start``.

    Patterns of like size make it well conditioned. Light to which the lines respond less than ``ridge``,
    relative to the mean eigenvalue, hardly moves: to be set as high as the patterns are wrong.
    """
    problem = problem.on_host()
    dtype = problem.arrays.dtype
    whole = CurveOperator(segment, patterns, cosines, temporal_merge)
    operator = problem.masked(whole)
    residual = problem.used_samples - operator.forward(start.astype(dtype))
    small = segment.geometry.span <= LARGEST_SPAN and start.size <= LARGEST_UNKNOWNS
    precondition: Callable[[NDArray[Any]], NDArray[Any]]
    if small:
        precondition, damping = _preconditioner(whole.gram() / problem.norm**2, start.shape, ridge)
    else:
        precondition, damping = np.copy, 0.0

    def normal(x: NDArray[Any]) -> NDArray[np.float64]:
        back: NDArray[Any] = operator.adjoint(operator.forward(x.astype(dtype)))
        return back.astype(np.float64) + damping * x

    right = operator.adjoint(residual).astype(np.float64)
    return start + _conjugate_gradients(normal, right, precondition, STEPS if small else PLAIN_STEPS)


class CurveOperator:
    """Lines of patterns whose curves are the unknown: (K, R) → (2, L_R, M), and the transpose."""

    def __init__(
        self, segment: Segment, patterns: NDArray[Any], cosines: TemporalBasis, temporal_merge: int
    ) -> None:
        self._geometry, self._code = segment.geometry, segment.code.astype(patterns.dtype)
        self._frame = np.arange(segment.geometry.span) // temporal_merge
        self._begins = block_bounds(segment.geometry.span, temporal_merge)[0]
        self._width = segment.geometry.size + segment.geometry.substeps - 1
        self._rank = len(patterns)
        views = (patterns, np.rot90(patterns, 1, axes=(1, 2)))
        self._profiles = [_profiles(np.ascontiguousarray(view), segment) for view in views]
        self._matrix = cosines.matrix()

    def forward(self, curves: NDArray[Any]) -> NDArray[Any]:
        """Lines of the curves (K, R)."""
        lit = (self._matrix.T @ curves)[self._frame] * self._code[:, None]
        windows = sliding_window_view(lit, self._width, axis=0)[:: self._geometry.substeps]
        flat = windows[: self._geometry.lines].reshape(self._geometry.lines, -1)
        return np.stack([flat @ profile for profile in self._profiles])

    def adjoint(self, lines: NDArray[Any]) -> NDArray[Any]:
        """(2, L_R, M) → (K, R)."""
        back = lines[0] @ self._profiles[0].T + lines[1] @ self._profiles[1].T
        windows = back.reshape(self._geometry.lines, -1, self._width).transpose(0, 2, 1)
        light = np.zeros((self._geometry.span, self._rank), lines.dtype)
        for first, window in zip(self._firsts, windows, strict=True):
            light[first : first + self._width] += window
        return self._to_cosines(light * self._code[:, None])

    def gram(self) -> NDArray[np.float64]:
        """The normal matrix of all samples, unknowns in the order of (R, K)."""
        K, R = len(self._matrix), self._rank
        gram = np.empty((R, K, R, K))
        # float64: congruence keeps it positive definite only as far as rounding does
        shaped = [profile.astype(np.float64).reshape(R, self._width, -1) for profile in self._profiles]
        for k in range(R):
            for other in range(k + 1):
                Q = sum(profile[k] @ profile[other].T for profile in shaped)
                gram[k, :, other] = self._pair(np.asarray(Q))
                gram[other, :, k] = gram[k, :, other].T
        return gram.reshape(R * K, R * K)

    def _pair(self, Q: NDArray[Any]) -> NDArray[Any]:
        """D·(E·Eᵀ ∘ Σ_i Q shifted by iS)·Dᵀ for one pair of patterns."""
        total = np.zeros((self._geometry.span, self._geometry.span), Q.dtype)
        for first in self._firsts:
            total[first : first + self._width, first : first + self._width] += Q
        total *= self._code[:, None]
        total *= self._code
        return self._to_cosines(np.ascontiguousarray(self._to_cosines(total).T)).T

    @property
    def _firsts(self) -> range:
        return range(0, self._geometry.lines * self._geometry.substeps, self._geometry.substeps)

    def _to_cosines(self, light: NDArray[Any]) -> NDArray[Any]:
        """(T, …) → (K, …): sub-steps summed to frames, frames analysed."""
        merged = light if len(self._begins) == len(light) else np.add.reduceat(light, self._begins, axis=0)
        analysed: NDArray[Any] = self._matrix @ merged
        return analysed


def _preconditioner(
    gram: NDArray[np.float64], shape: tuple[int, ...], ridge: float
) -> tuple[Callable[[NDArray[Any]], NDArray[Any]], float]:
    """Solver of (G + damping)·x = b for x, b of ``shape`` (K, R), and the damping."""
    damping = max(ridge * float(np.trace(gram)) / len(gram), float(np.finfo(np.float32).tiny))
    gram[np.diag_indices_from(gram)] += damping
    factor = cho_factor(gram, lower=True, overwrite_a=True)

    def solve(right: NDArray[Any]) -> NDArray[Any]:
        solved: NDArray[Any] = cho_solve(factor, right.T.ravel()).reshape(shape[::-1]).T
        return solved

    return solve, damping


def _conjugate_gradients(
    normal: Callable[[NDArray[Any]], NDArray[Any]],
    right: NDArray[Any],
    precondition: Callable[[NDArray[Any]], NDArray[Any]],
    steps: int,
) -> NDArray[np.float64]:
    x, residual = np.zeros(right.shape), right.copy()
    scaled = precondition(residual)
    direction, energy = scaled.copy(), float(np.vdot(residual, scaled))
    for _ in range(steps):
        image = normal(direction)
        curvature = float(np.vdot(direction, image))
        if not energy > 0 or not curvature > 0:
            break
        x += (energy / curvature) * direction
        residual -= (energy / curvature) * image
        scaled = precondition(residual)
        energy, before = float(np.vdot(residual, scaled)), energy
        direction = scaled + (energy / before) * direction
    return x


def _profiles(view: NDArray[Any], segment: Segment) -> NDArray[Any]:
    """P_k(s) = Σ_u Z_k(s − u), columns merged to pixels: (R·(n + S − 1), M)."""
    rank, n, _ = view.shape
    S = segment.geometry.substeps
    pixels = blocks_to_pixels(view.reshape(rank * n, n), n, S, 1).reshape(rank, n, -1)
    summed = np.zeros((rank, n + S - 1, pixels.shape[2]), view.dtype)
    for u in range(S):
        summed[:, u : u + n] += pixels
    return summed.reshape(-1, pixels.shape[2])
