"""The shear of a TDI recording as plain integers: sizes, spans, and the trusted part of them.

Eq. (1) of the paper counts lines, rows, columns and sub-steps from 1; this module is the only place
that translates. In code, line ``i`` (from 0) sums row ``r`` of the scene at the sub-steps
``t = r + u + i*S`` for ``u = 0..S-1``, so with ``n = M*S`` rows and ``L_R`` lines the sub-steps
``0 .. S*(M + L_R) - 2`` are touched: ``T = S*(M + L_R) - 1`` of them.
"""

from __future__ import annotations

from dataclasses import dataclass

from acquire.errors import UsageError

MAX_TEMPORAL_MERGE = 2**31 - 1
"""Largest merge that the kernels can count, far beyond any recording."""


@dataclass(frozen=True, slots=True)
class Geometry:
    """Sizes of one segment of both arms.

    Parameters
    ----------
    stages : M, integral stages of the sensor (also pixels per line that see the scene)
    substeps : S, intra-line charge-transfer steps per line
    lines : L_R, lines read out per arm
    """

    stages: int
    substeps: int
    lines: int

    def __post_init__(self) -> None:
        for name in ("stages", "substeps", "lines"):
            value = getattr(self, name)
            if not is_integer(value) or value < 1:
                raise UsageError(f"geometry: {name} cannot be {value!r}", possible="an integer of at least 1")

    @property
    def size(self) -> int:
        """n = M·S, rows and columns of the scene at full resolution."""
        return self.stages * self.substeps

    @property
    def span(self) -> int:
        """T = S·(M + L_R) − 1, sub-steps that the lines touch (Eq. 1)."""
        return self.substeps * (self.stages + self.lines) - 1

    @property
    def lines_shape(self) -> tuple[int, int, int]:
        """(arm, line, pixel)."""
        return (2, self.lines, self.stages)

    @property
    def readout_substep(self) -> int:
        """Sub-step, counted from a line's first, at which it enters the last row and its read-out begins."""
        return self.size - 1

    @property
    def depth_lines(self) -> int:
        """Number of lines read out after a start whose exposure began before it: M + 1."""
        return self.stages + 1

    def line_substeps(self, line: int) -> range:
        """Return the sub-steps that expose ``line`` (from 0): n + S − 1 of them."""
        first = line * self.substeps
        return range(first, first + self.size + self.substeps - 1)

    @property
    def trusted(self) -> slice:
        """Sub-steps at which every row of the scene is sampled: 1-based t in [n, L_R·S] (Fig. 5, t1…t2).

        The slice is empty if the segment has fewer than M lines.
        """
        first = self.size - 1
        return slice(first, max(first, self.lines * self.substeps))

    def video_shape(self, spatial_merge: int = 1, temporal_merge: int = 1) -> tuple[int, int, int]:
        """Return (time, row, column) of the voxels X′: ⌈T/T_m⌉, ⌈n/N_m⌉, ⌈n/N_m⌉ (Section 3.1)."""
        self.check_merge(spatial_merge, temporal_merge)
        side = -(-self.size // spatial_merge)
        return (-(-self.span // temporal_merge), side, side)

    def trusted_frames(self, temporal_merge: int = 1) -> slice:
        """Return the frames of T_m sub-steps that lie wholly inside the trusted interval.

        The last frame of a segment may be shorter than T_m; it counts if its own sub-steps are trusted.
        """
        self.check_merge(1, temporal_merge)
        trusted = self.trusted
        first = -(-trusted.start // temporal_merge)
        last = trusted.stop // temporal_merge
        # Only with n = 1 is the span trusted to its end, and with it a last frame that may be short.
        if trusted.stop >= self.span:
            last = -(-self.span // temporal_merge)
        return slice(first, max(first, last))

    def seam_substeps(self, temporal_merge: int = 1) -> int:
        """Return the sub-steps dropped on each side of an inner seam: n − 1 in whole frames (Fig. 5, 8)."""
        self.check_merge(1, temporal_merge)
        return -(-(self.size - 1) // temporal_merge) * temporal_merge

    def sampling_rate(self, spatial_merge: int = 1, temporal_merge: int = 1) -> float:
        """Return S_r = 2·L_R·M·N_m²·T_m / (n²·T), the samples per voxel (Fig. 4)."""
        self.check_merge(spatial_merge, temporal_merge)
        samples = 2 * self.lines * self.stages * spatial_merge**2 * temporal_merge
        return samples / (self.size**2 * self.span)

    def check_merge(self, spatial_merge: int, temporal_merge: int) -> None:
        """Raise UsageError unless they are integers with 1 ≤ N_m ≤ n and 1 ≤ T_m ≤ 2³¹ − 1."""
        if not is_integer(spatial_merge) or not 1 <= spatial_merge <= self.size:
            raise UsageError(
                f"the spatial merge N_m = {spatial_merge!r} is out of range",
                possible=f"an integer, 1 to {self.size} (n = M·S of this segment)",
            )
        if not is_integer(temporal_merge) or not 1 <= temporal_merge <= MAX_TEMPORAL_MERGE:
            raise UsageError(
                f"the temporal merge T_m = {temporal_merge!r} is out of range",
                possible=f"an integer, 1 to {MAX_TEMPORAL_MERGE}",
            )


def is_integer(value: object) -> bool:
    """Whether a value is an integer by type: neither 3.0 nor True."""
    return isinstance(value, int) and not isinstance(value, bool)


def is_index(value: object) -> bool:
    """Whether a value can count something: as `is_integer`, and also numpy's integers."""
    return hasattr(value, "__index__") and not isinstance(value, bool)


def check_integers(**values: object) -> None:
    """Raise UsageError for the first of these arguments that is no integer."""
    for name, value in values.items():
        if not is_index(value):
            raise UsageError(
                f"{name} cannot be {value!r}", possible="an integer", hint="int(...), which truncates"
            )
