"""Λ′ restricted to a temporal subspace: B = Λ′·Dᵀ, coefficients (K, n′, n′) → lines (2, L_R, M).

Line ``i`` weighs the voxels of row block ``q`` with m(d)·E(t) along a staircase in time (forward.kernels). In
the cosines this is one number per (line, row block, cosine), so that B is two dense matrix products with one
factor of shape (L_R, n′·K), which is the same for both arms up to the order of the rows. For K ≪ T this is
far less work than synthesising the video and shearing it.

The arms are computed side by side if each takes long enough. The threads of a BLAS would gain no more, and
busy-wait for one another: beside two other programs, two threads took ten times as long as one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from array_api_compat import is_numpy_array

from acquire.arrays import host, namespace
from acquire.cores import granted_threads, side_by_side
from acquire.forward import (
    DualArm,
    GatheredArms,
    block_bounds,
    blur_matrices,
    column_merging,
    mean_weights,
    registration,
)
from acquire.recon.kernels import add_outer

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.alignment import Alignment
    from acquire.arrays import Array
    from acquire.blur import Blur
    from acquire.geometry import Geometry
    from acquire.lines import Segment
    from acquire.recon.basis import Basis


LARGEST_FACTORS_BYTES = 1 << 30
WORTH_A_THREAD = 1e8
"""Number of multiplications of an arm (about two milliseconds) from which the arms are computed side by
side."""


def band_operator(
    geometry: Geometry,
    code: NDArray[np.uint8],
    basis: Basis,
    spatial_merge: int = 1,
    temporal_merge: int = 1,
    *,
    alignment: Alignment | None = None,
    blur: Blur | None = None,
) -> BandOperator | InBasis:
    """B = Λ′·Dᵀ, by dense factors if these take at most 1 GiB, otherwise by synthesising the video."""
    side = geometry.video_shape(spatial_merge, temporal_merge)[1]
    itemsize = np.dtype(basis.arrays.dtype).itemsize
    dense = 2 * geometry.lines * side * basis.count * itemsize <= LARGEST_FACTORS_BYTES
    make = BandOperator if dense else InBasis
    return make(geometry, code, basis, spatial_merge, temporal_merge, alignment=alignment, blur=blur)


def segment_operator(
    segment: Segment,
    basis: Basis,
    spatial_merge: int,
    temporal_merge: int,
    *,
    code: NDArray[Any] | None = None,
) -> BandOperator | InBasis:
    """B of a segment, with its alignment and blur; ``code`` replaces the segment's own."""
    return band_operator(
        segment.geometry,
        segment.code if code is None else code,
        basis,
        spatial_merge,
        temporal_merge,
        alignment=segment.alignment,
        blur=segment.blur,
    )


