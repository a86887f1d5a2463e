"""Samples kept from a solver to judge it: blocks of lines and pixels, not single samples.

Line i ± 1 shares (n − S)/n of its light with line i, so that a single sample is told by its neighbours
whatever the video is: predicting it is interpolation. Inside a block there are no such neighbours, and what
predicts it is the scene.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

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
        raise UsageError(f"held-out share {share}", possible="0 to 0.5")
    if lines < 1 or pixels < 1:
        raise UsageError(f"held-out blocks of {lines} lines × {pixels} pixels", possible="1 or more of each")
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
