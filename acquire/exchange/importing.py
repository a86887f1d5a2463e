"""Import of other programs' lines as a sealed recording, which states what is not known about them.

Such lines have no tags of a trigger: the code bits of each line and the time of its read-out follow from the
user's arguments, and every line is flagged accordingly (``code_unverified``, ``time_estimated``). `acquire
diagnose` checks the lines against the code.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.clock import ClockFit
from acquire.codes import ListedCode, PrbsCode, state_at
from acquire.config.recording import usual_chunk_lines
from acquire.errors import UsageError
from acquire.geometry import Geometry
from acquire.lines import ARMS, LineBlock, LineFlag
from acquire.store import RecordingSpec, RecordingWriter, RunCondition
from acquire.store.delivery import delivery_to
from acquire.stream.tagger import Tagger
from acquire.trigger.base import TriggerRun

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.codes import Code
    from acquire.exchange.foreign import LineFile
    from acquire.fibre import Fibre

BLOCK_LINES = 4096
COMMIT_BLOCKS = 64
SUBSTEP_TICKS = 1000
"""Ticks per sub-step of the clock if only the line rate is known."""
MOST = 2**62
"""Limit of ticks, and of the time since line 0 (ns): with the time of line 0, 64 bits still suffice."""
# `acquire info` shows the UTC of a clock that is so uncertain as unknown.
UNKNOWN_NS = 2**62
"""Uncertainty of an unknown clock."""
NO_ARM = "not_imported"
"""Reason for the missing lines of an arm without a file."""


@dataclass(frozen=True, slots=True)
class Instrument:
    """The instrument that captured the lines.

    Attributes
    ----------
    stages, substeps : M, S
    code, code_start : the light's code; its bit in the first sub-step of line 0
    clock_hz, substep_ticks : ticks per second, and of a sub-step
    cameras : per arm ``white_dn``, ``black_level_dn`` and ``responsivity_dn``, as far as they are known
    start_ns : UTC at which the first line's read-out begins; None if unknown
    config : the configuration of the rig, if there is one
    fibre : position of the fibre bands, for the layout ``fibre``
    """

    stages: int
    substeps: int
    code: Code
    clock_hz: int
    substep_ticks: int
    cameras: Mapping[str, Mapping[str, float]]
    code_start: int = 0
    first_line: int = 0
    start_ns: int | None = None
    config: Mapping[str, Any] | None = None
    layout: str = "dual"
    fibre: Fibre | None = None

    @property
    def pixels(self) -> int:
        """Number of pixels in a line of either arm."""
        return self.stages if self.fibre is None else self.fibre.sensor_pixels

    @property
    def line_rate_hz(self) -> float:
        return self.clock_hz / (self.substep_ticks * self.substeps)


@dataclass(frozen=True, slots=True, eq=False)
class Arm:
    """The lines of one arm: a file, and the number of the arm if the file has two."""

    file: LineFile
    number: int | None = None


@dataclass(frozen=True, slots=True)
class Imported:
    """The recording that was written, and what is not known about its lines."""

    path: Path | str
    lines: int
    arms: tuple[str, ...]
    unknown: tuple[str, ...]


def clock_of(line_rate_hz: float, substeps: int) -> tuple[int, int]:
    """Return ticks per second and per sub-step of a clock for a line rate, to a part in 10⁸ or better."""
    ticks = SUBSTEP_TICKS
    while line_rate_hz * substeps * ticks < 1e8:
        # integers: more ticks per sub-step make the rounding of the rate smaller
        ticks *= 10
    return round(line_rate_hz * substeps * ticks), ticks


def import_lines(
    arms: Mapping[str, Arm],
    instrument: Instrument,
    out: Path | str,
    run_id: str,
    progress: Callable[[float, float], object] | None = None,
    *,
    most_lines: int | None = None,
) -> Imported:
    """Write up to ``most_lines`` lines of one or both arms as a new, sealed recording at a path or URL.

    It is written completely or not at all. Raises UsageError, before anything is written, if the lines, the
    code and the geometry do not fit together; DataError for a file that cannot be read, StoreError for errors
    of the disk.
    """
    lines = _checked(arms, instrument, most_lines)
    unknown = tuple(_unknown(arms, instrument))
    spec = _spec(arms, instrument, run_id, unknown, lines)
    delivery = delivery_to(out)
    try:
        with RecordingWriter.create(delivery.partial, spec) as writer:
            _write(writer, arms, instrument, lines, progress)
            stored = {arm: lines if arm in arms else 0 for arm in ARMS}
            ledger = {arm: {"stored": stored[arm], "missing": {NO_ARM: lines - stored[arm]}} for arm in ARMS}
            whole = len(arms) == len(ARMS)
            # Tainted at best: no line's code and time come from a trigger.
            condition = RunCondition.TAINTED if whole else RunCondition.INCOMPLETE
            writer.seal(condition, "imported from files of another program", ledger)
        delivery.deliver()
    finally:
        delivery.clear()
    return Imported(out, lines, tuple(arms), unknown)


def _checked(arms: Mapping[str, Arm], instrument: Instrument, most_lines: int | None) -> int:
    """Return the number of lines. Raises UsageError if the files do not fit each other or the instrument."""
    counts = {arm: source.file.lines for arm, source in arms.items()}
    if most_lines is not None:
        if not 1 <= most_lines <= min(counts.values()):
            raise UsageError(
                f"{most_lines} lines cannot be imported", possible=f"1 to {min(counts.values())}"
            )
        counts = dict.fromkeys(counts, most_lines)
    if len(set(counts.values())) > 1:
        raise UsageError(
            f"arm a has {counts['a']} lines, and arm b {counts['b']}",
            possible="the same number of lines in both arms",
            hint=f"--lines {min(counts.values())}, to take this number of each",
        )
    # The same samples may come in either byte order.
    if len({source.file.dtype.newbyteorder("=") for source in arms.values()}) > 1:
        raise UsageError("the arms have different types", possible="uint8 or uint16 for both")
    for arm, source in arms.items():
        if instrument.fibre is not None and source.file.pixels != instrument.pixels:
            raise UsageError(
                f"lines of arm {arm} have {source.file.pixels} pixels, with sensors of {instrument.pixels}",
                possible="lines as wide as the sensors behind the fibre: [fibre] sensor_pixels of the rig "
                "file",
                hint=f"--columns-{arm} FIRST:END, to select the pixels of the sensor",
            )
        if source.file.pixels != instrument.pixels:
            raise UsageError(
                f"lines of arm {arm} have {source.file.pixels} pixels, with {instrument.stages} stages",
                possible="as many pixels as stages (M)",
                hint=f"--columns-{arm} FIRST:END, to select the lit pixels; --stages, to set their number",
            )
    lines = next(iter(counts.values()))
    _check_span(instrument, lines)
    return lines


def _check_span(instrument: Instrument, lines: int) -> None:
    """Raise UsageError if the lines outlast the code's listed bits, or ticks and times of 64 bits."""
    code = instrument.code
    span = Geometry(instrument.stages, instrument.substeps, lines).span
    needed = instrument.code_start + instrument.substeps * instrument.first_line + span
    if isinstance(code, ListedCode) and not code.repeats and code.length < needed:
        raise UsageError(
            f"the code has {code.length} bits, but {lines} lines need {needed}",
            possible="S·(M + lines) − 1 bits, starting with the first line's",
            hint="--code-repeats, if the sequence repeats, or fewer --lines",
        )
    ticks, seconds = MOST // (instrument.substep_ticks * instrument.substeps), MOST // 10**9
    most = min(ticks, int(seconds * instrument.line_rate_hz)) - lines - instrument.stages
    if instrument.first_line > most:
        raise UsageError(
            f"line {instrument.first_line} is beyond a recording's clock", possible=f"up to line {most}"
        )


