"""How far each frame can be believed, without the truth: how well the lines that see it are predicted."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.forward import DualArm

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.lines import Segment


def frame_error(
    segment: Segment, video: NDArray[Any], spatial_merge: int, temporal_merge: int
) -> NDArray[np.float32]:
    """RMS residual over RMS signal of the lines that expose each frame (T/T_m,); NaN where none is usable.

    A line is exposed for n + S − 1 sub-steps: what happens in one frame shows in its neighbours' too.
    """
    geometry = segment.geometry
    operator = DualArm(geometry, segment.code, spatial_merge, temporal_merge)
    usable = segment.mask & np.isfinite(segment.lines)
    samples = np.where(usable, segment.samples(np.float32), 0)
    residual = np.where(usable, operator.forward(video.astype(np.float32, copy=False)) - samples, 0)
    first, end = _exposing(geometry.substeps, geometry.size, geometry.lines, len(video), temporal_merge)
    error, level = (_between(np.square(each, dtype=np.float64), first, end) for each in (residual, samples))
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio: NDArray[np.float32] = np.sqrt(error / level).astype(np.float32)
    return np.where(np.isfinite(ratio), ratio, np.float32(np.nan))


def _exposing(
    substeps: int, size: int, lines: int, frames: int, temporal_merge: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First line that is exposed during each frame, and the one after the last."""
    begin = np.arange(frames) * temporal_merge
    first = -((size + substeps - 2 - begin) // substeps)
    end = (begin + temporal_merge - 1) // substeps + 1
    return np.clip(first, 0, lines - 1), np.clip(end, 1, lines)


def _between(
    squares: NDArray[np.float64], first: NDArray[np.int64], end: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Sum over the arms, the pixels and the lines ``first`` to ``end``."""
    summed = np.concatenate([[0.0], np.cumsum(squares.sum(axis=(0, 2)))])
    total: NDArray[np.float64] = summed[end] - summed[first]
    return total