class BandOperator:
    """B = Λ′·Dᵀ and its transpose, for any N_m and T_m, by one dense factor per arm."""

    def __init__(
        self,
        geometry: Geometry,
        code: NDArray[np.uint8],
        basis: Basis,
        spatial_merge: int = 1,
        temporal_merge: int = 1,
        *,
        alignment: Alignment | None = None,
        blur: Blur | None = None,
    ) -> None:
        side = geometry.video_shape(spatial_merge, temporal_merge)[1]
        self.theta_shape = (basis.count, side, side)
        self.lines_shape = geometry.lines_shape
        self._xp, self._asarray = basis.arrays.xp, basis.arrays.asarray
        asarray = self._asarray
        merging = column_merging(geometry, spatial_merge)
        self._registration = registration(alignment, geometry, spatial_merge, basis.arrays)
        starts, lengths = block_bounds(geometry.size, spatial_merge)
        lit = lit_cosines(code, basis, temporal_merge)
        # Arm B's rows are the scene's columns from right to left: the factor has them in that order, so that
        # the view of the frames need not be reversed.
        flipped = geometry.size - starts - lengths
        factors = [staircase(lit, order, lengths, geometry) for order in (starts, flipped)]
        mergings: list[NDArray[Any]] = [merging, merging]
        self._veils: list[Veil | None] = [None, None]
        if blur is not None:
            # Along the transfer the blur goes into the factor, across it into the merging: it costs no time
            # per frame. The matrices are those of the scene's rows and columns; arm B's charge moves along
            # the latter.
            (along_a, across_a), (across_b, along_b) = blur_matrices(blur, geometry.size, spatial_merge)
            mean = mean_weights(geometry.size, spatial_merge)
            self._veils = [
                None
                if not veil
                else Veil(
                    asarray(along.T @ mean),
                    asarray(across.T @ mean),
                    asarray(veil * factor.sum(axis=1)),
                    asarray(merging.sum(axis=0)),
                )
                for veil, factor, along, across in zip(
                    blur.veil, factors, (along_a, along_b), (across_a, across_b), strict=True
                )
            ]
            factors = [
                np.einsum("lqk,qp->lpk", factor, along.astype(factor.dtype), optimize=True)
                for factor, along in zip(factors, (along_a, along_b), strict=True)
            ]
            mergings = [
                (1 - veil) * across.T @ merging
                for veil, across in zip(blur.veil, (across_a, across_b), strict=True)
            ]
        self._mergings = [asarray(each) for each in mergings]
        self._factors = [asarray(factor.reshape(geometry.lines, -1)) for factor in factors]

    def forward(self, theta: Array) -> Array:
        """B·θ."""
        view_b = theta if self._registration is None else self._registration.forward(theta)
        views = (  # (block, K, across)
            self._xp.permute_dims(each, axes) for each, axes in ((theta, (1, 0, 2)), (view_b, (2, 0, 1)))
        )
        first, second = views
        return self._xp.stack(self._both(lambda: self._arm(0, first), lambda: self._arm(1, second)))

    def adjoint(self, lines: Array) -> Array:
        """Bᵀ·y."""
        K, side, _ = self.theta_shape
        flat = self._both(
            lambda: self._arm_adjoint(0, lines[0, ...]), lambda: self._arm_adjoint(1, lines[1, ...])
        )
        rows, columns = (self._xp.reshape(each, (side, K, side)) for each in flat)
        view_b = self._xp.permute_dims(columns, (1, 2, 0))
        back = view_b if self._registration is None else self._registration.adjoint(view_b)
        return self._xp.permute_dims(rows, (1, 0, 2)) + back

    def near_inverse(self, damping: float) -> Callable[[Array], Array]:
        """Approximate (B·Bᵀ + damping)⁻¹, lines to lines: exact for each arm alone if N_m divides S.

        Pixels of one arm share no voxel then, so that B·Bᵀ of an arm is one matrix between its lines, the
        same for all pixels. Neighbouring lines are nearly equal, which makes B·Bᵀ ill-conditioned; the arms
        have little more than the mean in common, which is left to the iterations.
        """
        xp, damped = self._xp, damping * np.eye(self.lines_shape[1])
        inverses = [self._asarray(np.linalg.inv(gram + damped)) for gram in self._grams]
        return lambda lines: xp.stack([m @ lines[arm, ...] for arm, m in enumerate(inverses)])

    @cached_property
    def _grams(self) -> list[NDArray[np.float64]]:
        """B·Bᵀ of each arm, between lines (L_R, L_R)."""
        # The merging adds only a factor per pixel, whose mean is taken: all are equal if N_m divides S.
        each = [np.square(host(m), dtype=np.float64).sum(axis=0).mean() for m in self._mergings]
        # It is computed in float64, because neighbouring lines are nearly equal, and the inverse multiplies
        # rounding errors.
        exact = [host(factor).astype(np.float64) for factor in self._factors]
        return [float(size) * (factor @ factor.T) for size, factor in zip(each, exact, strict=True)]

    def _both(self, first: Callable[[], Array], second: Callable[[], Array]) -> tuple[Array, Array]:
        """Results of both arms, side by side where that is worth a thread and the cores are free."""
        factor, pixels = self._factors[0], self.lines_shape[2]
        worth = is_numpy_array(factor) and factor.size * pixels > WORTH_A_THREAD
        return side_by_side(first, second) if worth and granted_threads() > 1 else (first(), second())

    def _arm(self, arm: int, view: Array) -> Array:
        """Lines of an arm; columns are merged into pixels on the smaller side of the product."""
        factor, merging = self._factors[arm], self._mergings[arm]
        side, pixels = merging.shape
        blocks = self._xp.reshape(view, (-1, side))
        lines = factor @ (blocks @ merging) if side > pixels else (factor @ blocks) @ merging
        return lines if (veil := self._veils[arm]) is None else lines + veil.forward(blocks)

    def _arm_adjoint(self, arm: int, lines: Array) -> Array:
        """The transpose of `_arm`: (n′·K, n′)."""
        factor, merging = self._factors[arm], self._mergings[arm]
        side, pixels = merging.shape
        back = (factor.T @ lines) @ merging.T if side > pixels else factor.T @ (lines @ merging.T)
        if (veil := self._veils[arm]) is None:
            return back
        return veil.add_adjoint(lines, back)