def shifted(code: Code, start: int) -> Code:
    """Return the code whose bit 0 is bit ``start`` of the given code."""
    if start == 0:
        return code
    if isinstance(code, PrbsCode):
        return PrbsCode(code.degree, state_at(code.degree, code.state, start))
    if isinstance(code, ListedCode):
        count = code.length if code.repeats else code.length - start
        if count < 1:
            raise UsageError(
                f"--code-start {start} is beyond the {code.length} bits of the code",
                possible=f"0 to {code.length - 1}",
                hint="--code-repeats, if the code began anew after its last bit",
            )
        return ListedCode.of(code.bits(start, count), repeats=code.repeats)
    # A constant code is the same from any bit on.
    return code


def _unknown(arms: Mapping[str, Arm], instrument: Instrument) -> list[str]:
    """List what is not known about the lines. The texts are stored in the recording."""
    found = ["the trigger's tags: code and time of every line follow from the arguments of the import"]
    found.append("lines that were lost before: a loss shifts the code of all that follow")
    if instrument.start_ns is None:
        found.append("UTC: the first line's is taken as 1970-01-01T00:00:00")
    else:
        found.append("how exact the UTC of the first line is")
    for key, words in (
        ("white_dn", "from which value on a pixel is saturated: the type's largest is taken"),
        ("black_level_dn", "the black level: 0 is taken"),
        ("responsivity_dn", "the responsivity: 1 is taken, and brightness is in DN"),
    ):
        if any(key not in instrument.cameras.get(arm, {}) for arm in arms):
            found.append(words)
    found += [f"arm {arm}: all its lines are missing" for arm in ARMS if arm not in arms]
    return found


