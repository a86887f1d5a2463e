"""A worker's task: one sub-segment, from the recording on disk to frames on the common grid."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, fields, replace
from inspect import signature
from typing import TYPE_CHECKING, Any, Protocol

from acquire.calibrate import calibrated
from acquire.calibrate.apply import aligned
from acquire.plugins import SOLVERS
from acquire.recon import reconstruct
from acquire.recon.balance import divided
from acquire.recon.diagnosis import undo_turn
from acquire.recon.error import regions_of
from acquire.recon.hypotheses import AS_BUILT
from acquire.recon.reuse import Choice
from acquire.recon.unseen import find_unseen, trusted_frames, within
from acquire.reconstruct.facts import result_facts, why_not_trusted
from acquire.store import open_recording

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

    from acquire.arrays import Dtype
    from acquire.calibrate import Calibration
    from acquire.fibre import Tile
    from acquire.lines import Segment
    from acquire.recon import Preset, Progress
    from acquire.recon.balance import Balance
    from acquire.recon.hypotheses import Turn
    from acquire.recon.segments import Grid, SubSegment

LEAST_BUDGET_S = 0.05
"""Smallest useful budget of a sub-segment; a smaller one does not make it faster."""


@dataclass(frozen=True, slots=True)
class Options:
    """How to solve. ``budget_s`` is for the whole request.

    Options that are named as parameters of `acquire.recon.reconstruct` are passed to it for each sub-segment.
    ``calibration`` corrects the lines; None leaves them to the cameras' configuration. ``turn`` is a further
    correction of the arms' orientation, for which the calibration has to be that of turned arms
    (`acquire.reconstruct.reorient`), ``balance`` the balance by which arm B's light is then divided,
    ``check`` whether unexplained lines are diagnosed, and ``error`` whether the video's error is estimated.
    The solver's options and the denoiser's name may be those of a plug-in. ``shared`` is whether one tile's
    choice of prior and weight is handed to the others, and one sub-segment's to those after it; None shares
    it among the tiles behind a fibre only.
    """

    preset: Preset = "balanced"
    solver: str = "admm"
    iterations: int | None = None
    budget_s: float | None = None
    bandwidth: float | None = None
    dtype: Dtype = "float32"
    device: str = "cpu"
    calibration: Calibration | None = None
    turn: Turn = AS_BUILT
    check: bool = True
    error: bool = True
    solver_options: Mapping[str, Any] = field(default_factory=dict)
    denoiser: str | None = None
    balance: Balance | None = None
    shared: bool | None = None

    @property
    def chooses(self) -> bool:
        """Whether the solver can choose prior and weight, and no option overrides its choice."""
        given = (self.bandwidth, self.denoiser)
        return "choice" in SOLVERS.load(self.solver).takes and all(each is None for each in given)

    def keywords(self) -> dict[str, Any]:
        """Return those options that `reconstruct` has as well, by its names."""
        taken = signature(reconstruct).parameters
        return {each.name: getattr(self, each.name) for each in fields(self) if each.name in taken}


@dataclass(frozen=True, slots=True)
class Task:
    """A sub-segment of a recording, and the grid on which its frames are wanted. Picklable.

    ``tile`` is the solved part of a scene behind a fibre, or None. ``choice`` is that of another task with
    the same voxels, to be tried first. ``due`` is the deadline (`time.monotonic` of this machine); without
    one, the options' budget applies to this task.
    """

    recording: str
    segment: SubSegment
    grid: Grid
    options: Options
    due: float | None = None
    tile: Tile | None = None
    choice: Choice | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A solved sub-segment on the grid.

    ``video`` is (t, y, x), ``quality`` the residual of the lines (t,), ``error`` the estimated error of
    regions (t, 8, 8), NaN if unknown. ``facts`` describe the solution, and ``choice`` is the choice of prior
    and weight that it led to, if any.
    """

    video: NDArray[np.float32]
    quality: NDArray[np.float32]
    error: NDArray[np.float32]
    facts: dict[str, Any] = field(default_factory=dict)
    choice: Choice | None = None


