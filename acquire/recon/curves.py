"""The light curves of known patterns, from all lines: least squares with a prior that the lines choose.

    minimise  ‖y − Σ_k Λ·(u_k ⊗ Z_k)‖²/σ² + Σ_{c,k} x_{ck}²/γ_c,     u_k = Dᵀ·x_k

Line i is Σ_{k,s} E(iS + s)·u_k(iS + s)·P_k(s), with P_k the pattern's rows summed over S steps. The system is
small, R·K unknowns for all samples, but the sum over n steps attenuates fast light: plain conjugate gradients
need hundreds of steps. With all samples in use the normal matrix is known in closed form, for sub-steps t, t'

    G[t, k; t', k'] = E(t)·E(t')·Σ_i Q_{kk'}(t − iS, t' − iS),     Q_{kk'} = P_k·P_{k'}ᵀ of both arms

and with its inverse as preconditioner a few steps are enough if some samples are masked.

Without a prior, noise and the errors of the patterns go into the cosines that the lines hardly determine: the
curves of fast lamps lose their amplitude. γ_c, the energy of cosine c, is shared by the patterns, so that it
means the same however they are rotated; it and the noise σ² are those for which the lines are most likely
(`evidence`). On lines without noise the prior fades out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.arrays import dot, host
from acquire.forward import column_merging
from acquire.recon.evidence import FAINTEST, NormalEquations, determined_share
from acquire.recon.views import seen_by_arms

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.arrays import Array
    from acquire.lines import Segment
    from acquire.recon.basis import TemporalBasis
    from acquire.recon.problem import Problem

RIDGE = 1e-5
"""Ridge relative to the mean eigenvalue: light that no line sees stays unchanged."""
STEPS = 6
PLAIN_STEPS = 60
"""Numbers of steps of conjugate gradients: with the preconditioner of a small problem, and without one."""
REFRESH = 4
"""Number of calls that share a preconditioner and a prior."""
EVIDENCE_STEPS = 2
"""Number of fixed-point steps of the prior in such a call; it converges over the calls."""
LARGEST_SPAN = 8192
"""Largest number of sub-steps for which the normal matrix is formed; it would take too much memory beyond."""
LARGEST_UNKNOWNS = 4096
"""The same for the unknowns, of which the matrix has as many rows."""


@dataclass(frozen=True, slots=True, eq=False)
class CurvePrior:
    """Independent normal curves: the energy γ (K,) of each cosine, and the noise σ² of the samples."""

    energy: NDArray[np.float64]
    noise: float

    @property
    def precision(self) -> NDArray[np.float64]:
        """σ²/γ (K, 1), what the prior adds to the diagonal of the normal matrix."""
        precision: NDArray[np.float64] = self.noise / np.maximum(self.energy, FAINTEST * self.energy.max())
        return precision[:, None]


class CurveFit:
    """Fits the curves of patterns that change little from call to call.

    The normal matrix costs ten times the rest, and an old one is as good a preconditioner as a new one: it is
    computed in every `REFRESH`-th call. Patterns and cosines are on the device of the problem's arrays,
    curves on the host.
    """

    def __init__(
        self,
        segment: Segment,
        problem: Problem,
        cosines: TemporalBasis,
        temporal_merge: int,
        ridge: float = RIDGE,
        *,
        learns: bool = False,
    ) -> None:
        """Set up the fit; one that ``learns`` has a prior, which it finds from the lines.

        Light to which the lines respond less than ``ridge``, relative to the mean eigenvalue, hardly changes
        in one call: the larger the error of the patterns, the larger it should be.
        """
        self._segment, self._problem, self._cosines = segment, problem, cosines
        self._merge, self._ridge, self._learns, self._calls = temporal_merge, ridge, learns, 0
        self._precondition: Callable[[Array], Array] = lambda x: x
        self._damping = 0.0
        self.prior: CurvePrior | None = None

    def __call__(
        self, patterns: Array, start: NDArray[Any], known_lines: NDArray[Any] | None = None
    ) -> NDArray[np.float64]:
        """Fit curves (K, R) to the samples with ``patterns`` (R, n, n), near ``start``.

        The fit is well conditioned if the patterns are of similar size. ``known_lines`` are of other light.
        """
        arrays, exact = self._problem.arrays, self._problem.arrays.exact()
        whole = CurveOperator(self._segment, patterns, self._cosines, self._merge)
        operator = self._problem.masked(whole)
        problem = self._problem if known_lines is None else replace(self._problem, known_lines=known_lines)
        residual = problem.used_samples - operator.forward(arrays.asarray(start))
        gradient = host(exact.asarray(operator.adjoint(residual)))
        small = self._segment.geometry.span <= LARGEST_SPAN and start.size <= LARGEST_UNKNOWNS
        if small and self._calls % REFRESH == 0:
            self._prepare(host(whole.gram()), start, gradient, float(dot(residual, residual)))
        self._calls += 1
        precision = np.zeros((1, 1)) if self.prior is None else self.prior.precision
        damping = exact.asarray(self._damping + precision)

        def normal(x: Array) -> Array:
            return exact.asarray(operator.adjoint(operator.forward(arrays.asarray(x)))) + damping * x

        # The damping holds back the change, the prior the curves: only the latter pulls at the start.
        right = exact.asarray(gradient - precision * start)
        change = _conjugate_gradients(normal, right, self._precondition, STEPS if small else PLAIN_STEPS)
        fitted: NDArray[np.float64] = start + host(change)
        return fitted

    def _prepare(
        self, gram: NDArray[np.float64], start: NDArray[Any], gradient: NDArray[Any], energy: float
    ) -> None:
        """Update damping, preconditioner and, if the fit learns, its prior.

        ``gram`` is the normal matrix of all samples before their scaling, ``gradient`` (K, R) the adjoint of
        the residual of ``start``, ``energy`` the sum of its squares. A cosine's energy is the mean over the
        patterns of its squares, each over the share of it that the lines determine.
        """
        cosines, rank = start.shape
        samples = int(np.count_nonzero(self._problem.weight))
        # The masked samples are taken to be spread evenly, which is near enough for a preconditioner and a
        # prior.
        gram *= samples / self._problem.weight.size / self._problem.norm**2
        self._damping = max(self._ridge * float(np.trace(gram)) / len(gram), float(np.finfo(np.float32).tiny))
        # These are in the order of `gram`: all cosines of a pattern, then those of the next.
        before, slope = start.T.ravel().astype(np.float64), gradient.T.ravel().astype(np.float64)
        if self._learns and self.prior is None and start.any():
            # The first prior takes the curves as they are, and all of the residual as noise.
            likely = np.square(start, dtype=np.float64).mean(1)
            # Nothing is known of cosines that were not solved for, and without light they would stay dark.
            likely[likely == 0] = np.median(likely[likely > 0])
            self.prior = CurvePrior(likely, energy / samples)
        equations, diagonal = NormalEquations(gram, slope, energy, samples), np.diag_indices_from(gram)
        for _ in range(EVIDENCE_STEPS if self._learns else 1):
            added = np.zeros(len(gram)) if self.prior is None else np.tile(self.prior.precision[:, 0], rank)
            matrix = gram.copy()
            matrix[diagonal] += self._damping + added
            inverse = np.linalg.inv(matrix)
            if not self._learns:
                break
            change = inverse @ (slope - added * before)
            determined = determined_share(added, inverse)
            energies = (np.square(before + change) / determined).reshape(rank, cosines).mean(0)
            if not energies.max() > np.finfo(np.float32).tiny:
                break  # the curves are 0, of which no prior can be learnt
            self.prior = CurvePrior(energies, equations.noise(change, determined))
        exact = self._problem.arrays.exact()
        solver = exact.asarray(inverse)

        def solve(right: Array) -> Array:
            flat = exact.xp.reshape(right.T, (-1,))
            return exact.xp.reshape(exact.xp.matmul(solver, flat), (rank, cosines)).T

        self._precondition = solve


class CurveOperator:
    """Lines of patterns as a function of their curves: (K, R) → (2, L_R, M), and the transpose."""

    def __init__(
        self, segment: Segment, patterns: Array, cosines: TemporalBasis, temporal_merge: int
    ) -> None:
        self._geometry, self._merge, self._rank = segment.geometry, temporal_merge, patterns.shape[0]
        self._arrays, self._xp = cosines.arrays, cosines.arrays.xp
        self._width = segment.geometry.size + segment.geometry.substeps - 1
        substeps = np.arange(segment.geometry.span)
        # (line, s): the n + S − 1 sub-steps that a line integrates.
        windows = np.asarray(self._firsts)[:, None] + np.arange(self._width)
        self._frame = self._arrays.indices(substeps // temporal_merge)
        self._windows = self._arrays.indices(windows.ravel())
        self._code = self._arrays.asarray(segment.code)
        view_a, view_b = seen_by_arms(segment, patterns, 1, self._arrays)
        # Arm B's rows are the scene's columns from right to left.
        views = (view_a, self._xp.flip(self._xp.permute_dims(view_b, (0, 2, 1)), axis=1))
        merging = self._arrays.asarray(column_merging(segment.geometry, 1))
        self._profiles = [_profiles(self._xp, view, merging, segment.geometry.substeps) for view in views]
        self._matrix = self._arrays.asarray(cosines.matrix())

    def forward(self, curves: Array) -> Array:
        """Lines of the curves (K, R)."""
        xp, lines = self._xp, self._geometry.lines
        lit = xp.take(self._matrix.T @ curves, self._frame, axis=0) * self._code[:, None]
        windows = xp.reshape(xp.take(lit, self._windows, axis=0), (lines, self._width, self._rank))
        flat = xp.reshape(xp.permute_dims(windows, (0, 2, 1)), (lines, -1))
        return xp.stack([flat @ profile for profile in self._profiles])

    def adjoint(self, lines: Array) -> Array:
        """(2, L_R, M) → (K, R)."""
        xp, (a, b) = self._xp, self._profiles
        back = lines[0, ...] @ a.T + lines[1, ...] @ b.T
        windows = xp.permute_dims(xp.reshape(back, (-1, self._rank, self._width)), (0, 2, 1))
        light = self._arrays.zeros((self._geometry.span, self._rank))
        # Windows overlap, and the array API has no addition at repeated indices.
        for line, first in enumerate(self._firsts):
            light[first : first + self._width, :] += windows[line, ...]
        light = light * self._code[:, None]
        if self._merge > 1:
            # Dark sub-steps complete the last frame.
            missing = -light.shape[0] % self._merge
            dark = xp.zeros((missing, light.shape[1]), dtype=light.dtype, device=light.device)
            frames = xp.reshape(xp.concat([light, dark]), (-1, self._merge, light.shape[1]))
            light = xp.sum(frames, axis=1)
        return self._matrix @ light

    def gram(self) -> Array:
        """The normal matrix of all samples in float64, unknowns in the order of (R, K)."""
        xp, K, R, exact = self._xp, self._matrix.shape[0], self._rank, self._arrays.exact()
        gram = exact.zeros((R, K, R, K))
        # Elsewhere G is 0.
        lit = self._arrays.indices(np.flatnonzero(host(self._code)))
        # float64 is needed: rounding in float32 could make it indefinite.
        cosines = exact.asarray(xp.take(self._matrix, xp.take(self._frame, lit), axis=1))
        cosines *= exact.asarray(xp.take(self._code, lit))
        shaped = [xp.reshape(exact.asarray(each), (R, self._width, -1)) for each in self._profiles]
        for k in range(R):
            for other in range(k + 1):
                Q = sum(each[k, ...] @ each[other, ...].T for each in shaped)
                # This is Σ_i Q(t − iS, t' − iS), of which only the sub-steps with light count.
                between = self._shifted(Q, self._geometry.lines)
                between = xp.take(xp.take(between, lit, axis=0), lit, axis=1)
                pair = cosines @ between @ cosines.T
                gram[k, :, other, :], gram[other, :, k, :] = pair, pair.T
        return xp.reshape(gram, (R * K, R * K))

    def _shifted(self, Q: Array, lines: int) -> Array:
        """Σ_i Q shifted by iS in both directions, from the sum for half of the lines."""
        if lines == 1:
            return Q
        # Doubling adds up log₂ L large matrices instead of L.
        half, S = self._shifted(Q, lines // 2), self._geometry.substeps
        parts = [(0, half), (lines // 2 * S, half)] + [((lines - 1) * S, Q)] * (lines % 2)
        span = self._width + (lines - 1) * S
        total = self._arrays.exact().zeros((span, span))
        for first, part in parts:
            last = first + part.shape[0]
            total[first:last, first:last] += part
        return total

    @property
    def _firsts(self) -> range:
        return range(0, self._geometry.lines * self._geometry.substeps, self._geometry.substeps)


def _conjugate_gradients(
    normal: Callable[[Array], Array], right: Array, precondition: Callable[[Array], Array], steps: int
) -> Array:
    x, residual = 0 * right, right
    direction = scaled = precondition(residual)
    energy = float(dot(residual, scaled))
    for _ in range(steps):
        image = normal(direction)
        curvature = float(dot(direction, image))
        if not energy > 0 or not curvature > 0:
            break
        x += (energy / curvature) * direction
        # Not in place: in the first step it is still the caller's `right`.
        residual = residual - (energy / curvature) * image
        scaled = precondition(residual)
        energy, before = float(dot(residual, scaled)), energy
        direction = scaled + (energy / before) * direction
    return x


def _profiles(xp: Any, view: Array, merging: Array, S: int) -> Array:
    """P_k(s) = Σ_u Z_k(s − u), columns merged to pixels: (R·(n + S − 1), M)."""
    rank, n, _ = view.shape
    pixels = xp.reshape(xp.reshape(view, (rank * n, n)) @ merging, (rank, n, -1))
    none = xp.zeros_like(pixels[:, : S - 1, :])
    padded = xp.concat([none, pixels, none], axis=1)
    summed = sum(padded[:, S - 1 - u : 2 * S - 2 - u + n, :] for u in range(S))
    return xp.reshape(summed, (-1, pixels.shape[2]))
