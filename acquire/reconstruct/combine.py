"""Combinatorial reconstruction: sub-segments solved side by side, stitched in order, written as they come."""

from __future__ import annotations

import time
from collections import deque
from concurrent.futures import CancelledError, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire import __version__
from acquire.calibrate.choose import provenance
from acquire.errors import AcquireError, UsageError
from acquire.flags import NO_IMAGE, LineFlag
from acquire.plugins import DENOISERS, SOLVERS, of_others
from acquire.recon.diagnosis import TURNED
from acquire.recon.error import combined_facts
from acquire.recon.segments import Stitcher
from acquire.recon.unseen import Unseen, longest, remaining, within
from acquire.reconstruct.arms import balance_of_recording
from acquire.reconstruct.budget import Budget
from acquire.reconstruct.sharing import SharedChoices, liveliest_first, sharing_facts
from acquire.reconstruct.sheet import open_sheet
from acquire.reconstruct.work import Task, as_read
from acquire.store.present import flags_of
from acquire.store.remote import is_url

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from concurrent.futures import Future
    from pathlib import Path

    from acquire.fibre import Tile
    from acquire.recon.segments import SubSegment
    from acquire.reconstruct.pools import Pool
    from acquire.reconstruct.select import VideoRequest
    from acquire.reconstruct.work import Options, Part
    from acquire.store import Recording

POLL_S = 0.1
"""Interval at which the waiting thread checks the progress and Ctrl-C."""
QUALITY_KEYS = ("misfit", "prediction", "coverage", "noise")


@dataclass(frozen=True, slots=True)
class Outcome:
    """The written video. ``interrupted``: it was stopped early; ``cut``: the budget ended it early."""

    path: Path | str
    shape: tuple[int, int, int]
    interrupted: bool
    provenance: dict[str, Any]
    cut: bool = False


