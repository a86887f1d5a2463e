"""Combinatorial reconstruction: sub-segments solved side by side, stitched in order, written as they come."""

from __future__ import annotations

import time
from collections import deque
from concurrent.futures import CancelledError, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire import __version__
from acquire.calibrate.choose import provenance
from acquire.errors import AcquireError
from acquire.recon.diagnosis import TURNED
from acquire.recon.segments import Stitcher
from acquire.reconstruct.budget import Budget
from acquire.reconstruct.times import Times
from acquire.reconstruct.work import Task
from acquire.store import VideoGrid, VideoWriter
from acquire.store.remote import is_url

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from concurrent.futures import Future
    from pathlib import Path

    from acquire.recon.segments import Grid, SubSegment
    from acquire.reconstruct.pools import Pool
    from acquire.reconstruct.select import VideoRequest
    from acquire.reconstruct.work import Options, Part
    from acquire.store import Recording

LOOK_S = 0.1
"""How often the one who waits looks at the progress and at Ctrl-C."""
QUALITY_KEYS = ("misfit", "prediction", "coverage", "noise")


@dataclass(frozen=True, slots=True)
class Outcome:
    """What was written. ``interrupted``: less than what was asked for; ``cut``: likewise, by the budget."""

    path: Path | str
    shape: tuple[int, int, int]
    interrupted: bool
    provenance: dict[str, Any]
    cut: bool = False


class Watcher:
    """Passes the progress on, and says when to stop: ``stopped`` once it was.

    ``progress`` takes (tasks done, of how many); ``stop`` is asked often and answers at once.
    """

    def __init__(
        self,
        tasks: int,
        progress: Callable[[float, int], object] | None = None,
        stop: Callable[[], bool] | None = None,
    ) -> None:
        self.tasks, self._progress, self._stop = tasks, progress, stop
        self.stopped = False

    def __call__(self, done: float) -> bool:
        if self._progress is not None:
            self._progress(done, self.tasks)
        if self._stop is not None and self._stop():
            self.stopped = True
        return self.stopped


def combine(
    recording: Recording,
    request: VideoRequest,
    out: Path | str,
    options: Options,
    pool: Pool,
    watcher: Watcher,
    began: float | None = None,
) -> Outcome:
    """Reconstruct the stretches of a request and write their video.

    ``out`` is a new path or URL. When the watcher says stop, what was solved so far is written, marked as
    interrupted; DataError and whatever a sub-segment raises leave nothing. The options' budget is wall time
    from ``began`` (`time.monotonic`; else now) to the video's end; UsageError where it cannot be kept.
    """
    called, grid = time.monotonic(), request.grid
    segments = request.sub_segments()
    place = str(recording) if is_url(str(recording)) else str(recording.path.resolve())
    tasks = [Task(place, segment, grid, options) for segment in segments]
    budget = Budget(options.budget_s, called if began is None else began, pool.workers)
    budget.check(tasks, request.stream.geometry(1))
    times, anchor = Times.of(recording), _anchor(recording, request)
    stitcher = Stitcher(grid)
    solved: list[SubSegment] = []
    done: list[dict[str, Any]] = []
    with VideoWriter(
        out,
        (grid.side, grid.side),
        np.dtype(np.float32),
        _place(times, grid),
        quality=True,
    ) as writer:
        for part, task, following in _solved(tasks, pool, watcher, budget):
            arrived = time.monotonic()
            video, error = stitcher.add(task.segment, (part.video, part.error), following)
            if len(video):
                begins = grid.edges(slice(writer.frames, writer.frames + len(video)))[:-1]
                writer.append(video, times.utc_ns(begins, anchor), error)
            budget.written(video.size, time.monotonic() - arrived, part.facts["compiled_s"])
            solved.append(task.segment)
            done.append(part.facts)  # not the part: memory must not grow with the stream
        if not done:
            raise KeyboardInterrupt  # there is nothing to keep
        facts = describe_parts(recording, request, done, options)
        cut = len(done) < len(tasks) and not watcher.stopped
        facts["state"] = "interrupted" if cut or watcher.stopped else "complete"
        facts["seconds"] = round(time.monotonic() - called, 3)
        whole = _whole_stretch([(each, part["trusted"]) for each, part in zip(solved, done, strict=True)])
        facts["trusted"] = _trusted_frames(request, writer.frames, whole)
        writer.finish(facts)
    return Outcome(out, (writer.frames, grid.side, grid.side), watcher.stopped, facts, cut)


def _place(times: Times, grid: Grid) -> VideoGrid:
    """Where the voxels lie: in pixels of the scene at full resolution, and seconds after the first line."""
    side, begin_s = grid.voxels.spatial_merge, (grid.begin - times.first_substep) * times.substep_ns * 1e-9
    step = (times.substep_ns * grid.voxels.temporal_merge * 1e-9, float(side), float(side))
    return VideoGrid(step, (begin_s, (side - 1) / 2, (side - 1) / 2), None)


