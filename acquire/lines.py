"""What travels from a camera to the disk and back: blocks of lines, their flags, and cut segments."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntFlag
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import UsageError
from acquire.geometry import Geometry
from acquire.showing import in_words

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.alignment import Alignment
    from acquire.noise import Noise

ARMS = ("a", "b")
"""Names of the two arms, in the order of the ``arm`` axis."""


class LineFlag(IntFlag):
    """What is known about one line beyond its pixels (CF ``flag_masks`` of the recording)."""

    MISSING = 1
    """Never arrived; the row is filled with 0."""
    INCOMPLETE = 2
    """The camera reported that part of the line is not valid."""
    SATURATED = 4
    """At least one pixel stands at the top of the range."""
    TIME_ESTIMATED = 8
    """No tag of the trigger confirmed tick and time; they are extrapolated."""
    CODE_UNVERIFIED = 16
    """No tag of the trigger confirmed the code index; it is extrapolated."""
    CODE_CONTRADICTED = 32
    """The arm's lines did not follow the code that they are tagged with (`acquire.stream.lightcheck`)."""


@dataclass(frozen=True, slots=True, eq=False)
class LineBlock:
    """Consecutive lines of one arm as the camera delivered them.

    ``first_line`` is the trigger's line number; ``pixels`` is (line, pixel), uint8 or uint16;
    ``flags`` is (line) uint16 of LineFlag.
    """

    arm: str
    first_line: int
    pixels: NDArray[Any]
    flags: NDArray[np.uint16]

    def __post_init__(self) -> None:
        if self.arm not in ARMS or self.first_line < 0:
            raise UsageError(f"line block of arm {self.arm!r} from line {self.first_line}")
        if self.pixels.ndim != 2 or self.flags.shape != self.pixels.shape[:1]:
            raise UsageError(f"line block with pixels {self.pixels.shape} and flags {self.flags.shape}")

    def __len__(self) -> int:
        return len(self.flags)

    @property
    def end_line(self) -> int:
        """Number of the line after the last."""
        return self.first_line + len(self)


@dataclass(frozen=True, slots=True, eq=False)
class TaggedBlock:
    """Consecutive lines with what the trigger says about each; all arrays have the length of ``pixels``."""

    arm: str
    first_line: int
    pixels: NDArray[Any]
    flags: NDArray[np.uint16]
    code_index: NDArray[np.uint64]
    code: NDArray[np.uint8]
    tick: NDArray[np.uint64]
    time_ns: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.flags)

    @property
    def end_line(self) -> int:
        return self.first_line + len(self)


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """Lines of both arms cut out of a recording, with everything a reconstruction needs.

    Attributes
    ----------
    lines : (2, L_R, M) in DN, as recorded
    mask : (2, L_R, M) bool, True where the sample can be used
    code : (T,) uint8, E of the sub-steps that the lines touch, from the first line's first sub-step on
    geometry : M, S, L_R of the segment
    time_ns : (L_R,) int64 UTC at which each line's read-out begins
    first_line : the trigger's number of the first line
    substep_ns : duration of a sub-step
    black_level_dn, responsivity_dn : DN = black level + responsivity · Y, with Y of Eq. (1);
        one number for both arms, one per arm, or one per arm and pixel (2, M)
    alignment : where arm B's image lies beside arm A's; None: on it
    noise : of the samples in DN; None: it is not known
    """

    lines: NDArray[Any]
    mask: NDArray[np.bool_]
    code: NDArray[np.uint8]
    geometry: Geometry
    time_ns: NDArray[np.int64]
    first_line: int = 0
    substep_ns: float = 1.0
    black_level_dn: float | tuple[float, float] | NDArray[np.float64] = 0.0
    responsivity_dn: float | tuple[float, float] | NDArray[np.float64] = 1.0
    alignment: Alignment | None = None
    noise: Noise | None = None

    def __post_init__(self) -> None:
        shape = self.geometry.lines_shape
        if self.lines.shape != shape or self.mask.shape != shape:
            raise UsageError(
                f"segment with lines {self.lines.shape}, mask {self.mask.shape}", possible=f"{shape}"
            )
        if self.code.shape != (self.geometry.span,):
            raise UsageError(
                f"segment with {self.code.shape} code bits", possible=f"T = {self.geometry.span}"
            )
        gains = np.asarray(self.responsivity_dn, np.float64)
        if not (np.isfinite(gains).all() and (gains > 0).all() and np.isfinite(self.black_level_dn).all()):
            raise UsageError(
                f"segment with responsivity {self.responsivity_dn}, black level {self.black_level_dn} DN",
                possible="a responsivity above 0 and a black level, as the camera has them",
            )
        if self.time_ns.shape != (self.geometry.lines,):
            raise UsageError(
                f"segment with {self.time_ns.shape} time stamps", possible=f"{self.geometry.lines}"
            )

    def __repr__(self) -> str:
        sizes = self.geometry
        return in_words(
            "Segment",
            lines=f"{self.first_line} to {self.first_line + sizes.lines - 1} of each arm",
            geometry=f"M = {sizes.stages}, S = {sizes.substeps}",
            sub_steps=f"{sizes.span} of {self.substep_ns:.6g} ns",
            samples=f"{self.lines.dtype.name}, {self.mask.mean():.2%} usable",
            arm_b=None if self.alignment is None else "aligned",
        )

    def samples(self, dtype: type[np.floating[Any]] = np.float32) -> NDArray[Any]:
        """Y of Eq. (1) (2, L_R, M): black level removed, in units of the scene; 0 where masked."""
        black, gain = (_beside_lines(value, dtype) for value in (self.black_level_dn, self.responsivity_dn))
        scaled = (self.lines.astype(dtype) - black) / gain
        return np.where(self.mask, scaled, dtype(0))

    def variance(self) -> NDArray[np.float64] | None:
        """Of the noise in `samples` (2, L_R, M), in squared units of the scene; None: not known."""
        if self.noise is None:
            return None
        known = self.black_level_dn, self.responsivity_dn
        black, gain = (_beside_lines(value, np.float64) for value in known)
        in_dn2 = self.noise.variance_dn2(self.lines.astype(np.float64) - black)
        return np.asarray(in_dn2 / gain**2)

    def frame_time_ns(self, temporal_merge: int = 1) -> NDArray[np.int64]:
        """UTC at which each frame of T_m sub-steps begins.

        A line's time stamp is the beginning of its sub-step n − 1, so that the first trusted sub-step
        carries the time of the segment's first line (Fig. 9).
        """
        frames = self.geometry.video_shape(1, temporal_merge)[0]
        offset = np.arange(frames) * temporal_merge - self.geometry.readout_substep
        time_ns: NDArray[np.int64] = self.time_ns[0] + np.rint(offset * self.substep_ns).astype(np.int64)
        return time_ns


