"""One budget of wall time for a whole request: kept, shared, or refused before anything is written.

Each task gets a deadline: the remaining time is shared evenly among the remaining tasks. A worker that starts
late has that much less time. A request that cannot be met at all is refused. If the machine becomes busy and
the budget runs out, the video ends with the sub-segments solved so far.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

from acquire.cores import slowness
from acquire.errors import UsageError
from acquire.recon.feasibility import OVERRUN_S, OVERRUN_SHARE, least_seconds
from acquire.reconstruct.work import LEAST_BUDGET_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from acquire.geometry import Geometry
    from acquire.reconstruct.work import Task

WRITING_S, WRITING_S_PER_VOXEL = 0.25, 1e-7
"""Time to finish a video, and to compress and write a voxel, on an idle core; the latter is then measured."""
KINDS = 4
"""Kinds of sub-segments whose shortest time is measured; any others count like the slowest of these."""


class Budget:
    """The time left of ``seconds`` from ``began`` (`time.monotonic`) on; unlimited if ``seconds`` is None."""

    def __init__(self, seconds: float | None, began: float, workers: int) -> None:
        self.seconds, self._began, self._workers = seconds, began, workers
        self._compiled_s = 0.0
        # Measuring it occupies a core for a few hundredths of a second.
        self._slowness = 1.0 if seconds is None else slowness()
        self._writing_s_per_voxel = WRITING_S_PER_VOXEL * self._slowness

    @property
    def elapsed_s(self) -> float:
        """Wall time so far, without the time for compiling."""
        return time.monotonic() - self._began - self._compiled_s

    @property
    def left_s(self) -> float:
        """Time left for solving and writing, before the video is finished."""
        assert self.seconds is not None
        return self.seconds - self.elapsed_s - WRITING_S * self._slowness

    @property
    def exhausted(self) -> bool:
        """Whether no further task should be started."""
        return self.seconds is not None and self.left_s <= 0

    def check(self, tasks: Sequence[Task], geometry: Geometry) -> None:
        """Raise UsageError unless the shortest time for ``tasks`` fits; ``geometry`` may have any lines."""
        if self.seconds is None:
            return
        known: dict[tuple[int, int, int], float] = {}
        least_s = 0.0
        for task in tasks:
            voxels = task.segment.voxels
            kind = (voxels.spatial_merge, voxels.temporal_merge, task.segment.lines)
            if kind not in known and len(known) < KINDS:
                few = replace(geometry, lines=task.segment.lines)
                known[kind] = least_seconds(few, *kind[:2], task.options.solver)
            least_s += known.get(kind, max(known.values())) + self._writing_s_per_voxel * _voxels(task)
        needed_s = self.seconds - self.left_s + least_s / self._workers
        if needed_s > (1 + OVERRUN_SHARE) * self.seconds + OVERRUN_S:
            what = "this segment needs" if len(tasks) == 1 else f"these {len(tasks)} sub-segments need"
            raise UsageError(
                f"a budget of {self.seconds:g} s cannot be kept: {what} at least {needed_s:.2g} s here",
                possible="--budget with more, fewer lines, larger voxels, or a machine that is less busy",
            )

    def limit(self, task: Task, undone: int, after: int) -> Task:
        """Return the task with its deadline; ``undone`` tasks are left in all, ``after`` of them after it."""
        if self.seconds is None:
            return task
        # What is left is divided by the number of tasks that each worker still has to do.
        share_s = self.left_s / -(-undone // self._workers)
        # The tasks after this one keep their shares, and its frames have to be written.
        until_s = self.left_s - after // self._workers * share_s - self._writing_s_per_voxel * _voxels(task)
        options = replace(task.options, budget_s=max(share_s, LEAST_BUDGET_S))
        return replace(task, options=options, due=time.monotonic() + max(until_s, LEAST_BUDGET_S))

    def written(self, voxels: int, seconds: float, compiled_s: float) -> None:
        """Account for ``voxels`` written in ``seconds``, of a part that compiled for ``compiled_s``."""
        if voxels:
            # It is at most halved, so that a single quick write does not make all others look quick.
            self._writing_s_per_voxel = max(seconds / voxels, self._writing_s_per_voxel / 2)
        self._compiled_s += compiled_s / self._workers  # all workers compile at the same time


def _voxels(task: Task) -> int:
    grid = task.grid
    frames = grid.frames_of(task.segment)
    return int(frames.stop - frames.start) * grid.side**2
