"""Ground truth of a simulated scene, in the voxels of a reconstruction."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.sim.scene import Scene

_BLOCK_BYTES = 16 << 20
"""Size of the block of full-resolution frames held in memory."""


def truth(
    scene: Scene, first_substep: int, count: int, spatial_merge: int = 1, temporal_merge: int = 1
) -> NDArray[np.float32]:
    """Return the mean light of each voxel of N_m × N_m pixels and T_m sub-steps.

    The result is (⌈count/T_m⌉, ⌈n/N_m⌉, ⌈n/N_m⌉). Voxels begin at ``first_substep``; the last ones along an
    axis are averaged over the part of them that exists. The scene is sampled in blocks; only the result is
    held in full.
    """
    if count < 1 or temporal_merge < 1 or not 1 <= spatial_merge <= scene.size:
        raise UsageError(
            f"the ground truth of {count} sub-steps cannot be computed with N_m = {spatial_merge}, "
            f"T_m = {temporal_merge}",
            possible=f"at least 1 sub-step, N_m from 1 to {scene.size}, T_m of 1 or more",
        )
    side = -(-scene.size // spatial_merge)
    voxels = np.zeros((-(-count // temporal_merge), side, side))
    starts = np.arange(0, scene.size, spatial_merge)
    extent = np.diff([*starts, scene.size])
    block = max(1, _BLOCK_BYTES // (4 * scene.size**2))
    for offset in range(0, count, block):
        frames = scene.frames(first_substep + offset, min(block, count - offset))
        voxel = np.arange(offset, offset + len(frames)) // temporal_merge
        begins = np.flatnonzero(np.diff(voxel, prepend=-1))
        # Not by reshaping: the last voxel of an axis may be narrower than the others.
        summed = np.add.reduceat(frames, starts, axis=1, dtype=np.float64)
        summed = np.add.reduceat(summed, starts, axis=2) / (extent[:, None] * extent)
        summed = np.add.reduceat(summed, begins, axis=0)
        # Added, because a voxel may begin in one block of frames and end in the next.
        voxels[voxel[0] : voxel[-1] + 1] += summed
    # the last voxel may have fewer sub-steps
    voxels /= np.bincount(np.arange(count) // temporal_merge)[:, None, None]
    return voxels.astype(np.float32)
