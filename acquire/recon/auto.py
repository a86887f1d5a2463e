"""Voxels without the truth: how slow a stretch is, by tentative reconstruction (Section 4 of the paper).

A stretch is first taken to be at rest, which leaves all its samples to fine pixels. If this does not explain
the lines, shorter and shorter frames are tried, as long as each explains them clearly better than the last.
Explained are samples that the solver does not see.
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
ITERATIONS = 40
BETTER = 1.25
"""Shorter frames have to explain the lines so much better to be taken: they cost accuracy elsewhere."""
EXPLAINED = 0.015
"""Relative error at which nothing shorter is tried."""


@dataclass(frozen=True, slots=True)
class Tempo:
    """The voxels for a stretch; ``tried`` holds (T_m, relative error), with T_m 0 for a still."""

    voxels: Voxels
    tried: tuple[tuple[int, float], ...]

    @property
    def why(self) -> str:
        """For people."""
        words = ", ".join(
            f"{'a still' if merge == 0 else f'T_m {merge}'} {error:.1%}" for merge, error in self.tried
        )
        return f"unseen samples are predicted with an error of: {words}"


def tempo(
    segment: Segment, progress: Callable[[float], object] | None = None, side: int | None = None
) -> Tempo:
    """How fast a segment changes, from its lines alone; ``progress`` takes the share of it that is done.

    ``side`` is that of the voxels of what moves, in fine pixels; None: S.
    """
    most = 1 + len(TEMPORAL_MERGES)

    def done() -> None:
        if progress is not None:
            progress(len(tried) / most)

    geometry = segment.geometry
    side = min(side or geometry.substeps, geometry.size)
    still = _error(segment, Voxels(1, geometry.span))
    tried = [(0, still)]
    done()
    best, chosen = still, Voxels(1, geometry.span)
    for merge in TEMPORAL_MERGES:
        if best <= EXPLAINED:
            break
        error = _error(segment, Voxels(side, merge))
        tried.append((merge, error))
        done()
        if error * BETTER <= best:
            best, chosen = error, Voxels(side, merge)
        elif chosen.temporal_merge < geometry.span:
            break
    return Tempo(chosen, tuple(tried))


def _error(segment: Segment, voxels: Voxels) -> float:
    quality = reconstruct(
        segment, voxels.spatial_merge, voxels.temporal_merge, "fast", iterations=ITERATIONS, check=False
    ).quality
    return quality.misfit if np.isnan(quality.prediction) else quality.prediction