@dataclass(frozen=True, slots=True)
class Veil:
    """What an arm's veil adds to its lines, a matrix of rank K: the mean of each coefficient, as even light.

    Attributes
    ----------
    along, across : weights of the blurred frame's mean, along the charge and across it (n′,)
    factor : lines of a coefficient that is 1 everywhere, times the veil (L_R, K)
    pixels : light of an even row in each pixel (M,)
    """

    along: Array
    across: Array
    factor: Array
    pixels: Array

    def forward(self, blocks: Array) -> Array:
        """(n′·K, across) → (L_R, M)."""
        xp, side = namespace(blocks), self.along.shape[0]
        # along the charge first: one product with a vector, of everything in the order of memory
        sums = self.along @ xp.reshape(blocks, (side, -1))
        means = xp.reshape(sums, (-1, self.across.shape[0])) @ self.across
        return (self.factor @ means)[:, None] * self.pixels

    def add_adjoint(self, lines: Array, back: Array) -> Array:
        """Add the transpose, (L_R, M) → (n′·K, across), to ``back``, which may be overwritten."""
        xp, means = namespace(lines), self.factor.T @ (lines @ self.pixels)
        levels = xp.reshape(self.along[:, None] * means, (-1,))
        if is_numpy_array(back):
            add_outer(levels, self.across, back)
            return back
        return back + levels[:, None] * self.across


class InBasis:
    """Λ′·Dᵀ by synthesising the video and shearing it: for a full basis, K = T."""

    def __init__(
        self,
        geometry: Geometry,
        code: NDArray[np.uint8],
        basis: Basis,
        spatial_merge: int = 1,
        temporal_merge: int = 1,
        *,
        alignment: Alignment | None = None,
        blur: Blur | None = None,
    ) -> None:
        self._basis, case = basis, (geometry, code, spatial_merge, temporal_merge)
        arrays = basis.arrays
        self._operator: DualArm | GatheredArms
        if arrays.compiled:
            self._operator = DualArm(*case, np.dtype(arrays.dtype).type, alignment=alignment, blur=blur)
        else:
            self._operator = GatheredArms(*case, arrays, alignment=alignment, blur=blur)

    def forward(self, theta: Array) -> Array:
        """Return the lines of coefficients."""
        return self._operator.forward(self._basis.synthesize(theta))

    def adjoint(self, lines: Array) -> Array:
        """Return the coefficients of the transpose."""
        return self._basis.analyze(self._operator.adjoint(lines))


def lit_cosines(code: NDArray[np.uint8], basis: Basis, temporal_merge: int) -> NDArray[Any]:
    """E(t)·D_k(t // T_m): (T, K)."""
    frame = np.arange(len(code)) // temporal_merge
    lit: NDArray[Any] = basis.matrix().T[frame] * code[:, None].astype(basis.arrays.dtype)
    return lit


def staircase(
    lit: NDArray[Any], starts: NDArray[np.int64], lengths: NDArray[np.int64], geometry: Geometry
) -> NDArray[Any]:
    """Σ_d m(d)·lit[i·S + start_q + d] for every line i and row block q: (L_R, n′, K)."""
    S, K = geometry.substeps, lit.shape[1]
    first = np.arange(geometry.lines)[:, None] * S
    factor = np.empty((geometry.lines, len(starts), K), lit.dtype)
    # The last block may be shorter, and has other multiplicities then.
    for length in np.unique(lengths):
        steps = length + S - 1
        # The sum depends on line and block only through the sub-step where it begins, and there are about n′
        # times fewer of those: they are summed once, and then copied.
        sums = np.zeros((len(lit) - steps + 1, K), lit.dtype)
        for d in range(steps):
            # This is the number of rows r of the block and steps u of the line with r + u = d. It has lit's
            # dtype, because one of numpy's int64 would make the products float64.
            multiplicity = lit.dtype.type(min(d + 1, length, S, length + S - 1 - d))
            sums += multiplicity * lit[d : d + len(sums)]
        blocks = np.flatnonzero(lengths == length)
        factor[:, blocks] = sums[first + starts[blocks]]
    return factor
