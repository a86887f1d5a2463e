"""Held-out samples, by which a solver is judged: blocks of lines and pixels, not single samples.

Line i ± 1 shares (n − S)/n of its light with line i, so that its neighbours predict a single sample whatever
the video is: that is interpolation. Inside a block there are no such neighbours, and only the scene predicts
it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import label

from acquire.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.geometry import Geometry
    from acquire.recon.problem import Problem

BLOCK_LINES, BLOCK_PIXELS = 24, 4
FEWEST_BLOCKS = 8
"""Fewer blocks are not significant: those of a small segment are made smaller until there are as many."""


def held_out_blocks(
    usable: NDArray[np.bool_],
    share: float,
    seed: int,
    lines: int = BLOCK_LINES,
    pixels: int = BLOCK_PIXELS,
) -> NDArray[np.bool_]:
    """Draw usable samples in blocks of ``lines`` × ``pixels`` that hold about ``share`` of all: (2, L_R, M).

    Each arm is tiled from a random origin of its own, and its tiles are drawn by ``seed``. No sample is held
    out for a share of 0, or if it amounts to less than single samples would.

    Raises UsageError if the share is not in [0, 0.5], or a side of the blocks is not positive.
    """
    if not 0 <= share <= 0.5:
        raise UsageError(f"the held-out share cannot be {share}", possible="0 to 0.5")
    if lines < 1 or pixels < 1:
        raise UsageError(
            f"held-out blocks cannot have {lines} lines × {pixels} pixels", possible="1 or more of each"
        )
    rng = np.random.default_rng(seed)
    # Halve the longer side until there are enough blocks.
    while lines * pixels > 1 and usable.size * share < FEWEST_BLOCKS * lines * pixels:
        lines, pixels = (-(-lines // 2), pixels) if lines >= pixels else (lines, -(-pixels // 2))
    drawn: list[NDArray[np.bool_]] = []
    for arm in usable:
        # There is one more than cover the arm, because the origin is random.
        tiles = [-(-length // side) + 1 for length, side in zip(arm.shape, (lines, pixels), strict=True)]
        count = tiles[0] * tiles[1]
        chosen = np.zeros(count, bool)
        # The count is rounded at random, so that the share is right on average even if there are few tiles.
        chosen[rng.permutation(count)[: int(count * share + rng.random())]] = True
        line, pixel = (int(rng.integers(side)) for side in (lines, pixels))
        whole = chosen.reshape(tiles).repeat(lines, axis=0).repeat(pixels, axis=1)
        drawn.append(whole[line : line + arm.shape[0], pixel : pixel + arm.shape[1]])
    return usable & np.stack(drawn)


class HeldOut:
    """Scores predictions of the held-out blocks, each sample weighted by the trusted share of its light.

    The lines at a segment's ends also integrate frames that few lines see: nothing can predict these, and
    they are not shown.
    """

    def __init__(self, problem: Problem, geometry: Geometry) -> None:
        mask = problem.held_out
        labels = [label(arm)[0] for arm in mask]
        # Blocks are numbered through both arms.
        labels[1] = np.where(labels[1] > 0, labels[1] + labels[0].max(), 0)
        self._block = np.stack(labels)[mask]
        self._samples = problem.samples[mask].astype(np.float64)
        trusted, share = geometry.trusted_frames(1), np.ones(geometry.lines)
        if trusted.start < trusted.stop:  # otherwise no sub-step is trusted, and all lines count alike
            first = np.arange(geometry.lines) * geometry.substeps
            length = geometry.size + geometry.substeps - 1
            overlap = np.minimum(first + length, trusted.stop) - np.maximum(first, trusted.start)
            share = np.maximum(overlap, 0) / length
        self._weight = np.broadcast_to(share[:, None], mask.shape)[mask]
        self._mask = mask
        self._level = float(np.sum(self._weight * self._samples**2))

    def __bool__(self) -> bool:
        """Whether there are held-out samples with light."""
        return self._level > 0

    def errors(self, predicted: NDArray[Any]) -> NDArray[np.float64]:
        """Weighted sum of squared errors of each block."""
        squares = self._weight * (predicted[self._mask] - self._samples) ** 2
        # Label 0 is what lies between the blocks.
        return np.asarray(np.bincount(self._block, squares)[1:], np.float64)

    def relative(self, errors: NDArray[np.float64]) -> float:
        """Relative RMS error over all blocks."""
        return float(np.sqrt(errors.sum() / self._level)) if self._level > 0 else float("nan")

    def clearly_less(self, errors: NDArray[np.float64], others: NDArray[np.float64]) -> bool:
        """Whether ``errors`` are smaller by more than the standard error of the blocks' differences."""
        less = others - errors
        return bool(less.mean() > less.std() / max(len(less) - 1, 1) ** 0.5)