def _spec(
    arms: Mapping[str, Arm], instrument: Instrument, run_id: str, unknown: tuple[str, ...], lines: int
) -> RecordingSpec:
    file = next(iter(arms.values())).file
    dtype = file.dtype.newbyteorder("=")
    # A short import gets chunks not much longer than its lines, since the rest would be padding.
    chunk_lines = min(
        usual_chunk_lines(file.pixels * dtype.itemsize, instrument.line_rate_hz),
        1 << max(4, lines.bit_length()),
    )
    usual = {"white_dn": float(np.iinfo(dtype).max), "black_level_dn": 0.0, "responsivity_dn": 1.0}
    # Tick 0 of the clock is placed so that the first line is read out at the given time.
    geometry = Geometry(instrument.stages, instrument.substeps, 1)
    substep = instrument.substeps * instrument.first_line + geometry.readout_substep
    relative = ClockFit(instrument.clock_hz, 0, UNKNOWN_NS)
    first_ns = int(relative.time_ns(np.array([substep * instrument.substep_ticks], np.uint64))[0])
    clock = ClockFit(instrument.clock_hz, (instrument.start_ns or 0) - first_ns, UNKNOWN_NS)
    return RecordingSpec(
        run_id=run_id,
        stages=instrument.stages,
        substeps=instrument.substeps,
        pixels=file.pixels,
        dtype=dtype.name,
        first_line=instrument.first_line,
        clock=clock,
        code=shifted(instrument.code, instrument.code_start).to_attrs(),
        substep_ticks=instrument.substep_ticks,
        trigger={"model": "none: the lines are imported"},
        cameras={
            arm: {**usual, **instrument.cameras.get(arm, {}), "model": "another program's, imported"}
            for arm in ARMS
        },
        config=dict(instrument.config or {}),
        extra={
            "imported": {
                "files": {
                    arm: {"path": str(source.file.path), "kind": source.file.kind, **source.file.facts}
                    | ({} if source.number is None else {"arm": source.number})
                    for arm, source in arms.items()
                },
                "code_start": instrument.code_start,
                "unknown": list(unknown),
            }
        },
        chunk_lines=chunk_lines,
        codec="lz4",
        layout=instrument.layout,
        fibre=instrument.fibre,
    )


def _write(
    writer: RecordingWriter,
    arms: Mapping[str, Arm],
    instrument: Instrument,
    lines: int,
    progress: Callable[[float, float], object] | None,
) -> None:
    spec = writer.spec
    code = shifted(instrument.code, instrument.code_start)
    run = TriggerRun(spec.run_id, code, spec.substeps, spec.substep_ticks, 1)
    tagger = Tagger(run, spec.stages, spec.clock)
    for arm in ARMS:
        if arm not in arms:
            writer.add_gap(arm, spec.first_line, lines, NO_ARM)
    for number, start in enumerate(range(0, lines, BLOCK_LINES)):
        stop = min(lines, start + BLOCK_LINES)
        for arm in ARMS:
            # The arms in turn, since both have to be on the disk for a commit.
            source = arms.get(arm)
            if source is None:  # both arms of a recording have the same rows
                pixels: NDArray[Any] = np.zeros((stop - start, spec.pixels), spec.line_dtype)
                flags = np.full(stop - start, LineFlag.MISSING, np.uint16)
            else:
                pixels = np.ascontiguousarray(source.file.rows(source.number, start, stop))
                full = (pixels >= spec.cameras[arm]["white_dn"]).any(axis=1)
                flags = np.where(full, LineFlag.SATURATED, 0).astype(np.uint16)
            writer.append(tagger.tag(arm, LineBlock(spec.first_line + start, pixels, flags)))
        if number % COMMIT_BLOCKS == 0:
            writer.commit()
        if progress is not None:
            progress(stop, lines)
