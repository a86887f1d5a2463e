"""Λ′ restricted to a temporal subspace: B = Λ′·Dᵀ, coefficients (K, n′, n′) → lines (2, L_R, M).

Line ``i`` weighs the voxels of row block ``q`` with m(d)·E(t) along a staircase in time (forward.kernels);
against the cosines that is one number per (line, row block, cosine). So B is two dense matrix products
with one factor of shape (L_R, n′·K), the same for both arms up to the order of the rows: for K ≪ T far less
work than synthesising the video and shearing it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.forward import DualArm, block_bounds
from acquire.forward.kernels import blocks_to_pixels, pixels_to_blocks

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.geometry import Geometry
    from acquire.recon.basis import Basis


LARGEST_FACTORS_BYTES = 1 << 30


def band_operator(
    geometry: Geometry,
    code: NDArray[np.uint8],
    basis: Basis,
    spatial_merge: int = 1,
    temporal_merge: int = 1,
) -> BandOperator | InBasis:
    """B = Λ′·Dᵀ, by the dense factors where these take at most 1 GiB, else by way of the video."""
    side = geometry.video_shape(spatial_merge, temporal_merge)[1]
    if 2 * geometry.lines * side * basis.count * basis.dtype.itemsize <= LARGEST_FACTORS_BYTES:
        return BandOperator(geometry, code, basis, spatial_merge, temporal_merge)
    whole = DualArm(geometry, code, spatial_merge, temporal_merge, basis.dtype.type)
    return InBasis(whole, basis)


class BandOperator:
    """B = Λ′·Dᵀ and its transpose, for any N_m and T_m, by one dense factor per arm."""

    def __init__(
        self,
        geometry: Geometry,
        code: NDArray[np.uint8],
        basis: Basis,
        spatial_merge: int = 1,
        temporal_merge: int = 1,
    ) -> None:
        side = geometry.video_shape(spatial_merge, temporal_merge)[1]
        self.theta_shape = (basis.count, side, side)
        self.lines_shape = geometry.lines_shape
        self.dtype = basis.dtype
        self._columns = (geometry.size, geometry.substeps, spatial_merge)
        self._pixels = geometry.stages
        starts, lengths = block_bounds(geometry.size, spatial_merge)
        lit = self._lit_cosines(code, basis, temporal_merge)
        flipped = geometry.size - starts - lengths
        self._factors = [
            _staircase(lit, order, lengths, geometry).reshape(geometry.lines, -1)
            for order in (starts, flipped)
        ]

    def forward(self, theta: NDArray[Any]) -> NDArray[Any]:
        """B·θ."""
        views = theta.transpose(1, 0, 2), theta.transpose(2, 0, 1)  # (block along TDI, K, across)
        return np.stack([self._arm(*pair) for pair in zip(self._factors, views, strict=True)])

    def adjoint(self, lines: NDArray[Any]) -> NDArray[Any]:
        """Bᵀ·y."""
        K, side, _ = self.theta_shape
        rows, columns = (
            self._arm_adjoint(*pair).reshape(side, K, side) for pair in zip(self._factors, lines, strict=True)
        )
        theta: NDArray[Any] = rows.transpose(1, 0, 2) + columns.transpose(1, 2, 0)
        return theta

    def _arm(self, factor: NDArray[Any], view: NDArray[Any]) -> NDArray[Any]:
        """Columns are merged into pixels on that side of the product where it is the smaller."""
        blocks = np.ascontiguousarray(view).reshape(-1, self.theta_shape[1])
        if self.theta_shape[1] > self._pixels:
            pixels: NDArray[Any] = factor @ blocks_to_pixels(blocks, *self._columns)
            return pixels
        return blocks_to_pixels(factor @ blocks, *self._columns)

    def _arm_adjoint(self, factor: NDArray[Any], arm: NDArray[Any]) -> NDArray[Any]:
        if self.theta_shape[1] > self._pixels:
            return pixels_to_blocks(factor.T @ arm, *self._columns)
        blocks: NDArray[Any] = factor.T @ pixels_to_blocks(arm, *self._columns)
        return blocks

    @staticmethod
    def _lit_cosines(code: NDArray[np.uint8], basis: Basis, temporal_merge: int) -> NDArray[Any]:
        """E(t)·D_k(t // T_m): (T, K)."""
        frame = np.arange(len(code)) // temporal_merge
        lit: NDArray[Any] = basis.matrix().T[frame] * code[:, None].astype(basis.dtype)
        return lit


class InBasis:
    """Λ′·Dᵀ by synthesising the video and shearing it: for a full basis, K = T."""

    def __init__(self, operator: DualArm, basis: Basis) -> None:
        self._operator, self._basis = operator, basis

    def forward(self, theta: NDArray[Any]) -> NDArray[Any]:
        return self._operator.forward(self._basis.synthesize(theta))

    def adjoint(self, lines: NDArray[Any]) -> NDArray[Any]:
        return self._basis.analyze(self._operator.adjoint(lines))


def _staircase(
    lit: NDArray[Any], starts: NDArray[np.int64], lengths: NDArray[np.int64], geometry: Geometry
) -> NDArray[Any]:
    """Σ_d m(d)·lit[i·S + start_q + d] for every line i and row block q: (L_R, n′, K)."""
    S = geometry.substeps
    first = np.arange(geometry.lines)[:, None] * S
    factor = np.zeros((geometry.lines, len(starts), lit.shape[1]), lit.dtype)
    for length in np.unique(lengths):
        blocks = np.flatnonzero(lengths == length)
        for d in range(length + S - 1):
            multiplicity = lit.dtype.type(min(d + 1, length, S, length + S - 1 - d))
            factor[:, blocks] += multiplicity * lit[first + starts[blocks] + d]
    return factor
