"""Lines on their way from a camera to the disk and back: blocks, their flags, and cut segments."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import UsageError
from acquire.flags import ARMS, LineFlag
from acquire.geometry import Geometry
from acquire.showing import in_words

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.alignment import Alignment
    from acquire.blur import Blur
    from acquire.converter import ConverterCurve
    from acquire.noise import Noise

__all__ = ["ARMS", "LineBlock", "LineFlag", "LineTable", "Segment", "TaggedBlock", "merged"]


@dataclass(frozen=True, slots=True, eq=False)
class LineBlock:
    """Consecutive lines on their way from a camera to the disk. Each place adds what it alone knows:

    ::

        driver ─ CameraBlock ─▶ grabber ─ LineBlock ─▶ ring ─ RingBlock ─▶ tagger ─ TaggedBlock ─▶ writer
                 losses, its clock        the one copy        losses, when        code, time

    ``first_line`` is the trigger's line number, and in front of the grabber the camera's; ``pixels`` is
    (line, pixel), uint8 or uint16; ``flags`` is (line) uint16 of LineFlag. Neither is checked here: grabber
    and writer do, which know what the camera has to deliver and what the recording can take.
    """

    first_line: int
    pixels: NDArray[Any]
    flags: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.flags)

    @property
    def end_line(self) -> int:
        """Number of the line after the block's last."""
        return self.first_line + len(self.flags)

    def part(self, first_line: int, end_line: int) -> LineBlock:
        """Return those of the block's lines that lie from ``first_line`` on and before ``end_line``, in
        place.
        """
        start = max(0, first_line - self.first_line)
        rows = slice(start, max(start, end_line - self.first_line))
        return LineBlock(self.first_line + start, self.pixels[rows], self.flags[rows])


@dataclass(frozen=True, slots=True, eq=False)
class LineTable:
    """Code, ticks and times of consecutive lines; arrays of one value per line."""

    code_index: NDArray[np.uint64]
    code: NDArray[np.uint8]
    tick: NDArray[np.uint64]
    time_ns: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.tick)

    def __getitem__(self, part: slice) -> LineTable:
        return LineTable(self.code_index[part], self.code[part], self.tick[part], self.time_ns[part])


