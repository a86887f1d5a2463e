"""A load for measurements of a host: what the cameras deliver, and how it is recorded."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from acquire.codes import PrbsCode
from acquire.config.recording import usual_chunk_lines, usual_tag_chunks
from acquire.errors import StateError, UsageError
from acquire.lines import ARMS
from acquire.store import RecordingSpec
from acquire.store.codecs import configured_codec
from acquire.store.files import locked
from acquire.store.shape import CODECS
from acquire.trigger.base import TriggerRun

if TYPE_CHECKING:
    from acquire.clock import ClockFit
    from acquire.config import RigConfig
    from acquire.store.shape import Codec, OwnCodec

CLOCK_HZ = 90_000_000


@dataclass(frozen=True, slots=True)
class Load:
    """What two cameras deliver, and how it is recorded; the names are those of `acquire.config`."""

    pixels: int
    dtype: str
    line_rate_hz: float
    substeps: int = 3
    stages: int = 64
    block_lines: int = 1024
    ring_slots: int = 64
    chunk_lines: int | None = None
    shard_chunks: int = 240
    commit_s: float = 1.0
    codec: Codec = "none"
    fsync: Literal["commit", "seal"] = "seal"

    @classmethod
    def of(cls, config: RigConfig, chosen: OwnCodec | None = None) -> Load:
        """Return the load of a rig; ``chosen`` is the codec to use if the rig's is ``auto``."""
        stream, recording = config.stream, config.recording
        if recording.codec == "auto" and chosen is None:
            raise UsageError(
                "a load cannot have the codec 'auto'", possible=", ".join(CODECS), hint="choose one first"
            )
        return cls(
            pixels=config.pixels,
            dtype=config.cameras.a.dtype,
            line_rate_hz=config.line_rate_hz * config.simulation.speed,
            substeps=config.geometry.substeps,
            stages=config.geometry.stages,
            block_lines=stream.block_lines,
            ring_slots=config.ring_slots,
            chunk_lines=config.chunk_lines,
            shard_chunks=recording.shard_chunks,
            commit_s=recording.commit_s,
            codec=configured_codec(config, auto=chosen or "none"),
            fsync=recording.fsync,
        )

    @property
    def line_bytes(self) -> int:
        """Bytes of pixels in one line of both arms."""
        return len(ARMS) * self.pixels * np.dtype(self.dtype).itemsize

    @property
    def bytes_per_s(self) -> float:
        return self.line_bytes * self.line_rate_hz

    @property
    def substep_ticks(self) -> int:
        """Duration of a sub-step in ticks of a fixed clock, rounded to a whole number."""
        # 5 ticks are the shortest sub-step of the trigger.
        return max(5, round(CLOCK_HZ / (self.line_rate_hz * self.substeps)))

    @property
    def speed(self) -> float:
        """Simulated seconds per second that compensate for the rounding of the sub-step."""
        return round(self.line_rate_hz * self.substeps * self.substep_ticks / CLOCK_HZ, 4)


def tag_every_lines(load: Load) -> int:
    """Return the lines per tag: at least one tag per block, and four per ring."""
    # Within the limit of a rig, which is a third of the ring (`RigConfig`).
    return min(load.block_lines, load.ring_slots * load.block_lines // 4)


def _code() -> PrbsCode:
    return PrbsCode.from_seed(64, 1)


def trigger_run(load: Load) -> TriggerRun:
    """Return the trigger's run for a load."""
    return TriggerRun("load", _code(), load.substeps, load.substep_ticks, tag_every_lines(load))


def scratch_path(directory: Path, kind: str) -> Path:
    """Return a path for this process's recording, and remove those of processes that were killed."""
    for leftover in directory.glob(f".{kind}-*.zarr"):
        number = leftover.stem.removeprefix(f".{kind}-")
        # Our own number, too: in a container a daemon has the same one after every start. The lock shows a
        # measurement by a process that cannot be seen from here, such as that of another container.
        if number == str(os.getpid()) or not Path("/proc", number).exists():
            with suppress(StateError, OSError), locked(leftover, "removing"):
                shutil.rmtree(leftover, ignore_errors=True)
    return directory / f".{kind}-{os.getpid()}.zarr"


def recording_spec(load: Load, clock: ClockFit) -> RecordingSpec:
    """Return the specification of a recording of the load."""
    camera = {"white_dn": 255, "black_level_dn": 0.0, "responsivity_dn": 1.0}
    rate_hz = load.line_rate_hz
    chunk_lines = load.chunk_lines or usual_chunk_lines(load.line_bytes // len(ARMS), rate_hz)
    return RecordingSpec(
        run_id="load",
        stages=load.stages,
        substeps=load.substeps,
        pixels=load.pixels,
        dtype=load.dtype,
        first_line=0,
        clock=clock,
        code=_code().to_attrs(),
        substep_ticks=load.substep_ticks,
        trigger={},
        cameras=dict.fromkeys(ARMS, camera),
        config={},
        chunk_lines=chunk_lines,
        shard_chunks=load.shard_chunks,
        tag_chunks=usual_tag_chunks(chunk_lines, load.shard_chunks, rate_hz, load.commit_s),
        codec=load.codec,
        fsync=load.fsync,
    )
