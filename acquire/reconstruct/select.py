"""What of a recording is reconstructed: lines or times, in one kind of voxels or along a plan."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from acquire.config.plan import FADE_SUBSTEPS
from acquire.errors import UsageError
from acquire.recon.segments import Grid, Stream, Stretch, SubSegment, Voxels, split
from acquire.reconstruct.times import Times, duration

if TYPE_CHECKING:
    from acquire.config.plan import ReconstructionPlan
    from acquire.fibre import Tile
    from acquire.store import Recording

SPANS_PER_SEGMENT = 4
"""Sub-steps that a sub-segment keeps where nobody says otherwise, in n: a third of its lines is overlap."""
VOXELS_PER_SEGMENT = 16


@dataclass(frozen=True, slots=True)
class Selection:
    """Sub-steps ``begin`` to ``end`` (None: as far as it goes) out of the lines of ``stream``.

    ``times`` says them to the user.
    """

    stream: Stream
    times: Times
    begin: int | None = None
    end: int | None = None

    def extent(self, first: Voxels, last: Voxels, *, whole: bool) -> tuple[int, int]:
        """As asked, or as `Stream.extent`; UsageError for times that the lines do not show."""
        low, high = self.stream.extent(first, last, whole=whole)
        begin, end = low if self.begin is None else self.begin, high if self.end is None else self.end
        if not low <= begin < end <= high:
            raise UsageError(
                f"the lines do not show {self.in_words(begin, end)} after the first line",
                possible=self.in_words(low, high),
            )
        return begin, end

    def length(self, substeps: int) -> str:
        """So many sub-steps in words."""
        return f"{duration(substeps * self.times.substep_ns)} ({substeps} sub-steps)"

    def in_words(self, begin: int, end: int) -> str:
        """Sub-steps as times and as what they are."""
        return f"{self.times.words(begin)} to {self.times.words(end)} (sub-steps {begin} to {end})"


@dataclass(frozen=True, slots=True)
class VideoRequest:
    """Stretches of a stream that follow one another, and the grid of their common video.

    ``trusted`` are the sub-steps that are sampled in full; ``names`` and ``reasons`` are the stretches'.
    ``glimpses`` are what is looked at where that is less than all of each stretch. ``tiles`` are those of a
    scene behind a fibre, row by row; none: there is no fibre.
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
        """What is solved, in order."""
        return self.glimpses or self.stream.arrange(self.stretches, self.fade)


def in_tiles(request: VideoRequest, tiles: tuple[Tile, ...]) -> VideoRequest:
    """The request for each of some tiles of a scene behind a fibre; none: there is no fibre.

    UsageError for voxels that do not end where a tile does: its neighbour's would begin elsewhere.
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
    """All lines of a recording."""
    geometry = recording.geometry_for(1)
    first = recording.first_line
    return Stream(geometry.stages, geometry.substeps, first, first + recording.lines)


def by_lines(recording: Recording, first_line: int | None = None, lines: int | None = None) -> Selection:
    """These lines and no other. UsageError for lines that are not there."""
    whole = stream_of(recording)
    first = whole.first_line if first_line is None else first_line
    end = whole.end_line if lines is None else first + lines
    if not whole.first_line <= first < end <= whole.end_line:
        have = f"lines {whole.first_line} to {whole.end_line - 1}" if recording.lines else "no lines yet"
        raise UsageError(f"lines {first} to {end - 1} of {recording} are not there", possible=have)
    return Selection(Stream(whole.stages, whole.substeps, first, end), Times.of(recording))


def by_time(recording: Recording, begin_ns: int | None, end_ns: int | None) -> Selection:
    """The video from ``begin_ns`` to ``end_ns`` after the first line's read-out, from all lines it needs."""
    times = Times.of(recording)
    begin, end = (None if ns is None else times.substep(ns) for ns in (begin_ns, end_ns))
    return Selection(stream_of(recording), times, begin, end)


def in_voxels(
    selection: Selection, voxels: Voxels, *, whole_ends: bool | None = None, longest: int | None = None
) -> VideoRequest:
    """All of a selection in one kind of voxels, in sub-segments of at most ``longest`` sub-steps.

    Voxels as long as two passes of the scene are sampled by every row wherever they lie: they are kept at
    the ends too, unless ``whole_ends`` says otherwise.
    """
    stream = selection.stream
    size = stream.geometry(1).size
    stream.geometry(1).check_merge(voxels.spatial_merge, voxels.temporal_merge)
    whole = voxels.temporal_merge >= 2 * size if whole_ends is None else whole_ends
    begin, end = selection.extent(voxels, voxels, whole=whole)
    default = max(SPANS_PER_SEGMENT * size, VOXELS_PER_SEGMENT * voxels.temporal_merge)
    stretches = tuple(split(begin, end, voxels, longest or default))
    return VideoRequest(stream, stretches, Grid.finest(stretches, size), _trusted(stream, begin, end))


def in_glimpses(selection: Selection, voxels: Voxels, count: int) -> VideoRequest:
    """One frame for each of ``count`` equal stretches, from the fewest lines about its middle that show one.

    How long that takes does not depend on how long the selection is. UsageError where the stretches are
    shorter than the voxels.
    """
    stream = selection.stream
    begin, end = selection.extent(voxels, voxels, whole=False)
    length = (end - begin) // count
    if length < voxels.temporal_merge:
        most = (end - begin) // voxels.temporal_merge
        raise UsageError(
            f"{count} glimpses of {selection.length(end - begin)} are too many", possible=f"up to {most}"
        )
    whole = Voxels(voxels.spatial_merge, length)
    stretches = tuple(Stretch(begin + i * length, begin + (i + 1) * length, whole) for i in range(count))
    glimpses = tuple(_glimpse(stream, stretch, voxels) for stretch in stretches)
    grid = Grid.finest(stretches, stream.geometry(1).size)
    return VideoRequest(stream, stretches, grid, (begin, stretches[-1].end), glimpses=glimpses)


def _glimpse(stream: Stream, stretch: Stretch, voxels: Voxels) -> SubSegment:
    middle = (stretch.begin + stretch.end - voxels.temporal_merge) // 2
    seen = (middle, middle + voxels.temporal_merge)
    return replace(
        stream.sub_segment(Stretch(*seen, voxels)), begin=stretch.begin, end=stretch.end, seen=seen
    )


def along_plan(selection: Selection, plan: ReconstructionPlan, grid: Voxels | None = None) -> VideoRequest:
    """The sub-segments of a plan, one after the other from the selection's beginning.

    UsageError for a plan that is longer than what there is.
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
        plan.fade_substeps,
        tuple(part.name for part in plan.segments),
        tuple(part.why for part in plan.segments),
    )


def _trusted(stream: Stream, begin: int, end: int) -> tuple[int, int]:
    """What of ``begin`` to ``end`` every row samples; empty where nothing is."""
    origin, trusted = stream.substeps * stream.first_line, stream.geometry().trusted
    low, high = max(begin, origin + trusted.start), min(end, origin + trusted.stop)
    return (low, high) if high > low else (begin, begin)