MOST_SHARE = 0.95
"""Upper limit on the iterations' share of a task, which is complete only with its result."""


class Watch(Protocol):
    """Observer of a task in progress."""

    def advance(self, share: float) -> None:
        """Report that ``share`` of the task was done since the last call."""

    def is_set(self) -> bool:
        """Whether to stop now with the best result so far."""
        ...


def solve(task: Task, watch: Watch) -> Part:
    """Cut, reconstruct and resample to the grid. Raises what `Recording.cut` and `reconstruct` raise."""
    segment, options, voxels = task.segment, task.options, task.segment.voxels
    lines = open_recording(task.recording).cut(segment.first_line, segment.lines, task.tile)
    lines = as_read(lines, options)
    if options.balance is not None:
        lines = divided(lines, options.balance)
    # Estimated from the whole recording: their own lines would make sub-segments differ in brightness.
    lines = replace(lines, balanced=True)

    done = 0.0

    def advanced(progress: Progress) -> None:
        # Trials come on top of the requested iterations in unknown number, so the share is an estimate.
        nonlocal done
        share = min(progress.iteration / progress.iterations, MOST_SHARE)
        watch.advance(max(0.0, share - done))
        done = max(done, share)

    keywords = options.keywords()
    if task.due is not None:
        keywords["budget_s"] = max(task.due - time.monotonic(), LEAST_BUDGET_S)
    result = reconstruct(
        lines,
        voxels.spatial_merge,
        voxels.temporal_merge,
        progress=advanced,
        choice=task.choice,
        stop=watch,
        refuse=False,  # a task that was started ends regularly
        **keywords,
    )
    # The rest is reported: an early end leaves part of the iterations undone.
    watch.advance(1 - done)
    substeps = lines.geometry.substeps
    last = segment.first_line + segment.lines - 1
    doubt = why_not_trusted(result, f"the sub-segment of lines {segment.first_line} to {last}")
    # The video has fewer frames that are not trusted than its sub-segments: `combine` names those.
    _, withdrawn = trusted_frames(lines, voxels.temporal_merge)
    warnings = [text for text in result.warnings if text not in withdrawn]
    unseen = within(find_unseen(lines, voxels.temporal_merge), segment.begin, segment.end)
    prefix = "" if task.tile is None else f"tile {task.tile}: "
    return Part(
        video=task.grid.resample(result.video, segment, substeps),
        quality=task.grid.resample_time(result.frame_error, segment, substeps),
        error=task.grid.resample_time(regions_of(result.error, len(result.video)), segment, substeps),
        facts={
            **result_facts(result),
            "first_line": segment.first_line,
            "lines": segment.lines,
            "begin_substep": segment.begin,
            "end_substep": segment.end,
            "spatial_merge": voxels.spatial_merge,
            "temporal_merge": voxels.temporal_merge,
            "trusted": doubt is None,
            "unseen": [each.to_dict() for each in unseen],
            "tile": None if task.tile is None else str(task.tile),
            "kept_choice": None if task.choice is None else task.choice.kept(result.parameters),
            "warnings": [prefix + text for text in (*([] if doubt is None else [doubt]), *warnings)],
        },
        # A search that was stopped has not chosen.
        choice=Choice.of(result) if result.believed and result.ended != "stopped" else None,
    )


def as_read(lines: Segment, options: Options) -> Segment:
    """Return lines with the calibration and the correction of the arms' orientation applied."""
    known, turn = options.calibration, options.turn
    if known is None:
        return undo_turn(lines, turn)
    if turn == AS_BUILT:
        return calibrated(lines, known)
    # the alignment is that of the arms after the turn, which may exchange them
    return aligned(undo_turn(calibrated(lines, replace(known, alignment=None)), turn), known.alignment)
