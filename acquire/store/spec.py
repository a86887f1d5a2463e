"""The description of a recording at its creation, and the facts added at its end."""

from __future__ import annotations

import json
import platform
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

import acquire
from acquire.codes import code_from_attrs
from acquire.errors import UsageError
from acquire.fibre import Fibre
from acquire.geometry import Geometry
from acquire.lines import ARMS
from acquire.store.array_writer import ENCODED_AHEAD
from acquire.store.host import this_host
from acquire.store.layout import FORMAT
from acquire.store.shape import CODECS, Codec, PluginCodec
from acquire.store.shard import MAX_CHUNK_BYTES, MAX_SHARD_CHUNKS

if TYPE_CHECKING:
    from acquire.clock import ClockFit
    from acquire.store.terms import Continuation, Retention

TAG_BYTES = 8
"""Bytes of the widest tag (code, times, flags), of which there is one per line."""
CAMERA_KEYS = ("white_dn", "black_level_dn", "responsivity_dn")
"""Camera facts that a reader needs to convert DN into samples of Eq. (1)."""

State = Literal["recording", "sealed"]


class RunCondition(StrEnum):
    """Condition of the recorded lines."""

    GOOD = "GOOD"
    """Every line is there, and tags confirm the code."""
    TAINTED = "TAINTED"
    """Every line is there, but something about them is doubtful."""
    INCOMPLETE = "INCOMPLETE"
    """Lines are missing; they are flagged and listed."""
    INTERRUPTED = "INTERRUPTED"
    """Ended early by an operator or the system."""
    ABORTED = "ABORTED"
    """Ended by a fault."""


@dataclass(frozen=True, slots=True)
class Durability:
    """Largest possible loss, in lines of either arm that both had delivered to the writer.

    Attributes
    ----------
    fsync : when bytes are forced to the medium
    kill_lines : loss if the writer's process is killed and the recording recovered: the chunk being filled,
        and those being packed
    power_lines : loss if the machine loses power; None: all lines that the system had not written back
    """

    fsync: str
    kill_lines: int
    power_lines: int | None


