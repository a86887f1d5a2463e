"""Choice of voxels by the tempo of the scene, from tentative reconstructions (Section 4 of the paper).

The scene is first assumed to be at rest, so that all samples go to fine pixels. If a still does not explain
the lines, shorter and shorter frames are tried, as long as each explains the held-out samples clearly better
than the last.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from acquire.recon.api import reconstruct
from acquire.recon.segments import Voxels

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.lines import Segment

TEMPORAL_MERGES = (64, 16, 4, 1)
TEMPO_ITERATIONS = 40
BETTER = 1.25
"""Factor by which shorter frames must explain the lines better to be chosen: they cost accuracy elsewhere."""
GOOD_ENOUGH = 0.015
"""Relative error below which nothing shorter is tried."""


@dataclass(frozen=True, slots=True)
class Tempo:
    """The voxels for a range; ``tried`` holds (T_m, relative error), with T_m 0 for a still."""

    voxels: Voxels
    tried: tuple[tuple[int, float], ...]

    @property
    def why(self) -> str:
        """The reason in words."""
        words = ", ".join(
            f"{'a still' if merge == 0 else f'T_m {merge}'} {error:.1%}" for merge, error in self.tried
        )
        return f"unseen samples are predicted with errors of: {words}"


def tempo(
    segment: Segment, progress: Callable[[float], object] | None = None, side: int | None = None
) -> Tempo:
    """Find out how fast a segment changes, from its lines alone; ``progress`` receives the share that is
    done.

    ``side`` is the side of voxels for a moving scene, in fine pixels; S if None.
    """
    most = 1 + len(TEMPORAL_MERGES)

    def done() -> None:
        if progress is not None:
            progress(len(tried) / most)

    geometry = segment.geometry
    # S fine pixels are one pixel of the camera.
    side = min(side or geometry.substeps, geometry.size)
    still = _error(segment, Voxels(1, geometry.span))
    tried = [(0, still)]
    done()
    best, chosen = still, Voxels(1, geometry.span)
    for merge in TEMPORAL_MERGES:
        if best <= GOOD_ENOUGH:
            break
        error = _error(segment, Voxels(side, merge))
        tried.append((merge, error))
        done()
        if error * BETTER <= best:
            best, chosen = error, Voxels(side, merge)
        # Light that is faster than the long frames makes those no better than a still: until one beats the
        # still, shorter ones may.
        elif chosen.temporal_merge < geometry.span:
            break
    return Tempo(chosen, tuple(tried))


def _error(segment: Segment, voxels: Voxels) -> float:
    # Only the prediction counts: an estimate of the video's error would take up to 30 more iterations.
    quality = reconstruct(
        segment,
        voxels.spatial_merge,
        voxels.temporal_merge,
        "fast",
        iterations=TEMPO_ITERATIONS,
        check=False,
        error=False,
    ).quality
    # Very few lines have no held-out samples.
    return quality.misfit if np.isnan(quality.prediction) else quality.prediction
