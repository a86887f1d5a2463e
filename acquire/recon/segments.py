"""Sub-segments of one stream, each with its own voxels, and one video of them all (Fig. 5, right).

Sub-steps are counted in the whole stream: line ℓ begins at sub-step S·ℓ. Sub-segment k keeps ``b_k`` to
``b_{k+1}`` and is reconstructed from lines that sample this in full, so that neighbours share lines::

    kept            b₀ ·············· b₁ ······················ b₂ ············ b₃
    lines of 0   ╱──────────────────────╲
    lines of 1                     ╱─────────────────────────────────╲
    lines of 2                                              ╱──────────────────────╲
                                 overlap                     overlap

On either side of b_k at least n − 1 sub-steps are dropped, up to whole voxels (`Geometry.seam_substeps`).
Around b_k, where both neighbours are sampled in full, one fades into the other.

All of them are resampled to one `Grid`, whose voxels are the means of those that overlap them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import UsageError
from acquire.geometry import Geometry

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, order=True)
class Voxels:
    """N_m fine pixels wide and high, T_m sub-steps long."""

    spatial_merge: int
    temporal_merge: int

    def __str__(self) -> str:
        return f"{self.spatial_merge}x{self.temporal_merge}"


@dataclass(frozen=True, slots=True)
class Stretch:
    """Sub-steps ``begin`` to ``end`` of the stream, to be reconstructed in ``voxels``."""

    begin: int
    end: int
    voxels: Voxels

    def __post_init__(self) -> None:
        if self.end <= self.begin:
            raise UsageError(
                f"a range cannot go from sub-step {self.begin} to {self.end}",
                possible="an end after the beginning",
            )


@dataclass(frozen=True, slots=True)
class SubSegment:
    """The sub-steps that are kept, the fades to the neighbours, and the lines to reconstruct from.

    ``begin`` to ``end`` is kept; the neighbours fade over ``fade_in`` sub-steps before and after ``begin``,
    and over ``fade_out`` around ``end``. Frames are limited to the sub-steps ``seen``, if given.
    """

    begin: int
    end: int
    voxels: Voxels
    first_line: int
    lines: int
    fade_in: int = 0
    fade_out: int = 0
    seen: tuple[int, int] | None = None

    @property
    def shown(self) -> tuple[int, int]:
        """Sub-steps to which it contributes in the video."""
        return self.begin - self.fade_in, self.end + self.fade_out


@dataclass(frozen=True, slots=True)
class Stream:
    """Lines ``first_line`` to ``end_line`` of a recording, and the sub-steps that they show."""

    stages: int
    substeps: int
    first_line: int
    end_line: int

    def geometry(self, lines: int | None = None) -> Geometry:
        return Geometry(
            self.stages, self.substeps, self.end_line - self.first_line if lines is None else lines
        )

    def extent(self, first: Voxels, last: Voxels, *, whole: bool) -> tuple[int, int]:
        """First sub-step, and the one after the last, of a video of all lines.

        They are sampled in full, in whole voxels unless these are slow; with ``whole``, all that the lines
        touch. Raises UsageError if there are none.
        """
        origin, geometry = self.substeps * self.first_line, self.geometry()
        if whole:
            return origin, origin + geometry.span
        begin, end = geometry.trusted.start, geometry.trusted.stop
        if not self.is_slow(first):
            begin = geometry.trusted_frames(first.temporal_merge).start * first.temporal_merge
        if not self.is_slow(last):
            end = geometry.trusted_frames(last.temporal_merge).stop * last.temporal_merge
            end = min(end, geometry.span)
        if end <= begin:
            raise UsageError(
                f"no voxel of T_m = {last.temporal_merge} is sampled in full by L_R = {geometry.lines}",
                possible=f"more than {self.stages} lines; the shorter T_m, the fewer are needed",
                hint="--ends whole, which also keeps voxels that are sampled only in part",
            )
        return origin + begin, origin + end

    def sub_segment(self, stretch: Stretch, fade_in: int = 0, fade_out: int = 0) -> SubSegment:
        """The lines for a stretch, as far as the stream has them.

        These are the fewest that sample its whole voxels in full; for slow voxels (`is_slow`), those that see
        nothing but the stretch.
        """
        S, T_m = self.substeps, stretch.voxels.temporal_merge
        begin, end = stretch.begin - fade_in, stretch.end + fade_out
        if self.is_slow(stretch.voxels):
            # The last line is the only one that sees any of the sub-steps after it has begun.
            first_line = min(max(self.first_line, begin // S), self.end_line - 1)
            # These are the sub-steps of a line: the last line has to end within the stretch.
            exposed = self.geometry(1).span
            end_line = -(-(end - exposed) // S) + 1
        else:
            first_line = max(self.first_line, (begin - self.geometry(1).seam_substeps(T_m)) // S)
            frames = -(-(end - S * first_line) // T_m)
            # What the first row shows in sub-step t is in line t // S, so that lines go up to the frames'
            # end.
            end_line = first_line - (-frames * T_m // S)
        # A stretch shorter than its lines' exposure has at least one of them.
        lines = max(1, min(self.end_line, end_line) - first_line)
        return SubSegment(
            stretch.begin,
            stretch.end,
            stretch.voxels,
            first_line=first_line,
            lines=lines,
            fade_in=fade_in,
            fade_out=fade_out,
        )

    def is_slow(self, voxels: Voxels) -> bool:
        """Whether voxels are so long that every row samples them, wherever they are.

        They need no lines from beyond their ends, which would contain what they cannot represent: the
        neighbours' motion. So slow stretches share no lines with their neighbours and do not fade.
        """
        return voxels.temporal_merge >= self.geometry(1).size

    def evened(self, voxels: Voxels, substeps: int) -> Voxels:
        """Slow voxels of equal length that fill ``substeps``: few rows would sample a short remainder."""
        if not self.is_slow(voxels):
            return voxels
        count = max(1, round(substeps / voxels.temporal_merge))
        return Voxels(voxels.spatial_merge, -(-substeps // count))

    def arrange(self, stretches: Sequence[Stretch], fade: int = 0) -> tuple[SubSegment, ...]:
        """Sub-segments for consecutive stretches, with fades of ``fade`` sub-steps to either side of a seam.

        A fade is limited to half of the shorter neighbour. Raises UsageError for a gap between two stretches.
        """
        for before, after in pairwise(stretches):
            if before.end != after.begin:
                raise UsageError(
                    f"a range ends at sub-step {before.end}, but the next one begins at {after.begin}"
                )
        # The length is 0 for slow ones: no seam with them fades.
        lengths = [
            0 if self.is_slow(stretch.voxels) else stretch.end - stretch.begin for stretch in stretches
        ]
        inner = [min(fade, a // 2, b // 2) for a, b in pairwise(lengths)]
        fades = [0, *inner, 0]
        return tuple(
            self.sub_segment(stretch, before, after)
            for stretch, (before, after) in zip(stretches, pairwise(fades), strict=True)
        )


def split(begin: int, end: int, voxels: Voxels, longest: int) -> list[Stretch]:
    """Split a range into equal stretches of whole voxels, of at most ``longest`` sub-steps."""
    T_m = voxels.temporal_merge
    frames = -(-(end - begin) // T_m)
    count = -(-frames // max(1, longest // T_m))
    edges = [begin + (frames * i // count) * T_m for i in range(count)]
    return [Stretch(a, b, voxels) for a, b in zip(edges, [*edges[1:], end], strict=True)]


@dataclass(frozen=True, slots=True)
class Grid:
    """The voxels of the stitched video: ``frames`` of T_m sub-steps from ``begin`` on, of side ⌈n/N_m⌉.

    The last frame may be shorter.
    """

    begin: int
    end: int
    size: int
    voxels: Voxels

    def __post_init__(self) -> None:
        Geometry(self.size, 1, 1).check_merge(self.voxels.spatial_merge, self.voxels.temporal_merge)

    @classmethod
    def finest(cls, stretches: Sequence[Stretch], size: int, voxels: Voxels | None = None) -> Grid:
        """A grid over all stretches, in ``voxels`` or in the smallest N_m and T_m among them."""
        finest = Voxels(
            min(stretch.voxels.spatial_merge for stretch in stretches),
            min(stretch.voxels.temporal_merge for stretch in stretches),
        )
        return cls(stretches[0].begin, stretches[-1].end, size, voxels or finest)

    @property
    def frames(self) -> int:
        """Frames of the whole range; the last one may be shorter than T_m sub-steps."""
        return -(-(self.end - self.begin) // self.voxels.temporal_merge)

    @property
    def side(self) -> int:
        """n′, voxels along each side of a frame; the last may reach beyond the scene."""
        return -(-self.size // self.voxels.spatial_merge)

    def edges(self, frames: slice) -> NDArray[np.int64]:
        """Sub-steps at which these frames begin, and the one at which the last ends."""
        edges = self.begin + np.arange(frames.start, frames.stop + 1) * self.voxels.temporal_merge
        capped: NDArray[np.int64] = np.minimum(edges, self.end)
        return capped

    def frames_of(self, segment: SubSegment) -> slice:
        """Frames to which a sub-segment contributes."""
        begin, end = segment.shown
        T_m = self.voxels.temporal_merge
        return slice((begin - self.begin) // T_m, min(self.frames, -(-(end - self.begin) // T_m)))

    def weights(self, segment: SubSegment) -> NDArray[np.float32]:
        """Weight of a sub-segment in each of its frames; the weights of all of them add up to 1.

        It is the mean over a frame's sub-steps of a weight that is linear across a seam.
        """
        edges = self.edges(self.frames_of(segment))
        covered = np.diff(_rise(edges, segment.begin, segment.fade_in))
        covered -= np.diff(_rise(edges, segment.end, segment.fade_out))
        weights: NDArray[np.float32] = (covered / np.diff(edges)).astype(np.float32)
        return weights

    def resample(self, video: NDArray[Any], segment: SubSegment, substeps: int) -> NDArray[np.float32]:
        """A sub-segment's voxels (T/T_m, n′, n′), from its first line's first sub-step on, on this grid."""
        timed = self.resample_time(video, segment, substeps)
        have, want = segment.voxels.spatial_merge, self.voxels.spatial_merge
        if have == want:
            return timed
        # The last voxel of a side may be narrower.
        edges = [np.append(np.arange(0, self.size, merge), self.size) for merge in (have, want)]
        # The axes are resampled one after the other, since voxels are products of intervals.
        rows = _means(np.moveaxis(timed, 1, 0), *edges)  # (row, t, column)
        planes = _means(np.moveaxis(rows, 2, 0), *edges)  # (column, row, t)
        return np.ascontiguousarray(planes.transpose(2, 1, 0))

    def resample_time(self, values: NDArray[Any], segment: SubSegment, substeps: int) -> NDArray[np.float32]:
        """Values of a sub-segment's frames (T/T_m, …), in the frames of this grid."""
        frames = self.frames_of(segment)
        origin = substeps * segment.first_line
        have = origin + np.arange(len(values) + 1) * segment.voxels.temporal_merge
        want = np.clip(self.edges(frames), *(segment.seen or (have[0], have[-1])))
        begins = np.searchsorted(have, want[:-1], "right") - 1
        if self.voxels.temporal_merge == segment.voxels.temporal_merge and np.array_equal(
            have[begins], want[:-1]
        ):
            return np.asarray(values[begins[0] : begins[0] + len(begins)], np.float32)
        return _means(np.asarray(values, np.float32), have, want)