@dataclass(frozen=True, slots=True)
class RecordingSpec:
    """Everything that is known when a recording begins. Raises UsageError for impossible settings.

    Attributes
    ----------
    stages, substeps, pixels : M, S, pixels per line
    first_line : the trigger's number of the line in row 0
    clock : the trigger's ticks → UTC
    code : `Code.to_attrs()` of the run's code
    substep_ticks : duration of a sub-step in ticks
    trigger, config : identity and settings of the trigger; the resolved configuration
    cameras : per arm the settings as read back, with ``white_dn``, ``black_level_dn``, ``responsivity_dn``
    extra : further attributes (``scene``, ``effects``, ``simulated`` ...)
    chunk_lines, shard_chunks : lines per chunk; chunks per file
    tag_chunks : chunks of pixels whose tags (code, times, flags) share one chunk; divides ``shard_chunks``
    codec : codec of the pixels, ours or a plug-in's (`acquire.store.codecs.configured_codec`)
    encoders : threads that pack chunks, if there is a codec
    fsync : force bytes to the medium at every ``"commit"``, or only at the ``"seal"``
    commit_lines : lines on disk that may wait for their commit; a whole number of chunks is best
    retention : which lines of an endless recording are kept; None: all
    reserve_bytes : bytes of the disk that are left free: the recording should end when only these are left
    continues : the recording that this one continues, if it is a further segment
    layout : layout of the instrument: ``dual``, ``compact``, ``emulated``, ``interline``, ``fibre``
    fibre : assignment of columns to tiles; for layout ``fibre`` only
    """

    run_id: str
    stages: int
    substeps: int
    pixels: int
    dtype: str
    first_line: int
    clock: ClockFit
    code: dict[str, Any]
    substep_ticks: int
    trigger: dict[str, Any]
    cameras: dict[str, dict[str, Any]]
    config: dict[str, Any]
    extra: dict[str, Any] = field(default_factory=dict)
    chunk_lines: int = 4096
    shard_chunks: int = 64
    tag_chunks: int = 1
    codec: Codec = "none"
    encoders: int = 2
    fsync: Literal["commit", "seal"] = "seal"
    commit_lines: int = 2**16
    retention: Retention | None = None
    reserve_bytes: int = 2**28
    continues: Continuation | None = None
    layout: str = "dual"
    fibre: Fibre | None = None

    def __post_init__(self) -> None:
        self._check_choices()
        self._check_numbers()
        self._check_fibre()
        self._check_attributes()

    @property
    def line_dtype(self) -> np.dtype[Any]:
        """Type of a sample on disk, which is little-endian on every host."""
        return np.dtype(self.dtype).newbyteorder("<")

    @property
    def geometry(self) -> dict[str, Any]:
        """The attribute ``geometry``."""
        sizes = {"stages": self.stages, "substeps": self.substeps, "pixels": self.pixels}
        return sizes if self.fibre is None else {**sizes, "fibre": self.fibre.to_attrs()}

    @property
    def durability(self) -> Durability:
        """The largest possible loss of this recording."""
        # A line is whole once its tags are on disk, too, and a chunk of tags spans `tag_chunks` of pixels.
        held = self.chunk_lines * max(self.tag_chunks, 1 if self.codec == "none" else 1 + ENCODED_AHEAD)
        committed = self.commit_lines + held if self.fsync == "commit" else None
        return Durability(self.fsync, held, committed)

    def _check_choices(self) -> None:
        choices = {
            "dtype": ("uint8", "uint16"),
            "codec": CODECS,
            "fsync": ("commit", "seal"),
            "layout": ("dual", "compact", "emulated", "interline", "fibre"),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed and not isinstance(getattr(self, name), PluginCodec):
                raise UsageError(
                    f"a recording cannot have {name} = {getattr(self, name)!r}", possible=", ".join(allowed)
                )

    def _check_fibre(self) -> None:
        if (self.layout == "fibre") != (self.fibre is not None):
            raise UsageError(
                f"layout {self.layout!r} does not go with {'no' if self.fibre is None else 'a'} fibre",
                possible="layout 'fibre' with a fibre, or another layout without",
            )
        if self.fibre is None:
            return
        fibre = (self.fibre.stages, self.fibre.substeps, self.fibre.sensor_pixels)
        if fibre != (self.stages, self.substeps, self.pixels):
            raise UsageError(
                f"a recording of M = {self.stages}, S = {self.substeps}, {self.pixels} pixels has a fibre of "
                f"M = {fibre[0]}, S = {fibre[1]}, {fibre[2]} pixels",
                possible="the same",
            )

    def _check_numbers(self) -> None:
        limits = {
            "stages": (1, 2**16),
            "substeps": (1, 8),  # the code of a line is one byte
            "pixels": (1, 2**16),
            "first_line": (0, 2**63 - 1),
            "substep_ticks": (1, 2**32),
            "shard_chunks": (1, MAX_SHARD_CHUNKS),
            "tag_chunks": (1, self.shard_chunks),
            "encoders": (1, 64),
            "commit_lines": (1, 2**40),
            "reserve_bytes": (0, 2**60),
            "chunk_lines": (1, MAX_CHUNK_BYTES // max(TAG_BYTES, self.pixels * self.line_dtype.itemsize)),
        }
        for name, (low, high) in limits.items():
            if not low <= getattr(self, name) <= high:
                raise UsageError(
                    f"a recording cannot have {name} = {getattr(self, name)}", possible=f"{low} to {high}"
                )
        # Readers take such a chunk whole, and its lines are on disk only once all of them have come.
        most = max(1, MAX_CHUNK_BYTES // (TAG_BYTES * self.chunk_lines))
        if self.tag_chunks > most:
            raise UsageError(
                f"a recording cannot have tag_chunks = {self.tag_chunks} of {self.chunk_lines} lines",
                possible=f"1 to {most}: {most * self.chunk_lines} lines in a chunk of tags",
            )
        if self.shard_chunks % self.tag_chunks:
            raise UsageError(
                f"a recording cannot have tag_chunks = {self.tag_chunks}",
                possible=f"a divisor of {self.shard_chunks}",
            )

    def _check_attributes(self) -> None:
        code_from_attrs(self.code)
        for arm in ARMS:
            for key in CAMERA_KEYS:
                if key not in self.cameras.get(arm, {}):
                    raise UsageError(f"a recording needs {key} of camera {arm}", possible="a number")
        # They would be replaced without a word: see `root_attributes`.
        clash = sorted(set(self.extra) & set(_own_attributes(self, None)))
        if clash:
            raise UsageError(
                f"extra attributes {', '.join(clash)} are the format's own",
                possible="attributes of other names",
            )
        try:
            json.dumps([self.trigger, self.cameras, self.config, self.extra], allow_nan=False)
        except (TypeError, ValueError) as error:
            raise UsageError(
                f"attributes of a recording are not JSON: {error}",
                possible="text, finite numbers, lists, dicts",
            ) from error


@dataclass(frozen=True, slots=True)
class Ending:
    """Facts that are known only at the end."""

    condition: RunCondition
    reason: str
    ledger: dict[str, Any]


def root_attributes(spec: RecordingSpec, ending: Ending | None = None) -> dict[str, Any]:
    """Return the attributes of the recording's root group; ``ending`` makes it sealed."""
    segment: dict[str, Any] = {}
    if spec.continues:  # the length of the outage is known only now, with the first line
        readout = readout_ns(spec, spec.first_line)
        segment = {"segment": spec.continues.to_attrs(spec.first_line, readout)}
    # The format's own attributes last: nothing may replace them.
    return {**spec.extra, **segment, **_own_attributes(spec, ending)}


def readout_ns(spec: RecordingSpec, line: int) -> int:
    """Return the UTC in ns at which the read-out of a line begins."""
    readout = Geometry(spec.stages, spec.substeps, 1).readout_substep
    return spec.clock.instant_ns((spec.substeps * line + readout) * spec.substep_ticks)


def _own_attributes(spec: RecordingSpec, ending: Ending | None) -> dict[str, Any]:
    state: State = "sealed" if ending else "recording"
    return {
        "format": FORMAT,
        "description": (
            "Lines of both arms of a TDI compressed-video rig. Row i of every array of a/ and b/ is the "
            "trigger's line first_line + i; a line that is missing keeps its row, flagged and filled with 0."
        ),
        "run_id": spec.run_id,
        "state": state,
        "run_condition": str(ending.condition) if ending else None,
        "end_reason": ending.reason if ending else None,
        "layout": spec.layout,
        "first_line": spec.first_line,
        "geometry": spec.geometry,
        "trigger": {
            **spec.trigger,
            "clock_hz": spec.clock.clock_hz,
            "substep_ticks": spec.substep_ticks,
            "line_period_ticks": spec.substep_ticks * spec.substeps,
        },
        "code": spec.code,
        "clock": spec.clock.to_attrs(),
        "cameras": spec.cameras,
        "config": spec.config,
        "durability": asdict(spec.durability),
        "host": this_host(),
        "versions": {
            "acquire": acquire.__version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
        },
        "ledger": ending.ledger if ending else {},
    }