def _beside_lines(value: object, dtype: type[np.floating[Any]]) -> NDArray[Any]:
    """A number, or one per arm, or one per arm and pixel, as it stands beside lines (arm, line, pixel)."""
    given = np.asarray(value, dtype)
    return given[:, None, :] if given.ndim == 2 else given.reshape(-1, 1, 1)


def merged(segment: Segment, count: int) -> Segment:
    """Lines of whole steps merged ``count`` × ``count``: those of a sensor with ``count`` intra-line steps.

    Line ℓ of Eq. (1) with M stages and S = ``count`` is the sum of the raw lines S·ℓ … S·ℓ + S − 1 of a
    sensor of M·S stages whose charge moves once a line, S columns each (Sect. 5.1: 192 stages at 100 kHz
    become 64 at 33.33 kHz). A merged sample can be used where all of its raw samples can. What is known of
    single columns is used before they are added up: the result is then in units of the scene. Raw lines lose
    nothing and reconstruct as they are, with S = 1; merged ones are a ninth as many.

    Raises UsageError for lines that have intra-line steps already, and for a segment that does not begin and
    end between merged lines.
    """
    geometry = segment.geometry
    sizes = (geometry.stages, geometry.lines, segment.first_line)
    if geometry.substeps != 1 or count < 1 or any(size % count for size in sizes):
        raise UsageError(
            f"{geometry.lines} lines of {geometry.stages} stages and S = {geometry.substeps} from line "
            f"{segment.first_line} on cannot be merged {count} x {count}",
            possible=f"S = 1; stages, lines and first line multiples of {count}",
        )
    columns = np.ndim(segment.black_level_dn) == 2 or np.ndim(segment.responsivity_dn) == 2
    black = np.zeros(()) if columns else np.asarray(segment.black_level_dn, np.float64) * count**2
    raw = segment.samples(np.float64) if columns else segment.lines
    blocks = (len(raw), geometry.lines // count, count, geometry.stages // count, count)
    usable = np.asarray(segment.mask.reshape(blocks).all(axis=(2, 4)))
    total = raw.reshape(blocks).sum(axis=(2, 4), dtype=np.float64 if columns else np.uint32)
    return replace(
        segment,
        lines=total,
        mask=usable,
        geometry=Geometry(geometry.stages // count, count, geometry.lines // count),
        time_ns=segment.time_ns[::count],
        first_line=segment.first_line // count,
        black_level_dn=tuple(black.tolist()) if black.ndim else float(black),
        responsivity_dn=1.0 if columns else segment.responsivity_dn,
        noise=None if columns or segment.noise is None else segment.noise.merged(count),
    )
