"""The tile behind a fibre whose lines show most, for what is looked at on one tile and told of all.

A scene at rest is seen as a convolution of each pixel's profile with the code, which its lines determine
where they are more than n + S − 1. What that leaves beyond the noise is what changes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.calibrate import calibrated

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from acquire.calibrate import Calibration
    from acquire.fibre import Tile
    from acquire.lines import Segment
    from acquire.store import Recording

MOST_LINES = 4
"""Of a tile that are looked at, in n."""
SPARE_LINES = 1.25
"""Lines beside the unknowns of a scene at rest, below which these explain too much of what moves."""
MOVES = 0.05
"""Of the noise, by which what a scene at rest leaves must exceed it: less is rounding."""


def speaker(
    recording: Recording,
    tiles: Sequence[Tile],
    stretch: tuple[int, int],
    calibration: Calibration | None = None,
    *,
    moving: bool = True,
) -> Tile | None:
    """The tile that a look at one speaks for, of those asked for (none: all of a recording); None without a
    fibre. ``stretch``: first line and number of lines."""
    if recording.fibre is None:
        return None
    asked = tuple(tiles) or recording.fibre.tiles
    if len(asked) == 1:
        return asked[0]
    return liveliest(
        recording,
        asked,
        stretch,
        lambda lines: lines if calibration is None else calibrated(lines, calibration),
        moving=moving,
    )


def liveliest(
    recording: Recording,
    tiles: Sequence[Tile],
    stretch: tuple[int, int],
    read: Callable[[Segment], Segment],
    *,
    moving: bool,
) -> Tile:
    """The tile in the middle of whose ``stretch`` of lines, as they are ``read``, most changes; without
    ``moving``, or where nothing changes, that of most contrast."""
    (first, count), size = stretch, recording.geometry_for(1).size
    most = min(count, MOST_LINES * size)
    begin = first + (count - most) // 2
    seen = [energies(read(recording.cut(begin, most, tile))) for tile in tiles]
    contrast, change = (np.array(each) for each in zip(*seen, strict=True))
    return tiles[int(np.argmax(change if moving and (change > 0).any() else contrast))]


def energies(segment: Segment) -> tuple[float, float]:
    """Mean square of a segment's lines about their mean, and of what no scene at rest explains of them, both
    without the noise; 0 where there is no more than that, or where lines are too few."""
    geometry, samples = segment.geometry, segment.samples(np.float64)
    variance = segment.variance()
    unknowns = geometry.size + geometry.substeps - 1
    contrast, left, noise = 0.0, 0.0, 0.0
    design = _windows(segment.code, geometry.substeps, geometry.lines, unknowns)
    for arm, (lines, mask) in enumerate(zip(samples, segment.mask, strict=True)):
        pixels = mask.mean(axis=0) > 0.5  # columns that see nothing are masked throughout
        rows = mask[:, pixels].all(axis=1)
        good = lines[np.ix_(rows, pixels)]
        if not good.size:
            continue
        contrast += float(good.var(axis=0).mean())
        if variance is not None:
            noise += float(variance[arm][np.ix_(rows, pixels)].mean())
        if len(good) > SPARE_LINES * unknowns:
            fitted, *_ = np.linalg.lstsq(design[rows], good, rcond=None)
            off = good - design[rows] @ fitted
            left += float(np.square(off).sum() / ((len(good) - unknowns) * good.shape[1]))
    change = left - noise
    return max(0.0, contrast - noise), change if change > MOVES * noise else 0.0


def _windows(code: NDArray[Any], substeps: int, lines: int, length: int) -> NDArray[np.float64]:
    """The code that each line saw, sub-step by sub-step: (line, length)."""
    whole = np.lib.stride_tricks.sliding_window_view(code, length)
    return whole[: lines * substeps : substeps].astype(np.float64)
