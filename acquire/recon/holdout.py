"""Samples kept from a solver to judge it: blocks of lines and pixels, not single samples.

Line i ± 1 shares (n − S)/n of its light with line i, so that a single sample is told by its neighbours
whatever the video is: predicting it is interpolation. Inside a block there are no such neighbours, and what
predicts it is the scene.
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
"""Fewer say too little: blocks of a small segment are made smaller until there are as many."""


def held_out_blocks(
    usable: NDArray[np.bool_],
    share: float,
    seed: int,
    lines: int = BLOCK_LINES,
    pixels: int = BLOCK_PIXELS,
) -> NDArray[np.bool_]:
    """Usable samples in blocks of ``lines`` × ``pixels`` that hold about ``share`` of all: (2, L_R, M).

    Both arms are tiled, each from an origin of its own, and tiles drawn by ``seed``. None for a share of 0,
    nor where so few would be drawn that not even single samples make it up.
    """
    if not 0 <= share <= 0.5:
        raise UsageError(f"the held-out share cannot be {share}", possible="0 to 0.5")
    if lines < 1 or pixels < 1:
        raise UsageError(
            f"held-out blocks cannot have {lines} lines × {pixels} pixels", possible="1 or more of each"
        )
    rng = np.random.default_rng(seed)
    size = _fitting(usable.size * share, lines, pixels)
    drawn = np.stack([_drawn(arm.shape, size, share, rng) for arm in usable])
    return usable & drawn


def _fitting(samples: float, lines: int, pixels: int) -> tuple[int, int]:
    """The block's size, halved along its longer side until enough blocks make up so many samples."""
    while lines * pixels > 1 and samples < FEWEST_BLOCKS * lines * pixels:
        lines, pixels = (-(-lines // 2), pixels) if lines >= pixels else (lines, -(-pixels // 2))
    return lines, pixels


def _drawn(
    shape: tuple[int, ...], size: tuple[int, int], share: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """One arm's tiles of ``size``, each drawn with probability ``share``, spread as evenly as a shuffle."""
    tiles = [-(-length // side) + 1 for length, side in zip(shape, size, strict=True)]
    count = tiles[0] * tiles[1]
    chosen = np.zeros(count, bool)
    chosen[rng.permutation(count)[: int(count * share + rng.random())]] = True
    begin = [int(rng.integers(side)) for side in size]
    whole = chosen.reshape(tiles).repeat(size[0], axis=0).repeat(size[1], axis=1)
    return whole[begin[0] : begin[0] + shape[0], begin[1] : begin[1] + shape[1]]


class HeldOut:
    """Scores predictions of held-out blocks; samples count as far as the light they saw is trusted.

    The lines at a segment's ends see frames that few lines saw, which nothing can predict and nobody is
    shown.
    """

    def __init__(self, problem: Problem, geometry: Geometry) -> None:
        mask = problem.held_out
        labels = [label(arm)[0] for arm in mask]
        labels[1] = np.where(labels[1] > 0, labels[1] + labels[0].max(), 0)
        self._block = np.stack(labels)[mask]
        self._samples = problem.samples[mask].astype(np.float64)
        self._weight = np.broadcast_to(_trusted_share(geometry)[:, None], mask.shape)[mask]
        self._mask = mask
        self._level = float(np.sum(self._weight * self._samples**2))

    def __bool__(self) -> bool:
        """Whether there is anything to score by."""
        return self._level > 0

    def errors(self, predicted: NDArray[Any]) -> NDArray[np.float64]:
        """Weighted sum of squares of each block."""
        off = self._weight * (predicted[self._mask] - self._samples) ** 2
        return np.asarray(np.bincount(self._block, off)[1:], np.float64)

    def relative(self, errors: NDArray[np.float64]) -> float:
        """Relative RMS error of all blocks."""
        return float(np.sqrt(errors.sum() / self._level)) if self._level > 0 else float("nan")

    def clearly_less(self, errors: NDArray[np.float64], others: NDArray[np.float64]) -> bool:
        """Whether errors are less by more than the standard error of the blocks' difference."""
        less = others - errors
        return bool(less.mean() > less.std() / max(len(less) - 1, 1) ** 0.5)


def _trusted_share(geometry: Geometry) -> NDArray[np.float64]:
    """Of each line's sub-steps, the share in the trusted interval; 1 where no sub-step is trusted."""
    trusted = geometry.trusted_frames(1)
    if trusted.stop <= trusted.start:
        return np.ones(geometry.lines)
    first = np.arange(geometry.lines) * geometry.substeps
    length = geometry.size + geometry.substeps - 1
    seen = np.minimum(first + length, trusted.stop) - np.maximum(first, trusted.start)
    return np.asarray(np.maximum(seen, 0) / length)