@dataclass(frozen=True, slots=True, eq=False)
class TaggedBlock(LineBlock):
    """Lines of one arm with the code and the time of each."""

    arm: str
    tags: LineTable


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
    curve : converts recorded DN to those of a linear camera, to which black level, responsivity and noise
        then refer; None if the camera is linear
    alignment : position of arm B's image relative to arm A's; None if they coincide
    blur : of each arm's optics; None if it is unknown or absent
    noise : of the samples in DN; None if it is unknown
    balanced : whether ``responsivity_dn`` includes the arms' shares of the light, as far as they are known
    first_column : sensor columns of arms A and B at which these pixels begin; behind a fibre not 0
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
    curve: ConverterCurve | None = None
    alignment: Alignment | None = None
    blur: Blur | None = None
    noise: Noise | None = None
    balanced: bool = False
    first_column: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        shape = self.geometry.lines_shape
        if self.lines.shape != shape or self.mask.shape != shape:
            raise UsageError(
                f"a segment cannot have lines {self.lines.shape} and mask {self.mask.shape}",
                possible=f"{shape}",
            )
        if self.code.shape != (self.geometry.span,):
            raise UsageError(
                f"a segment cannot have {self.code.shape} code bits", possible=f"T = {self.geometry.span}"
            )
        gains = np.asarray(self.responsivity_dn, np.float64)
        if not (np.isfinite(gains).all() and (gains > 0).all() and np.isfinite(self.black_level_dn).all()):
            raise UsageError(
                f"a segment cannot have responsivity {self.responsivity_dn} and black level "
                f"{self.black_level_dn} DN",
                possible="a finite black level and a responsivity above 0, those of the camera",
            )
        if self.time_ns.shape != (self.geometry.lines,):
            raise UsageError(
                f"a segment cannot have {self.time_ns.shape} time stamps", possible=f"{self.geometry.lines}"
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
        """Return Y of Eq. (1) (2, L_R, M): black level removed, in units of the scene; 0 where masked."""
        black, gain = (_beside_lines(value, dtype) for value in (self.black_level_dn, self.responsivity_dn))
        scaled = (self._linear(dtype) - black) / gain
        return np.where(self.mask, scaled, dtype(0))

    def variance(self) -> NDArray[np.float64] | None:
        """Return the noise variance of `samples` (2, L_R, M), in squared scene units; None if unknown."""
        if self.noise is None:
            return None
        known = self.black_level_dn, self.responsivity_dn
        black, gain = (_beside_lines(value, np.float64) for value in known)
        in_dn2 = self.noise.variance_dn2(self._linear(np.float64) - black)
        return np.asarray(in_dn2 / gain**2)

    def _linear(self, dtype: type[np.floating[Any]]) -> NDArray[Any]:
        """Return the lines in DN of a linear camera."""
        dn = self.lines.astype(dtype)
        return dn if self.curve is None else self.curve.straight(dn)

    def mirrored(self, arm: int) -> Segment:
        """Return the segment with one arm (0 or 1) mirrored: its pixels and everything given per column."""
        return self._of_arms(
            lambda values: np.stack([each[..., ::-1] if i == arm else each for i, each in enumerate(values)])
        )

    def swapped(self) -> Segment:
        """Return the segment with the arms exchanged, and everything that is given per arm."""
        segment = self._of_arms(lambda values: values[::-1].copy(), per_arm=True)
        noise, curve = self.noise and self.noise.swapped(), self.curve and self.curve.swapped()
        blur = self.blur and self.blur.swapped()
        return replace(segment, noise=noise, curve=curve, blur=blur)

    def _of_arms(self, change: Callable[[NDArray[Any]], NDArray[Any]], *, per_arm: bool = False) -> Segment:
        """Apply ``change`` to every array per arm and pixel, and with ``per_arm`` to those per arm, too."""
        known: dict[str, Any] = {name: getattr(self, name) for name in ("black_level_dn", "responsivity_dn")}
        for name, value in known.items():
            if np.ndim(value) == 2:
                known[name] = change(np.asarray(value))
            elif np.ndim(value) == 1 and per_arm:
                known[name] = tuple(change(np.asarray(value)).tolist())
        return replace(self, lines=change(self.lines), mask=change(self.mask), **known)

    def frame_time_ns(self, temporal_merge: int = 1) -> NDArray[np.int64]:
        """Return the UTC at which each frame of T_m sub-steps begins.

        A line's time stamp is the beginning of its sub-step n − 1, so that the first trusted sub-step
        carries the time of the segment's first line (Fig. 9).
        """
        frames = self.geometry.video_shape(1, temporal_merge)[0]
        offset = np.arange(frames) * temporal_merge - self.geometry.readout_substep
        time_ns: NDArray[np.int64] = self.time_ns[0] + np.rint(offset * self.substep_ns).astype(np.int64)
        return time_ns


def _beside_lines(value: object, dtype: type[np.floating[Any]]) -> NDArray[Any]:
    """Shape a number, one per arm, or one per arm and pixel to broadcast against (arm, line, pixel)."""
    given = np.asarray(value, dtype)
    return given[:, None, :] if given.ndim == 2 else given.reshape(-1, 1, 1)


def merged(segment: Segment, count: int) -> Segment:
    """Merge lines of whole steps ``count`` × ``count`` to those of a sensor with ``count`` intra-line steps.

    Line ℓ of Eq. (1) with M stages and S = ``count`` is the sum of the raw lines S·ℓ … S·ℓ + S − 1 of a
    sensor of M·S stages whose charge moves once a line, S columns each (Sect. 5.1: 192 stages at 100 kHz
    become 64 at 33.33 kHz). A merged sample is usable if all of its raw samples are. Corrections of single
    columns are applied before the sum, and the result is then in units of the scene. Raw lines can also be
    reconstructed directly, with S = 1 and without loss; for S = 3 the merged samples are a ninth as many.

    Raises UsageError for lines that already have intra-line steps, and for a segment that does not begin and
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
    # Corrections of single columns cannot be applied to a sum of columns any more.
    columns = segment.curve is not None
    columns |= np.ndim(segment.black_level_dn) == 2 or np.ndim(segment.responsivity_dn) == 2
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
        # Both the merged line and its first raw line are read out n − 1 sub-steps after their start.
        time_ns=segment.time_ns[::count],
        first_line=segment.first_line // count,
        black_level_dn=tuple(black.tolist()) if black.ndim else float(black),
        responsivity_dn=1.0 if columns else segment.responsivity_dn,
        curve=None,
        # Noise is known in DN, and corrected lines are in units of the scene.
        noise=None if columns or segment.noise is None else segment.noise.merged(count),
    )