def _solved(
    tasks: Sequence[Task], pool: Pool, watcher: Watcher, budget: Budget
) -> Iterator[tuple[Part, Task, SubSegment | None]]:
    """Solved tasks in order, each with the sub-segment after it, until the watcher or budget ends it."""
    submitted = 0
    waiting: deque[Future[Part]] = deque()
    for index, task in enumerate(tasks):
        while submitted < len(tasks) and len(waiting) <= pool.workers and not watcher.stopped:
            if submitted and budget.gone:
                break
            after = len(tasks) - submitted - 1
            undone = after + 1 + sum(not each.done() for each in waiting)
            waiting.append(pool.submit(budget.limit(tasks[submitted], undone, after)))
            submitted += 1
        if not waiting or (part := _result(waiting, pool, watcher)) is None:
            return
        yield part, task, tasks[index + 1].segment if index + 1 < len(tasks) else None


def _result(waiting: deque[Future[Part]], pool: Pool, watcher: Watcher) -> Part | None:
    """The first of those that wait; None when it was cancelled."""
    future = waiting.popleft()
    try:
        while not wait([future], LOOK_S).done:
            if watcher(pool.share_done()):
                pool.stop()
                for each in (future, *waiting):
                    each.cancel()
        watcher(pool.share_done())
        return future.result()
    except CancelledError:
        return None
    except BrokenProcessPool as error:
        raise AcquireError(
            "a process that solved a sub-segment ended by itself", hint="--workers 1: it may lack memory"
        ) from error


def _anchor(recording: Recording, request: VideoRequest) -> tuple[int, int]:
    """The sub-step at which the read-out of the stream's first line begins, and its UTC in ns."""
    stream = request.stream
    row = stream.first_line - recording.first_line
    read_out_ns = int(recording.arms["a"].read("time", row, row + 1)[0])
    return stream.substeps * stream.first_line + stream.geometry(1).readout_substep, read_out_ns


def describe_parts(
    recording: Recording, request: VideoRequest, parts: Sequence[dict[str, Any]], options: Options
) -> dict[str, Any]:
    """Where the video comes from and how good it is, as JSON: as a whole, and each sub-segment."""
    names, reasons = request.names or ("",) * len(parts), request.reasons or ("",) * len(parts)
    segments = [
        {"name": name, "why": why, **part} for name, why, part in zip(names, reasons, parts, strict=False)
    ]
    voxels = request.grid.voxels
    return {
        "recording": str(recording),
        "run_id": recording.attrs["run_id"],
        "first_line": min(part["first_line"] for part in parts),
        "lines": max(part["first_line"] + part["lines"] for part in parts)
        - min(part["first_line"] for part in parts),
        "first_substep": request.grid.begin,
        "spatial_merge": voxels.spatial_merge,
        "temporal_merge": voxels.temporal_merge,
        "solver": options.solver,
        "solver_options": dict(options.solver_options),
        "denoiser": options.denoiser,
        "preset": options.preset,
        "dtype": options.dtype,
        "device": options.device,
        "budget_s": options.budget_s,
        "iterations": sum(part["iterations"] for part in parts),
        "iterations_asked": sum(part["iterations_asked"] for part in parts),
        "compiled_s": round(max(part["compiled_s"] for part in parts), 3),
        "quality": {key: _rms([part["quality"][key] for part in parts]) for key in QUALITY_KEYS},
        "segments": segments,
        "segments_asked": len(request.stretches),
        "calibration": provenance(options.calibration),
        "turned": TURNED.get(options.turn),
        "versions": {"acquire": __version__},
    }


def _rms(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known else None


def _whole_stretch(segments: Sequence[tuple[SubSegment, bool]]) -> tuple[int, int]:
    """The longest run of sub-segments that are trusted, in sub-steps, without what fades into others."""
    runs = [[each for each, _ in run] for trusted, run in groupby(segments, itemgetter(1)) if trusted]
    first, last = segments[0][0], segments[-1][0]
    found = [
        (
            run[0].begin + (0 if run[0] is first else run[0].fade_in),
            run[-1].end - (0 if run[-1] is last else run[-1].fade_out),
        )
        for run in runs
    ]
    return max(found, key=lambda edges: edges[1] - edges[0], default=(first.begin, first.begin))


def _trusted_frames(request: VideoRequest, frames: int, whole: tuple[int, int]) -> list[int]:
    """First frame that is sampled in full, of a trusted sub-segment, and the one after the last."""
    T_m, begin = request.grid.voxels.temporal_merge, request.grid.begin
    low, high = (
        edge - begin for edge in (max(request.trusted[0], whole[0]), min(request.trusted[1], whole[1]))
    )
    stop = -(-high // T_m) if begin + high >= request.grid.end else high // T_m
    first = min(frames, -(-low // T_m))
    return [first, max(first, min(frames, stop))]
