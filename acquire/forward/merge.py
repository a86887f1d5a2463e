"""Merging of voxels: the fine rows, columns and sub-steps that one voxel of X′ stands for.

X is X′ held constant over its block, so merging a projection matrix sums the columns of a block
(M_T, M_N of Eq. 3), and C_N counts the fine columns that a block shares with a pixel. N_m need not divide
n, nor T_m divide T: the last block is then shorter.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.geometry import Geometry


def block_bounds(length: int, merge: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first element and length of each block of ``merge`` elements that tile ``length``."""
    starts = np.arange(0, length, merge, dtype=np.int64)
    return starts, np.minimum(merge, length - starts)


def column_merging(geometry: Geometry, spatial_merge: int) -> NDArray[np.int64]:
    """Return C_N (⌈n/N_m⌉, M): how many fine columns a block shares with a pixel."""
    columns = np.arange(geometry.size)
    shared = np.zeros((-(-geometry.size // spatial_merge), geometry.stages), np.int64)
    np.add.at(shared, (columns // spatial_merge, columns // geometry.substeps), 1)
    return shared


def merge_video(video: NDArray[Any], spatial_merge: int, temporal_merge: int) -> NDArray[Any]:
    """Average a fine video (T, n, n) over the block of each voxel: (⌈T/T_m⌉, ⌈n/N_m⌉, ⌈n/N_m⌉)."""
    if video.ndim != 3:
        raise UsageError(f"a video of shape {video.shape} cannot be merged", possible="(time, row, column)")
    merged = video.astype(np.result_type(video.dtype, np.float32))
    for axis, merge in enumerate((temporal_merge, spatial_merge, spatial_merge)):
        if merge == 1:
            continue
        starts, lengths = block_bounds(merged.shape[axis], merge)
        shape = [1, 1, 1]
        shape[axis] = -1
        merged = np.add.reduceat(merged, starts, axis=axis) / lengths.reshape(shape).astype(merged.dtype)
    return merged


def hold_video(
    voxels: NDArray[Any], geometry: Geometry, spatial_merge: int, temporal_merge: int
) -> NDArray[Any]:
    """Hold each voxel of X′ over its block and return X (T, n, n): large, so for small cases only."""
    fine = voxels
    for axis, (merge, length) in enumerate(
        ((temporal_merge, geometry.span), (spatial_merge, geometry.size), (spatial_merge, geometry.size))
    ):
        fine = np.repeat(fine, merge, axis=axis).take(np.arange(length), axis=axis)
    return fine