def _rise(edges: NDArray[np.int64], seam: int, fade: int) -> NDArray[np.float64]:
    """Integral up to each edge of a ramp from 0 at seam − fade to 1 at seam + fade."""
    past = edges.astype(np.float64) - seam
    if not fade:
        return np.maximum(past, 0)
    ramp = np.square(np.clip(past + fade, 0, 2 * fade)) / (4 * fade)
    return ramp + np.maximum(past - fade, 0)


def _means(values: NDArray[np.float32], have: NDArray[np.int64], want: NDArray[np.int64]) -> NDArray[Any]:
    """Means over ``want[i] .. want[i+1]`` of values held over ``have[j] .. have[j+1]``, along axis 0."""
    # The matrix has a row for each of ``want`` and a column for each of ``have``.
    low, high = np.maximum.outer(want[:-1], have[:-1]), np.minimum.outer(want[1:], have[1:])
    overlap = np.maximum(high - low, 0).astype(np.float32)
    total = overlap.sum(axis=1, keepdims=True)
    overlap /= np.where(total > 0, total, 1)
    means: NDArray[Any] = np.tensordot(overlap, values, 1)
    return means


class Stitcher:
    """Adds up sub-segments in order, and returns the frames that no later one contributes to."""

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        self.frames = 0
        self._waiting: list[NDArray[np.float32]] | None = None

    def add(
        self, segment: SubSegment, channels: Iterable[NDArray[np.float32]], following: SubSegment | None
    ) -> list[NDArray[np.float32]]:
        """Add a sub-segment's ``channels`` (video, quality …) on the grid, and return the finished frames."""
        frames = self.grid.frames_of(segment)
        weights = self.grid.weights(segment)
        weighted = [each * weights.reshape(-1, *[1] * (each.ndim - 1)) for each in channels]
        if self._waiting is not None:
            for channel, waiting in zip(weighted, self._waiting, strict=True):
                # What waits begins with this sub-segment's first frame (`stop` below).
                channel[: len(waiting)] += waiting
        stop = frames.stop if following is None else self.grid.frames_of(following).start
        done = stop - frames.start
        # These are copies, because views would keep whole sub-segments in memory.
        self._waiting = [channel[done:].copy() for channel in weighted]
        self.frames = stop
        return [channel[:done] for channel in weighted]
