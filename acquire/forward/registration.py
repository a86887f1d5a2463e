"""Registration: the map from arm A's view of the scene to arm B's, as one sparse matrix R and its transpose.

R interpolates between the four neighbours of the point at which a pixel of arm B looks. Beyond the edge the
scene continues with its edge values. Its elements are not negative and its rows sum to 1, so a uniform scene
is unchanged and the bound of ‖Λ′‖ holds with R as without. For voxels of N_m > 1 a voxel is held over its
block, R is applied, and the mean over each block is taken.

R acts on frames that do not change from sub-step to sub-step (coefficients of a basis, patterns), so that
more sub-steps cost nothing. Without an alignment there is no R.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from scipy import sparse

from acquire.arrays import HOST
from acquire.forward.kernels import move_frame, move_frames
from acquire.forward.merge import block_bounds

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.alignment import Alignment
    from acquire.arrays import Array, Arrays
    from acquire.geometry import Geometry


FEW = 2**23
"""Products that one thread computes before others could be woken on a busy host."""
PART = 2048
"""Pixels that are handled together: in float64 they and their sources fill the nearest cache."""
GAP = 32
"""Elements of a run that take as long as a further run."""
Runs: TypeAlias = "tuple[NDArray[np.uint64], NDArray[np.uint64], NDArray[np.uint64], NDArray[Any]]"
"""First row, first column and first weight of each run, and all weights; see `runs`."""


def registration(
    alignment: Alignment | None, geometry: Geometry, spatial_merge: int = 1, arrays: Arrays = HOST
) -> Registration | None:
    """Return R of an alignment, or None if there is no alignment."""
    return None if alignment is None else Registration(alignment, geometry.size, spatial_merge, arrays)


class Registration:
    """R on frames (k, n′, n′), in any ``arrays``."""

    def __init__(self, alignment: Alignment, size: int, spatial_merge: int, arrays: Arrays = HOST) -> None:
        self._forward: _Moved | _Gathered
        self._adjoint: _Moved | _Gathered
        if arrays.compiled:
            pair = _runs_both_ways(alignment, size, spatial_merge, arrays.dtype)
            self._forward, self._adjoint = (_Moved(each) for each in pair)
        else:
            both = _with_transpose(alignment, size, spatial_merge)
            self._forward, self._adjoint = (_Gathered(each, arrays) for each in both)

    def forward(self, frames: Array) -> Array:
        """Map arm A's view (k, n′, n′) to arm B's."""
        return self._forward(frames)

    def adjoint(self, frames: Array) -> Array:
        """Apply Rᵀ, from arm B's view to arm A's."""
        return self._adjoint(frames)


@lru_cache(maxsize=8)
def _with_transpose(
    alignment: Alignment, size: int, spatial_merge: int
) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Return R and Rᵀ; cached, since a refinement needs them round after round."""
    matrix = sampling_matrix(alignment, size, spatial_merge)
    return matrix, matrix.T.tocsr()


@lru_cache(maxsize=8)
def _runs_both_ways(alignment: Alignment, size: int, spatial_merge: int, dtype: str) -> tuple[Runs, Runs]:
    """Return the runs of R and Rᵀ; cached like these."""
    matrix, transpose = _with_transpose(alignment, size, spatial_merge)
    return runs(matrix, dtype), runs(transpose, dtype)


def sampling_matrix(alignment: Alignment, size: int, spatial_merge: int = 1) -> sparse.csr_array:
    """Return R (n′², n′²), with rows and columns in the order of a frame's elements."""
    fine = interpolation(*alignment.sources(size))
    if spatial_merge == 1:
        # whole-pixel shifts leave corners of weight 0, which would take as long as the others
        fine.eliminate_zeros()
        return fine
    # H = B ⊗ B, (n², n′²), holds voxels over their blocks; its normalised transpose takes the means.
    _, lengths = block_bounds(size, spatial_merge)
    block = np.repeat(np.arange(len(lengths)), lengths)
    one = sparse.coo_array((np.ones(size), (np.arange(size), block))).tocsr()
    held: sparse.csr_array = sparse.kron(one, one).tocsr()
    means = sparse.diags_array(1 / held.sum(axis=0)) @ held.T
    merged: sparse.csr_array = (means @ fine @ held).tocsr()
    merged.eliminate_zeros()
    return merged


