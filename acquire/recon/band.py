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
    from acquire.recon.basis import TemporalBasis


LARGEST_FACTORS_BYTES = 1 << 30


def band_operator(
    geometry: Geometry,
    code: NDArray[np.uint8],
    basis: TemporalBasis,
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
        basis: TemporalBasis,
        spatial_merge: int = 1,
        temporal_merge: int = 1,
    ) -> None:
        side = geometry.video_shape(spatial_merge, temporal_merge)[1]
        self.theta_shape = (basis.count, side, side)
        self.lines_shape = geometry.lines_shape
        self.dtype = basis.dtype
        self._columns = (geometry.size, geometry.substeps, spatial_merge)
        starts, lengths = block_bounds(geometry.size, spatial_merge)
        lit = self._lit_cosines(code, basis, temporal_merge)
        flipped = geometry.size - starts - lengths
        self._factors = [
            _staircase(lit, order, lengths, geometry).reshape(geometry.lines, -1)
            for order in (starts, flipped)
        ]

    def forward(self, theta: NDArray[Any]) -> NDArray[Any]:
        """B·θ."""
        rows, columns = theta.transpose(1, 0, 2), theta.transpose(2, 0, 1)  # (block along TDI, K, across)
        side = self.theta_shape[1]
        return np.stack(
            [
                blocks_to_pixels(factor @ np.ascontiguousarray(view).reshape(-1, side), *self._columns)
                for factor, view in zip(self._factors, (rows, columns), strict=True)
            ]
        )

    def adjoint(self, lines: NDArray[Any]) -> NDArray[Any]:
        """Bᵀ·y."""
        K, side, _ = self.theta_shape
        rows, columns = (
            (factor.T @ pixels_to_blocks(arm, *self._columns)).reshape(side, K, side)
            for factor, arm in zip(self._factors, lines, strict=True)
        )
        theta: NDArray[Any] = rows.transpose(1, 0, 2) + columns.transpose(1, 2, 0)
        return theta

    @staticmethod
    def _lit_cosines(code: NDArray[np.uint8], basis: TemporalBasis, temporal_merge: int) -> NDArray[Any]:
        """E(t)·D_k(t // T_m): (T, K)."""
        frame = np.arange(len(code)) // temporal_merge
        lit: NDArray[Any] = basis.matrix().T[frame] * code[:, None].astype(basis.dtype)
        return lit


class InBasis:
    """Λ′·Dᵀ by synthesising the video and shearing it: for a full basis, K = T."""

    def __init__(self, operator: DualArm, basis: TemporalBasis) -> None:
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
