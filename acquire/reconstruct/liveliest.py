"""The tile behind a fibre with the most activity, for whatever is examined on one tile on behalf of all.

A scene at rest appears as a convolution of each pixel's profile with the code, and more than n + S − 1 lines
determine that profile. The residual beyond the noise is due to changes of the scene.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.calibrate import calibrated

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from acquire.calibrate import Calibration
    from acquire.fibre import Tile
    from acquire.lines import Segment
    from acquire.store import Recording

MOST_PASSES = 4
"""Upper limit on the lines of a tile that are examined, in n."""
SPARE_LINES = 1.25
"""Least ratio of lines to unknowns of a scene at rest; below it the fit absorbs too much of the changes."""
MOVES = 0.05
"""Least excess of the residual over the noise, relative to the noise; less is due to rounding."""


def representative_tile(
    recording: Recording,
    tiles: Sequence[Tile],
    stretch: tuple[int, int],
    calibration: Calibration | None = None,
    *,
    moving: bool = True,
) -> Tile | None:
    """Return the tile to examine on behalf of ``tiles`` (if empty, of all); None without a fibre.

    ``stretch`` is the first line and the number of lines.
    """
    if recording.fibre is None:
        return None
    candidates = tuple(tiles) or recording.fibre.tiles
    if len(candidates) == 1:
        return candidates[0]
    return liveliest(
        recording,
        candidates,
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
    """Return the tile that changes most in the middle of a ``stretch`` (first line, number of lines).

    ``read`` prepares the lines. Without ``moving``, or if nothing changes, it is the tile with most contrast.
    """
    (first, count), size = stretch, recording.geometry_for(1).size
    most = min(count, MOST_PASSES * size)
    # The middle is used, and no more than 4·n lines: the fit's design grows with lines × n.
    begin = first + (count - most) // 2
    by_tile = [energies(read(recording.cut(begin, most, tile))) for tile in tiles]
    contrast, change = (np.array(each) for each in zip(*by_tile, strict=True))
    return tiles[int(np.argmax(change if moving and (change > 0).any() else contrast))]


def energies(segment: Segment) -> tuple[float, float]:
    """Return the variance of a segment's lines, and that of their residual to a scene at rest.

    The variance of the noise is subtracted from both. They are means of those arms that have enough complete
    lines for them, so that a tile that lacks an arm's lines is comparable to others. They are 0 if no more
    than the noise remains, or if there are too few lines.
    """
    geometry, samples = segment.geometry, segment.samples(np.float64)
    variance = segment.variance()
    unknowns = geometry.size + geometry.substeps - 1
    # (energy, variance of the noise) of each arm: of its lines, and of their residual
    contrasts: list[tuple[float, float]] = []
    residuals: list[tuple[float, float]] = []
    # (line, unknown): the code that exposed each line, sub-step by sub-step. It is a view, because windows
    # that are S steps apart overlap in nearly all of their bits.
    windows = np.lib.stride_tricks.sliding_window_view(segment.code, unknowns)
    design = windows[: geometry.lines * geometry.substeps : geometry.substeps].astype(np.float64)
    for arm, (lines, mask) in enumerate(zip(samples, segment.mask, strict=True)):
        pixels = mask.mean(axis=0) > 0.5  # columns without light are masked throughout
        # Only complete lines are used, so that one design serves all pixels.
        rows = mask[:, pixels].all(axis=1)
        good = lines[np.ix_(rows, pixels)]
        if not good.size:
            continue
        noise = 0.0 if variance is None else float(variance[arm][np.ix_(rows, pixels)].mean())
        contrasts.append((float(good.var(axis=0).mean()), noise))
        if len(good) > SPARE_LINES * unknowns:
            fitted, *_ = np.linalg.lstsq(design[rows], good, rcond=None)
            unexplained = good - design[rows] @ fitted
            # The energy is per degree of freedom: noise alone gives its variance.
            energy = float(np.square(unexplained).sum() / ((len(good) - unknowns) * good.shape[1]))
            residuals.append((energy, noise))
    return _beyond_noise(contrasts), _beyond_noise(residuals, MOVES)


def _beyond_noise(of_arms: list[tuple[float, float]], least: float = 0.0) -> float:
    """Return the mean energy beyond the noise of the arms in a list, or 0 unless it exceeds a share of it."""
    if not of_arms:
        return 0.0
    energy, noise = np.mean(of_arms, axis=0)
    return float(energy - noise) if energy - noise > least * noise else 0.0