def interpolation(rows: NDArray[np.float64], columns: NDArray[np.float64]) -> sparse.csr_array:
    """Return the matrix that takes a frame to its values at places of the same shape, bilinear.

    Beyond the edge, the edge continues.
    """
    high, wide = rows.shape
    rows, columns = np.clip(rows, 0, high - 1).ravel(), np.clip(columns, 0, wide - 1).ravel()
    row, column = (each.astype(np.int64) for each in (rows, columns))
    below, right = rows - row, columns - column
    # at the last row or column the fraction is 0, so that any valid neighbour will do
    next_row, next_column = np.minimum(row + 1, high - 1), np.minimum(column + 1, wide - 1)
    corners = [
        ((1 - below) * (1 - right), row * wide + column),
        ((1 - below) * right, row * wide + next_column),
        (below * (1 - right), next_row * wide + column),
        (below * right, next_row * wide + next_column),
    ]
    weights, sources = (np.concatenate(each) for each in zip(*corners, strict=True))
    places = np.tile(np.arange(high * wide), len(corners))
    # `tocsr` adds up the weights of corners that coincide there
    return sparse.coo_array((weights, (places, sources)), shape=(high * wide, high * wide)).tocsr()


def interpolation_variance(alignment: Alignment, size: int) -> tuple[float, float]:
    """Return the variance by which R itself blurs an image along rows and columns, in fine pixels².

    It is f·(1 − f) for a point at the fraction f between two pixels, averaged over the field.
    """
    fractions = (each % 1 for each in alignment.sources(size))
    rows, columns = (float((each * (1 - each)).mean()) for each in fractions)
    return rows, columns


class _Moved:
    """A sparse matrix that acts on the pixels of frames, by compiled loops along its `runs`."""

    def __init__(self, given: Runs) -> None:
        self._runs = given

    def __call__(self, frames: NDArray[Any]) -> NDArray[Any]:
        out = np.zeros(frames.shape, frames.dtype)
        flat, flat_out = frames.reshape(len(frames), -1), out.reshape(len(frames), -1)
        if len(flat) * len(self._runs[-1]) > FEW:
            move_frames(flat, *self._runs, flat_out)
            return out
        for frame, row in zip(flat, flat_out, strict=True):
            move_frame(frame, *self._runs, row)
        return out


class _Gathered:
    """The same in operations that every array library has: term j holds the j-th element of every row."""

    def __init__(self, matrix: sparse.csr_array, arrays: Arrays) -> None:
        self._xp = arrays.xp
        self._terms: list[tuple[Array, Array]] = []
        counts = np.diff(matrix.indptr)
        for j in range(int(counts.max())):
            # rows with fewer elements read those of the next row, with weight 0
            at = np.minimum(matrix.indptr[:-1] + j, matrix.nnz - 1)
            weight = np.where(counts > j, matrix.data[at], 0.0)
            index = matrix.indices[at].astype(np.int64)
            self._terms.append((arrays.indices(index), arrays.asarray(weight)))

    def __call__(self, frames: Array) -> Array:
        flat = self._xp.reshape(frames, (frames.shape[0], -1))
        parts = (weight * self._xp.take(flat, index, axis=1) for index, weight in self._terms)
        total = next(parts)
        for part in parts:
            total += part
        return self._xp.reshape(total, frames.shape)


def runs(matrix: sparse.csr_array, dtype: str) -> Runs:
    """Return a matrix as runs along its diagonals: first row, first column, first weight of each; weights.

    Neighbouring pixels of arm B look at neighbouring points of arm A's view, so that R is a few diagonals in
    long runs. A run multiplies consecutive pixels, which wide instructions do at once. The weights of run i
    are those from ``begins[i]`` to ``begins[i + 1]``, some of them 0, since short gaps are filled. Runs that
    end in the same part of the frame follow one another, so that it stays in the nearest cache.
    """
    elements = matrix.tocoo()
    row, column = elements.row.astype(np.int64), elements.col.astype(np.int64)
    part, diagonal = row // PART, column - row
    order = np.lexsort((row, diagonal, part))
    row, column, part, diagonal = row[order], column[order], part[order], diagonal[order]
    apart = (np.diff(part) != 0) | (np.diff(diagonal) != 0) | (np.diff(row) > GAP)
    starts = np.concatenate([[0], np.flatnonzero(apart) + 1])
    ends = np.append(starts[1:], len(row)) - 1
    begins = np.concatenate([[0], np.cumsum(row[ends] - row[starts] + 1)])
    run = np.repeat(np.arange(len(starts)), ends - starts + 1)
    weights = np.zeros(begins[-1], dtype)
    weights[begins[run] + row - row[starts][run]] = elements.data[order]
    first, source, begins = (each.astype(np.uint64) for each in (row[starts], column[starts], begins))
    return first, source, begins, weights
