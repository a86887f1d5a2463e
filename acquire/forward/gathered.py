"""The shear in operations that every array library has, for arrays without the compiled loops.

A line is a sum over the row blocks q and the few frames j that its staircase crosses in each (see `kernels`),

    out[i, :] = Σ_q Σ_j weight[j, i, q]·voxels[frame(j, i, q), q, :]

and the transpose is a sum over the few lines that meet a frame in a row block. Both are gathers with a fixed
number of terms, padded with weights of 0 (ELLPACK), computed one term at a time for all lines or frames.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.forward.blurring import blurring
from acquire.forward.merge import block_bounds, column_merging
from acquire.forward.registration import registration

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.alignment import Alignment
    from acquire.arrays import Array, Arrays
    from acquire.blur import Blur
    from acquire.geometry import Geometry


class GatheredArms:
    """Λ′ like `DualArm`, in any ``arrays``."""

    def __init__(
        self,
        geometry: Geometry,
        code: NDArray[np.uint8],
        spatial_merge: int,
        temporal_merge: int,
        arrays: Arrays,
        alignment: Alignment | None = None,
        blur: Blur | None = None,
    ) -> None:
        starts, lengths = block_bounds(geometry.size, spatial_merge)
        flipped = geometry.size - starts - lengths
        frames = geometry.video_shape(spatial_merge, temporal_merge)[0]
        self._xp = arrays.xp
        self._registration = registration(alignment, geometry, spatial_merge, arrays)
        self._blurring = blurring(blur, geometry, spatial_merge, arrays)
        self._merging = arrays.asarray(column_merging(geometry, spatial_merge))
        self._terms = [
            _Terms(*_crossings(geometry, code, order, lengths, temporal_merge), frames, arrays)
            for order in (starts, flipped)
        ]

    def forward(self, video: Array) -> Array:
        """Λ′·X′: (⌈T/T_m⌉, ⌈n/N_m⌉, ⌈n/N_m⌉) → (2, L_R, M)."""
        view_b = video if self._registration is None else self._registration.forward(video)
        if self._blurring is not None:
            video, view_b = self._blurring.forward(0, video), self._blurring.forward(1, view_b)
        views = (video, self._xp.permute_dims(view_b, (0, 2, 1)))
        arms = [terms.shear(view) for terms, view in zip(self._terms, views, strict=True)]
        return self._xp.stack(arms) @ self._merging

    def adjoint(self, lines: Array) -> Array:
        """Λ′ᵀ·Y: (2, L_R, M) → (⌈T/T_m⌉, ⌈n/N_m⌉, ⌈n/N_m⌉)."""
        spread = lines @ self._merging.T
        a, b = (terms.unshear(spread[arm, ...]) for arm, terms in enumerate(self._terms))
        view_b = self._xp.permute_dims(b, (0, 2, 1))
        if self._blurring is not None:
            a, view_b = self._blurring.adjoint(0, a), self._blurring.adjoint(1, view_b)
        return a + (view_b if self._registration is None else self._registration.adjoint(view_b))


class _Terms:
    """The gathers of one arm, from the weights (j, line, block) of its crossings and their first frames."""

    def __init__(
        self, weights: NDArray[np.int64], first: NDArray[np.int64], frames: int, arrays: Arrays
    ) -> None:
        count, _, blocks = weights.shape
        # beyond the last frame the weights are 0, but an index must be valid
        frame = np.minimum(first + np.arange(count)[:, None, None], frames - 1)
        self._xp, self._blocks = arrays.xp, blocks
        voxel = frame * blocks + np.arange(blocks)
        self._forward = [
            (arrays.indices(index.ravel()), arrays.asarray(weight[:, :, None]))
            for index, weight in zip(voxel, weights, strict=True)
        ]
        self._adjoint = [
            (arrays.indices(index.ravel()), arrays.asarray(weight[:, :, None]))
            for index, weight in zip(*_transposed(weights, frame, frames), strict=True)
        ]

    def shear(self, voxels: Array) -> Array:
        """(frame, block, column) → (line, column)."""
        flat = self._xp.reshape(voxels, (-1, voxels.shape[2]))
        return self._xp.sum(self._gather(flat, self._forward), axis=1)

    def unshear(self, spread: Array) -> Array:
        """(line, column) → (frame, block, column)."""
        return self._gather(spread, self._adjoint)

    def _gather(self, rows: Array, terms: list[tuple[Array, Array]]) -> Array:
        shape = (-1, self._blocks, rows.shape[1])
        parts = (
            weight * self._xp.reshape(self._xp.take(rows, index, axis=0), shape) for index, weight in terms
        )
        total = next(parts)
        for part in parts:
            total += part
        return total


def _crossings(
    geometry: Geometry,
    code: NDArray[np.uint8],
    starts: NDArray[np.int64],
    lengths: NDArray[np.int64],
    temporal_merge: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return Σ m(d)·E(t) by frame (j, line, block), and the frame of j = 0 (line, block)."""
    S = geometry.substeps
    begins = S * np.arange(geometry.lines)[:, None] + starts
    first, steps = begins // temporal_merge, int(lengths.max()) + S - 1
    weights = np.zeros(((steps - 1) // temporal_merge + 2, *begins.shape), np.int64)
    line, block = np.indices(begins.shape)
    for d in range(steps):
        # a shorter last block has fewer steps: the others get multiplicity 0, at any valid sub-step
        multiplicity = np.clip(np.minimum(min(d + 1, S), np.minimum(lengths, lengths + S - 1 - d)), 0, None)
        t = np.minimum(begins + d, geometry.span - 1)
        weights[t // temporal_merge - first, line, block] += multiplicity * code[t]
    return weights, first


def _transposed(
    weights: NDArray[np.int64], frame: NDArray[np.int64], frames: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the lines (k, frame, block) that meet a frame in a block, and their weights."""
    _, lines, blocks = weights.shape
    # nonzero and the masks list the crossings in one order, C order of (j, line, block)
    _, line, block = np.nonzero(weights)
    where, weight = frame[weights > 0], weights[weights > 0]
    first = np.full((frames, blocks), lines)
    np.minimum.at(first, (where, block), line)
    k = line - first[where, block]
    padded = np.zeros((int(k.max(initial=0)) + 1, frames, blocks), np.int64)
    padded[k, where, block] = weight
    # where fewer lines meet a frame, or none does, the padding is weight 0 at any valid line
    index = np.minimum(first + np.arange(len(padded))[:, None, None], lines - 1)
    return index, padded