class Monitor:
    """Forwards the progress and requests the stop; ``stopped`` is set once it was requested.

    ``progress`` takes (tasks done, number of tasks). ``stop`` is called often and must return at once.
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
    *,
    options: Options,
    pool: Pool,
    monitor: Monitor,
    began: float | None = None,
) -> Outcome:
    """Reconstruct the ranges of a request and write their video.

    ``out`` is a new path or URL. Behind a fibre the tiles of the scene are solved one after the other. If the
    monitor requests a stop, the part solved so far is written and marked as interrupted. A DataError, or
    whatever a sub-segment raises, leaves nothing behind. The options' budget is wall time from ``began``
    (`time.monotonic`; the call if None) to the end of the video. Raises UsageError if it cannot be kept, and
    if both arms have lost all lines of a sub-segment, or no sample of them is usable, before anything is
    computed.
    """
    called, grid = time.monotonic(), request.grid
    segments = request.sub_segments()
    _refuse_lost(recording, segments)
    _refuse_unusable(recording, segments, options, request.tiles or (None,))
    location = str(recording) if is_url(str(recording)) else str(recording.path.resolve())
    balance, balance_facts, warnings = balance_of_recording(recording, options)
    options = replace(options, balance=balance)
    sharing = options.chooses and (bool(request.tiles) if options.shared is None else options.shared)
    tiles: Sequence[Tile | None] = request.tiles or (None,)
    # The first tile makes the choice for the others.
    if sharing and len(tiles) > 1:
        tiles = liveliest_first(recording, request, options)
    # A tile's sub-segments follow each other, because they are stitched in order of time.
    tasks = [Task(location, each, grid, options, tile=tile) for tile in tiles for each in segments]
    budget = Budget(options.budget_s, called if began is None else began, pool.workers)
    # Refused before anything is written.
    budget.check(tasks, request.stream.geometry(1))
    done: list[dict[str, Any]] = []
    with open_sheet(out, request, recording) as sheet:
        for part, task, following in _solved(tasks, pool, monitor, budget, SharedChoices(sharing)):
            if len(done) % len(segments) == 0:  # the first sub-segment of a tile
                stitcher = Stitcher(grid)
            arrived, first = time.monotonic(), stitcher.frames
            video, quality, error = stitcher.add(
                task.segment, (part.video, part.quality, part.error), following
            )
            if len(video):
                sheet.take(task.tile, first, video, quality, error)
            budget.written(video.size, time.monotonic() - arrived, part.facts["compiled_s"])
            done.append(part.facts)  # not the part: memory must not grow with the stream
        if not done:
            raise KeyboardInterrupt  # there is nothing to keep
        facts = describe_parts(recording, request, done, options)
        cut = len(done) < len(tasks) and not monitor.stopped
        # Sub-segments repeat each other's warnings word for word: each is kept once, in order.
        warnings = (
            *warnings,
            *_words_on_unseen(request, len(segments), sheet.frames, done),
            *(text for part in done for text in part["warnings"]),
        )
        facts |= {"balance": balance_facts, "warnings": list(dict.fromkeys(warnings))}
        facts["choice"] = sharing_facts(done) if sharing else None
        facts["state"] = "interrupted" if cut or monitor.stopped else "complete"
        facts["seconds"] = round(time.monotonic() - called, 3)
        trusted = _trusted_of_all_tiles(request, segments, done)
        facts["trusted"] = _trusted_frames(request, sheet.frames, trusted)
        sheet.finish(facts)
    return Outcome(out, (sheet.frames, *sheet.shape), monitor.stopped, facts, cut)


def _refuse_lost(recording: Recording, segments: Sequence[SubSegment]) -> None:
    """Raise UsageError if the gaps of both arms hold all lines of one of the sub-segments."""
    begins = np.array([each.first_line - recording.first_line for each in segments])
    ends = begins + np.array([each.lines for each in segments])
    lost = np.ones(len(segments), bool)
    for arm in recording.arms:
        gaps = sorted(recording.lost_rows(arm), key=lambda rows: rows.start)
        # Lines lost before each edge of a gap; in between their number grows with the lines, or not at all.
        edges = [edge for rows in gaps for edge in (rows.start, rows.stop)] or [0]
        before = np.cumsum([0, *(count for rows in gaps for count in (len(rows), 0))])[: len(edges)]
        lost &= np.interp(ends, edges, before) - np.interp(begins, edges, before) >= ends - begins - 0.5
    if lost.any():
        number = int(np.argmax(lost))
        first, lines = segments[number].first_line, segments[number].lines
        raise UsageError(
            f"no video can be made of lines {first} to {first + lines - 1}: both arms have lost all of them",
            possible="lines before them, or after them; acquire info lists what is lost",
        )


def _refuse_unusable(
    recording: Recording, segments: Sequence[SubSegment], options: Options, tiles: Sequence[Tile | None]
) -> None:
    """Raise UsageError if no sample of a sub-segment is usable, such as where both arms are saturated.

    A line that is flagged as saturated may have only one sample at the top of the range: the samples are
    read, which takes longer, only of sub-segments that have no line without such a flag.
    """
    doubtful = NO_IMAGE | LineFlag.SATURATED
    for each in segments:
        row = each.first_line - recording.first_line
        flags = (flags_of(recording, arm, row, row + each.lines) for arm in recording.arms)
        if not all((of_arm & doubtful).all() for of_arm in flags):
            continue
        for tile in tiles:
            lines = as_read(recording.cut(each.first_line, each.lines, tile), options)
            if lines.mask.any():
                continue
            last = each.first_line + each.lines - 1
            where = "" if tile is None else f" in tile {tile}"
            raise UsageError(
                f"no video can be made of lines {each.first_line} to {last}: none of their samples is "
                f"usable{where}, since they are lost, saturated or masked in both arms",
                possible="lines before them, or after them: --first-line and --lines, or --from and --to",
                hint="acquire info lists what is lost; for saturated lines, less light or a lower gain",
            )


def _solved(
    tasks: Sequence[Task], pool: Pool, monitor: Monitor, budget: Budget, choices: SharedChoices
) -> Iterator[tuple[Part, Task, SubSegment | None]]:
    """Yield solved tasks in order, each with its tile's next sub-segment, until monitor or budget ends it.

    Tasks that share a choice wait for it, so that the video does not depend on which task finishes first.
    """
    submitted = 0
    waiting: deque[Future[Part]] = deque()
    for index, task in enumerate(tasks):
        # There is one more than there are workers, so that none of them waits while a part is being written.
        while submitted < len(tasks) and len(waiting) <= pool.workers and not monitor.stopped:
            # The first task always runs, because a video needs one.
            if (submitted and budget.exhausted) or (waiting and choices.pending(tasks[submitted])):
                break
            after = len(tasks) - submitted - 1
            undone = after + 1 + sum(not each.done() for each in waiting)
            waiting.append(pool.submit(budget.limit(choices.with_choice(tasks[submitted]), undone, after)))
            submitted += 1
        if not waiting or (part := _result(waiting, pool, monitor)) is None:
            return
        choices.record(task, part)
        following = tasks[index + 1 : index + 2]
        yield part, task, following[0].segment if following and following[0].tile == task.tile else None


def _result(waiting: deque[Future[Part]], pool: Pool, monitor: Monitor) -> Part | None:
    """Wait for the first future and return its part; None if it was cancelled."""
    future = waiting.popleft()
    try:
        while not wait([future], POLL_S).done:
            if monitor(pool.share_done()):
                pool.stop()
                for each in (future, *waiting):
                    each.cancel()
        # Tasks that end sooner than `POLL_S` are reported, too.
        monitor(pool.share_done())
        return future.result()
    except CancelledError:
        return None
    except BrokenProcessPool as error:
        raise AcquireError(
            "a process that solved a sub-segment ended unexpectedly", hint="--workers 1: it may lack memory"
        ) from error


def describe_parts(
    recording: Recording, request: VideoRequest, parts: Sequence[dict[str, Any]], options: Options
) -> dict[str, Any]:
    """Return origin and quality of the video as JSON: of the whole and of each sub-segment."""
    tiles = max(1, len(request.tiles))
    names, reasons = (
        each * tiles if each else ("",) * len(parts) for each in (request.names, request.reasons)
    )

    def rms(key: str) -> float | None:
        known = [part["quality"][key] for part in parts if part["quality"][key] is not None]
        # JSON has None for what is unknown of a part, such as the noise.
        return float(np.sqrt(np.mean(np.square(known)))) if known else None

    # Parts may be fewer than ranges: a stop or the budget has ended the others.
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
        "quality": {key: rms(key) for key in QUALITY_KEYS},
        "error": combined_facts(
            [part["error"] for part in parts], [part["end_substep"] - part["begin_substep"] for part in parts]
        ),
        "segments": segments,
        "segments_asked": len(request.stretches) * tiles,
        "tiles": [str(tile) for tile in request.tiles],
        "calibration": provenance(options.calibration),
        "turned": TURNED.get(options.turn),
        "versions": {"acquire": __version__},
        "plugins": of_others([(SOLVERS, options.solver), (DENOISERS, options.denoiser or "")]),
    }


def _trusted_of_all_tiles(
    request: VideoRequest, segments: Sequence[SubSegment], parts: Sequence[dict[str, Any]]
) -> tuple[int, int]:
    """Return the sub-steps that are trusted in every tile; none if a tile lacks a sub-segment."""
    begin, count = segments[0].begin, len(segments)
    if request.tiles and len(parts) < count * len(request.tiles):
        return begin, begin
    # Of each tile the longest run is trusted; of all tiles, what these have in common.
    by_tile = []
    for of_tile in (parts[first : first + count] for first in range(0, len(parts), count)):
        runs = _trusted_runs([(each, part["trusted"]) for each, part in zip(segments, of_tile, strict=False)])
        unseen = _unseen_of(of_tile, request.trusted)
        by_tile.append(longest((each for run in runs for each in remaining(run, unseen)), begin))
    low, high = max(low for low, _ in by_tile), min(high for _, high in by_tile)
    return low, max(low, high)


def _unseen_of(parts: Sequence[dict[str, Any]], trusted: tuple[int, int]) -> list[Unseen]:
    """Return what an arm did not see of the sub-steps that are sampled in full otherwise."""
    return within((Unseen(**each) for part in parts for each in part["unseen"]), *trusted)


def _words_on_unseen(
    request: VideoRequest, count: int, frames: int, parts: Sequence[dict[str, Any]]
) -> Iterator[str]:
    """Yield a warning for each range of frames that is not trusted since an arm did not see it."""
    begin, T_m = request.grid.begin, request.grid.voxels.temporal_merge
    for of_tile in (parts[first : first + count] for first in range(0, len(parts), count)):
        prefix = "" if of_tile[0]["tile"] is None else f"tile {of_tile[0]['tile']}: "
        for each in _unseen_of(of_tile, request.trusted):
            last = min(frames, -(-(each.end - begin) // T_m)) - 1
            yield prefix + each.words((each.begin - begin) // T_m, last)


def _trusted_runs(segments: Sequence[tuple[SubSegment, bool]]) -> list[tuple[int, int]]:
    """Return the runs of trusted sub-segments, in sub-steps, without their fades into others."""
    runs = [[each for each, _ in run] for trusted, run in groupby(segments, itemgetter(1)) if trusted]
    first, last = segments[0][0], segments[-1][0]
    return [
        (
            run[0].begin + (0 if run[0] is first else run[0].fade_in),
            run[-1].end - (0 if run[-1] is last else run[-1].fade_out),
        )
        for run in runs
    ]


def _trusted_frames(request: VideoRequest, frames: int, trusted: tuple[int, int]) -> list[int]:
    """Return the first frame that is fully sampled and in ``trusted``, and the one after the last."""
    T_m, begin = request.grid.voxels.temporal_merge, request.grid.begin
    low = max(request.trusted[0], trusted[0]) - begin
    high = min(request.trusted[1], trusted[1]) - begin
    # The last frame of the grid may be shorter than T_m.
    stop = -(-high // T_m) if begin + high >= request.grid.end else high // T_m
    first = min(frames, -(-low // T_m))
    return [first, max(first, min(frames, stop))]
