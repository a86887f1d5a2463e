"""One budget of wall time for all that is asked for: kept, shared, or refused before anything is written.

Each task is given the moment at which it is to be done: what is left, evenly over what is left to solve. A
worker that starts late has that much less time. What cannot be done in time at all is refused; what turns out
not to be, because the machine became busy, ends with the sub-segments that are there.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

from acquire.cores import slowness
from acquire.errors import UsageError
from acquire.recon.feasibility import MARGIN, MARGIN_S, least_seconds
from acquire.reconstruct.work import LEAST_BUDGET_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from acquire.geometry import Geometry
    from acquire.reconstruct.work import Task

WRITING_S, WRITING_S_PER_VOXEL = 0.25, 1e-7
"""To finish a video and end, and to compress and write a voxel, on a core of its own; then as measured."""
KINDS = 4
"""So many kinds of sub-segments are measured to find out the least; others are taken to be like the last."""


class Budget:
    """What is left of ``seconds`` after ``began`` (`time.monotonic`); None: all the time in the world."""

    def __init__(self, seconds: float | None, began: float, workers: int) -> None:
        self.seconds, self._began, self._workers = seconds, began, workers
        self._compiled_s = 0.0
        self._slowness = 1.0 if seconds is None else slowness()
        self._writing_s_per_voxel = WRITING_S_PER_VOXEL * self._slowness

    @property
    def elapsed_s(self) -> float:
        """Wall time, without what compiling took."""
        return time.monotonic() - self._began - self._compiled_s

    @property
    def left_s(self) -> float:
        """To solve and write in, before the video is finished."""
        assert self.seconds is not None
        return self.seconds - self.elapsed_s - WRITING_S * self._slowness

    @property
    def gone(self) -> bool:
        """Nothing is to be begun any more."""
        return self.seconds is not None and self.left_s <= 0

    def check(self, tasks: Sequence[Task], geometry: Geometry) -> None:
        """UsageError unless the least that ``tasks`` take fits; ``geometry`` is that of any lines."""
        if self.seconds is None:
            return
        needed_s = self.seconds - self.left_s + self._least_s(tasks, geometry)
        if needed_s > (1 + MARGIN) * self.seconds + MARGIN_S:
            what = "this segment needs" if len(tasks) == 1 else f"these {len(tasks)} sub-segments need"
            raise UsageError(
                f"a budget of {self.seconds:g} s cannot be kept: {what} at least {needed_s:.2g} s here",
                possible="--budget with more, fewer lines, larger voxels, or a machine that is less busy",
            )

    def limit(self, task: Task, undone: int, after: int) -> Task:
        """The task with the moment when it is to be done; ``undone`` are, ``after`` of them after it."""
        if self.seconds is None:
            return task
        share_s = self.left_s / -(-undone // self._workers)
        until_s = self.left_s - after // self._workers * share_s - self._writing_s_per_voxel * _voxels(task)
        options = replace(task.options, budget_s=max(share_s, LEAST_BUDGET_S))
        return replace(task, options=options, due=time.monotonic() + max(until_s, LEAST_BUDGET_S))

    def written(self, voxels: int, seconds: float, compiled_s: float) -> None:
        """So many voxels were stitched and written in that time, of a part that compiled for so long."""
        if voxels:
            self._writing_s_per_voxel = max(seconds / voxels, self._writing_s_per_voxel / 2)
        self._compiled_s += compiled_s / self._workers  # all of them compile at the same time

    def _least_s(self, tasks: Sequence[Task], geometry: Geometry) -> float:
        known: dict[tuple[int, int, int], float] = {}
        total_s = 0.0
        for task in tasks:
            voxels = task.segment.voxels
            kind = (voxels.spatial_merge, voxels.temporal_merge, task.segment.lines)
            if kind not in known and len(known) < KINDS:
                few = replace(geometry, lines=task.segment.lines)
                known[kind] = least_seconds(few, *kind[:2], task.options.solver)
            total_s += known.get(kind, max(known.values())) + self._writing_s_per_voxel * _voxels(task)
        return total_s / self._workers


def _voxels(task: Task) -> int:
    grid = task.grid
    frames = grid.frames_of(task.segment)
    return int(frames.stop - frames.start) * grid.side**2
