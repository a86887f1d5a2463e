"""Measure what ring, codec and disk of this host sustain, separately and together, in about a second.

Every part processes lines like those of a camera, as fast as it can, in this thread. A part that is too slow
on its own is too slow in the capture path, where all parts share the host's processors.
"""

from __future__ import annotations

import os
import shutil
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.capacity.load import recording_spec, scratch_path, trigger_run
from acquire.clock import ClockFit
from acquire.lines import ARMS, LineBlock
from acquire.pattern import Pattern
from acquire.store import RecordingWriter
from acquire.store.codecs import encode
from acquire.store.plugin_codecs import prove
from acquire.store.shape import crc32c
from acquire.stream.ring import Ring, RingShape
from acquire.stream.tagger import Tagger

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.capacity.load import Load

PART_S = 0.15
"""Duration of each part's measurement."""
_BLOCKS = 8
"""Number of different blocks per arm: too many for a processor's cache to hold them all."""
_CLOCK = ClockFit(90_000_000, 0, 0)


@dataclass(frozen=True, slots=True)
class Pace:
    """Throughput in lines of both arms, by the clock and in processor time."""

    lines_per_s: float
    cpu_s_per_line: float


@dataclass(frozen=True, slots=True)
class Parts:
    """Pace of each part. ``recorder`` is tags, codec, checksum and disk together, as in a recording."""

    load: Load
    ring: Pace
    codec: Pace
    recorder: Pace
    cores: int

    @property
    def limits(self) -> dict[str, float]:
        """Line rate in Hz that each part allows; ``processors`` is the rate at which all cores are busy."""
        return {
            "ring": self.ring.lines_per_s,
            "codec": self.codec.lines_per_s,
            "recorder": self.recorder.lines_per_s,
            "processors": self.cores / (self.ring.cpu_s_per_line + self.recorder.cpu_s_per_line),
        }

    @property
    def limit(self) -> str:
        """The part that allows the lowest rate."""
        return min(self.limits, key=self.limits.__getitem__)

    @property
    def line_rate_hz(self) -> float:
        """The line rate that all parts allow."""
        return self.limits[self.limit]


def measure_parts(load: Load, directory: Path) -> Parts:
    """Measure all parts, with a recording below ``directory`` that is removed afterwards.

    Raises the same errors as creating a recording there would, and ConfigError for a plug-in's codec that
    does not give back what it packs.
    """
    patterns = [Pattern(arm, load.pixels, load.dtype, 255) for arm in ARMS]
    blocks = [
        pattern.lines(k * load.block_lines, load.block_lines) for k in range(_BLOCKS) for pattern in patterns
    ]
    prove(blocks[0], load.codec)

    def pack(k: int) -> int:
        # With the checksum, which the recorder computes of every chunk that it encodes.
        crc32c(encode(blocks[k % len(blocks)], load.codec).data)
        return load.block_lines

    return Parts(
        load,
        ring=_pace_of_ring(load, blocks),
        codec=_pace(pack),
        recorder=_pace_of_recorder(load, blocks, directory),
        # taskset or a container may leave fewer than the host has.
        cores=len(os.sched_getaffinity(0)),
    )


def _pace(work: Callable[[int], int], finish: Callable[[], object] = lambda: None) -> Pace:
    """Return the pace of ``work(k)``, which processes the k-th block and returns its lines of one arm."""
    begun_s, begun_cpu_s, lines, k = time.perf_counter(), time.process_time(), 0, 0
    # At least one block of each arm, however slow the part is.
    while time.perf_counter() - begun_s < PART_S or k < len(ARMS):
        lines += work(k)
        k += 1
    finish()
    both = lines / len(ARMS)
    return Pace(both / (time.perf_counter() - begun_s), (time.process_time() - begun_cpu_s) / both)


def _pace_of_ring(load: Load, blocks: list[NDArray[Any]]) -> Pace:
    """Measure the work of a grabber on a block, and the recorder's side of the ring."""
    ring = Ring("capacity", RingShape(2, load.block_lines, load.pixels, load.dtype))

    def pass_through(k: int) -> int:
        # Never full: each slot is released before the next one is claimed.
        slot = ring.claim(k * load.block_lines, load.block_lines)
        assert slot is not None
        slot.pixels[:] = blocks[k % len(blocks)]
        # As a grabber does, which looks for saturated pixels.
        slot.pixels.max()
        ring.commit(slot)
        ring.acquire()
        ring.release()
        return load.block_lines

    try:
        return _pace(pass_through)
    finally:
        ring.close()


def _pace_of_recorder(load: Load, blocks: list[NDArray[Any]], directory: Path) -> Pace:
    path = scratch_path(directory, "capacity")
    tagger = Tagger(trigger_run(load), load.stages, _CLOCK)
    flags = np.zeros(load.block_lines, np.uint16)
    with RecordingWriter.create(path, recording_spec(load, _CLOCK)) as writer:

        def append(k: int) -> int:
            number, arm = divmod(k, len(ARMS))
            block = LineBlock(number * load.block_lines, blocks[k % len(blocks)], flags)
            writer.give_back(ARMS[arm])  # as the recorder does when it is behind: the arms alternate
            writer.append(tagger.tag(ARMS[arm], block), lent=True)
            return load.block_lines

        try:
            return _pace(append, writer.commit)
        finally:
            writer.close()
            shutil.rmtree(path, ignore_errors=True)
