"""Selection of lines or times of a recording to reconstruct, in one kind of voxels or along a plan."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from numbers import Real
from typing import TYPE_CHECKING

from acquire.config.plan import FADE_SUBSTEPS
from acquire.errors import UsageError
from acquire.geometry import check_integers
from acquire.recon.segments import Grid, Stream, Stretch, SubSegment, Voxels, split
from acquire.reconstruct.times import Times, duration
from acquire.store import Recording
from acquire.text import shown

if TYPE_CHECKING:
    from acquire.config.plan import ReconstructionPlan
    from acquire.fibre import Tile

SPANS_PER_SEGMENT = 4
"""Default length of a sub-segment, in n; about a quarter of the lines is then read twice."""
VOXELS_PER_SEGMENT = 32
"""Default length of a sub-segment of long voxels, in T_m, where that is more than `SPANS_PER_SEGMENT`.

A search needs frames to tell motion and lamps from rest. At T_m = n, where 4·n would be four frames, 8, 16,
32 and 64 voxels have 23.8, 24.1, 24.7, 24.2 dB (``runner``), 22.9, 23.3, 23.4, 23.6 dB (``traffic``) and
30.5, 30.7, 31.4, 31.3 dB (``flame``) with an ordinary camera's noise, and take about the same time.
Sub-segments of slow voxels (`Stream.is_slow`) share no lines, so that the lines across a seam are lost, a
share of n/(32·T_m), at most 3 %. Longer ones would leave cores idle and need more memory, which grows with
the lines, since 32·n′² voxels are few.
"""


@dataclass(frozen=True, slots=True)
class Selection:
    """Sub-steps ``begin`` to ``end`` (None: to the limit) out of the lines of ``stream``.

    ``times`` converts them for the user.
    """

    stream: Stream
    times: Times
    begin: int | None = None
    end: int | None = None

    def extent(self, first: Voxels, last: Voxels, *, whole: bool) -> tuple[int, int]:
        """Return the requested sub-steps, by default those of `Stream.extent`.

        Raises UsageError for times that the lines do not show.
        """
        low, high = self.stream.extent(first, last, whole=whole)
        begin, end = low if self.begin is None else self.begin, high if self.end is None else self.end
        if self.begin is not None and self.end is not None and end <= begin:
            raise UsageError(
                f"a range from {self.times.words(begin)} to {self.times.words(end)} is empty: it has to end "
                "after its beginning",
                possible=f"within {self.in_words(low, high)}",
            )
        if not low <= begin < end <= high:
            raise UsageError(
                f"the lines do not show {self.in_words(begin, end)} after the first line",
                possible=self.in_words(low, high),
            )
        return begin, end

    def length(self, substeps: int) -> str:
        """Express a number of sub-steps in words."""
        return f"{duration(substeps * self.times.substep_ns)} ({substeps} sub-steps)"

    def in_words(self, begin: int, end: int) -> str:
        """Express two sub-steps as times and as sub-steps."""
        return f"{self.times.words(begin)} to {self.times.words(end)} (sub-steps {begin} to {end})"


@dataclass(frozen=True, slots=True)
class VideoRequest:
    """Consecutive ranges of a stream (``stretches``), and the grid of their common video.

    ``trusted`` are the fully sampled sub-steps; ``names`` and ``reasons`` belong to the ranges. ``glimpses``
    are the sub-segments that are solved if they show only a part of each range. ``tiles`` are those of a
    scene behind a fibre, row by row, and empty without a fibre.
    """

    stream: Stream
    stretches: tuple[Stretch, ...]
    grid: Grid
    trusted: tuple[int, int]
    fade: int = FADE_SUBSTEPS
    names: tuple[str, ...] = ()
    reasons: tuple[str, ...] = ()
    glimpses: tuple[SubSegment, ...] = ()
    tiles: tuple[Tile, ...] = ()

    def sub_segments(self) -> tuple[SubSegment, ...]:
        """Return the sub-segments to solve, in order."""
        return self.glimpses or self.stream.arrange(self.stretches, self.fade)


def in_tiles(request: VideoRequest, tiles: tuple[Tile, ...]) -> VideoRequest:
    """Return the request for each of ``tiles`` of a scene behind a fibre; empty without a fibre.

    Raises UsageError for voxels that do not fill a tile, since those of its neighbour would then be offset.
    """
    grid = request.grid
    if tiles and grid.size % grid.voxels.spatial_merge:
        divisors = [str(merge) for merge in range(1, grid.size + 1) if not grid.size % merge]
        raise UsageError(
            f"voxels of N_m = {grid.voxels.spatial_merge} do not fill the tiles behind the fibre, which are "
            f"{grid.size} fine pixels wide",
            possible=f"N_m of {', '.join(divisors)}",
        )
    return replace(request, tiles=tiles)


def stream_of(recording: Recording) -> Stream:
    """Return the stream of all lines of a recording. Raises UsageError for anything else."""
    if not isinstance(recording, Recording):
        raise UsageError(
            f"lines of {shown(recording)} cannot be selected",
            possible="a recording",
            hint="open_recording(...)",
        )
    geometry = recording.geometry_for(1)
    first = recording.first_line
    return Stream(geometry.stages, geometry.substeps, first, first + recording.lines)


def by_lines(recording: Recording, first_line: int | None = None, lines: int | None = None) -> Selection:
    """Select exactly these lines, by default all to the end.

    Raises UsageError for lines that the recording does not have, and for fewer than one.
    """
    whole = stream_of(recording)
    first = whole.first_line if first_line is None else first_line
    check_integers(first_line=first, lines=1 if lines is None else lines)
    if lines is not None and lines < 1:
        raise UsageError(
            f"a range of {lines} lines cannot be selected", possible="1 or more, or None for all"
        )
    end = whole.end_line if lines is None else first + lines
    if not whole.first_line <= first < end <= whole.end_line:
        possible = f"lines {whole.first_line} to {whole.end_line - 1}" if recording.lines else "no lines yet"
        # From a first line beyond the end, "to the end" would run backwards.
        asked = f"line {first}" if lines is None else f"lines {first} to {end - 1}"
        raise UsageError(f"{recording} does not have {asked}", possible=possible)
    return Selection(Stream(whole.stages, whole.substeps, first, end), Times.of(recording))


def by_time(recording: Recording, begin_ns: int | None, end_ns: int | None) -> Selection:
    """Select the video from ``begin_ns`` to ``end_ns`` after the first read-out, from all lines it needs."""
    times = Times.of(recording)
    for name, ns in (("begin_ns", begin_ns), ("end_ns", end_ns)):
        if ns is not None and not (isinstance(ns, Real) and math.isfinite(ns)):
            raise UsageError(
                f"{name} cannot be {ns!r}", possible="nanoseconds after the first read-out, or None"
            )
    begin, end = (None if ns is None else times.substep(ns) for ns in (begin_ns, end_ns))
    return Selection(stream_of(recording), times, begin, end)


def in_voxels(
    selection: Selection, voxels: Voxels, *, whole_ends: bool | None = None, longest: int | None = None
) -> VideoRequest:
    """Request all of a selection in one kind of voxels, in sub-segments of at most ``longest`` sub-steps.

    Voxels as long as two passes of the scene are sampled by every row wherever they lie. They are kept at the
    ends, too, unless ``whole_ends`` is given.
    """
    stream = selection.stream
    size = stream.geometry(1).size
    check_integers(longest=1 if longest is None else longest)
    if longest is not None and longest < 1:
        raise UsageError(
            f"sub-segments of {longest} sub-steps are not possible",
            possible="1 or more, or None for the default",
        )
    stream.geometry(1).check_merge(voxels.spatial_merge, voxels.temporal_merge)
    whole = voxels.temporal_merge >= 2 * size if whole_ends is None else whole_ends
    begin, end = selection.extent(voxels, voxels, whole=whole)
    default = max(SPANS_PER_SEGMENT * size, VOXELS_PER_SEGMENT * voxels.temporal_merge)
    stretches = tuple(split(begin, end, voxels, default if longest is None else longest))
    return VideoRequest(stream, stretches, Grid.finest(stretches, size), _trusted(stream, begin, end))


def in_glimpses(selection: Selection, voxels: Voxels, count: int) -> VideoRequest:
    """Request one frame for each of ``count`` equal ranges, from the fewest lines about its middle.

    The time this takes does not depend on the length of the selection. Raises UsageError if the ranges are
    shorter than the voxels.
    """
    stream = selection.stream
    stream.geometry(1).check_merge(voxels.spatial_merge, voxels.temporal_merge)
    begin, end = selection.extent(voxels, voxels, whole=False)
    check_integers(count=count)
    if count < 1:
        raise UsageError(f"{count} glimpses are not possible", possible="1 or more")
    length = (end - begin) // count
    if length < voxels.temporal_merge:
        most = (end - begin) // voxels.temporal_merge
        raise UsageError(
            f"{count} glimpses of {selection.length(end - begin)} are too many", possible=f"up to {most}"
        )
    whole = Voxels(voxels.spatial_merge, length)
    stretches = tuple(Stretch(begin + i * length, begin + (i + 1) * length, whole) for i in range(count))
    glimpses = []
    for stretch in stretches:
        first = (stretch.begin + stretch.end - voxels.temporal_merge) // 2
        seen = (first, first + voxels.temporal_merge)
        # It is solved for the middle only; the frame then stands for the whole range.
        glimpse = stream.sub_segment(Stretch(*seen, voxels))
        glimpses.append(replace(glimpse, begin=stretch.begin, end=stretch.end, seen=seen))
    grid = Grid.finest(stretches, stream.geometry(1).size)
    return VideoRequest(stream, stretches, grid, (begin, stretches[-1].end), glimpses=tuple(glimpses))


def along_plan(selection: Selection, plan: ReconstructionPlan, grid: Voxels | None = None) -> VideoRequest:
    """Request the sub-segments of a plan, one after the other from the beginning of the selection.

    Raises UsageError for a plan that is longer than the selection.
    """
    stream = selection.stream
    geometry = stream.geometry(1)
    voxels = [Voxels(part.spatial_merge, part.temporal_merge) for part in plan.segments]
    for each in voxels:
        geometry.check_merge(each.spatial_merge, each.temporal_merge)
    begin, end = selection.extent(voxels[0], voxels[-1], whole=plan.ends == "whole")
    substep_s = selection.times.substep_ns * 1e-9
    stretches, edge = [], begin
    for part, each in zip(plan.segments, voxels, strict=True):
        length = part.length_substeps(geometry.substeps, substep_s)
        # A segment without a length takes the rest, of at least one sub-step.
        if edge + (length or 1) > end:
            wanted, most = (selection.length(to - begin) for to in (edge + (length or 1), end))
            raise UsageError(
                f"the plan goes beyond the lines, with {part.name or 'a segment'} to {wanted}",
                possible=f"{most} in all",
            )
        stop = end if length is None else edge + length
        stretches.append(Stretch(edge, stop, stream.evened(each, stop - edge)))
        edge = stop
    return VideoRequest(
        stream,
        tuple(stretches),
        Grid.finest(stretches, geometry.size, grid),
        _trusted(stream, begin, edge),
        fade=plan.fade_substeps,
        names=tuple(part.name for part in plan.segments),
        reasons=tuple(part.why for part in plan.segments),
    )


def _trusted(stream: Stream, begin: int, end: int) -> tuple[int, int]:
    """Return the part of ``begin`` to ``end`` that every row samples; empty if there is none."""
    origin, trusted = stream.substeps * stream.first_line, stream.geometry().trusted
    # Sub-steps are counted in the whole recording, those of a geometry from its own first line.
    low, high = max(begin, origin + trusted.start), min(end, origin + trusted.stop)
    return (low, high) if high > low else (begin, begin)
