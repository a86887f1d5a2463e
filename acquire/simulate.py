"""Simulation of a recording without a daemon, as fast as possible, and a study of its effects.

`simulate` writes what the daemon would have recorded from line 0 on. `study` leaves out one effect at a time
and compares the lines: an effect that changes them by far less than their noise need not be listed.
"""

from __future__ import annotations

import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from acquire import __version__
from acquire.calibrate.choose import carried_calibration
from acquire.clock import ClockFit
from acquire.config import RigConfig
from acquire.config.scene import SceneBase
from acquire.errors import AcquireError, UsageError
from acquire.geometry import check_integers
from acquire.lines import ARMS, LineBlock, LineFlag
from acquire.noise import QUANTISATION_DN2
from acquire.plugins import CODECS, of_others
from acquire.reading import path_of
from acquire.sim.pipeline import Bench, describe
from acquire.sim.stopwatch import Stopwatch
from acquire.store import RecordingSpec, RecordingWriter, RunCondition
from acquire.store.codecs import configured_codec
from acquire.stream.losses import Cause
from acquire.stream.tagger import Tagger
from acquire.text import shown
from acquire.trigger.base import TriggerRun

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from concurrent.futures import Future
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.codes import Code
    from acquire.config.scene import SceneConfig
    from acquire.sim.pipeline import ArmSource
    from acquire.sim.readout import Readout

    _Block = tuple[int, dict[str, Future[Readout]]]

MOST_SIMULATED_LINES = 10**10
"""Days of computing, and terabytes; more is a typing error."""
_BLOCK_LINES = 1024
_COMMIT_BLOCKS = 32
STUDIED_LINES = 512
BARE = "Eq. (1)"
LOSS = "dropped_lines"
TEMPORAL_NOISE = ("shot_noise", "dark_current", "read_noise")


@dataclass(frozen=True, slots=True)
class Simulated:
    """Result of `simulate`."""

    path: Path
    lines: int
    seconds: float
    simulated_s: float
    lost_lines: dict[str, int]

    @property
    def speed(self) -> float:
        """Simulated seconds per second of wall time."""
        return self.simulated_s / self.seconds


@dataclass(frozen=True, slots=True)
class Worth:
    """What one effect changes in the lines of both arms, and its cost.

    ``change_dn`` is the RMS change when it alone is left out, ``noises`` the same in units of the lines'
    temporal noise (None for lost lines, which do not change and are known), ``us_per_line`` its computing
    time.
    """

    effect: str
    place: str
    change_dn: float
    noises: float | None
    us_per_line: float


@dataclass(frozen=True, slots=True)
class Study:
    """Result of `study`. ``bare_us_per_line`` is one arm without any effect."""

    noise_dn: float
    signal_dn: float
    bare_us_per_line: float
    all_us_per_line: float
    effects: tuple[Worth, ...]


def bench_of(config: RigConfig, scene: SceneConfig) -> Bench:
    """Return the simulated optics and cameras of a rig in front of a scene."""
    cameras = {arm: config.cameras.arm(arm) for arm in ARMS}
    trigger = config.trigger
    substep_s = trigger.substep_ticks / trigger.clock_hz
    return Bench(
        scene,
        config.geometry,
        cameras,
        substep_s,
        settled_s=trigger.settled_s,
        lit_part=trigger.lit_part,
        fibre=config.laid_out,
    )


def layout_of(config: RigConfig, scene: SceneConfig) -> str:
    """Return the simulated instrument's layout: the rig's with a fibre, else that of the scene's optics."""
    return scene.optics.layout if config.fibre is None else config.cameras.layout


def simulate(
    config: RigConfig,
    scene: SceneConfig,
    path: Path | str,
    lines: int,
    progress: Callable[[int, int], object] = lambda _done, _total: None,
) -> Simulated:
    """Write a recording of ``lines`` lines of both arms, from line 0 on.

    Everything that can be refused is refused with a UsageError before ``path`` exists. A later failure or
    interruption leaves a sealed recording that states it.
    """
    # The names of a rig and a scene, in place of what they stand for, are the likely mistake.
    for given, kind, load in ((config, RigConfig, "load_rig"), (scene, SceneBase, "load_scene")):
        if not isinstance(given, kind):
            raise UsageError(
                f"{shown(given)} cannot be simulated", possible=f"a {kind.__name__}", hint=f"{load}(...)"
            )
    path = path_of(path)
    check_integers(lines=lines)
    if not 1 <= lines <= MOST_SIMULATED_LINES:
        raise UsageError(
            f"a simulation of {lines} lines is not possible", possible=f"1 to {MOST_SIMULATED_LINES} lines"
        )
    code, bench = config.code.build(), bench_of(config, scene)
    cameras = {arm: bench.camera(arm, code) for arm in ARMS}
    for camera in cameras.values():
        camera.read(0, 1)  # refuses what only a read can refuse, and compiles
    began = time.perf_counter()
    run = TriggerRun("simulation", code, config.geometry.substeps, config.trigger.substep_ticks, 1)
    spec = _spec(config, scene)
    writer = RecordingWriter.create(path, spec)
    tagger = Tagger(run, config.geometry.stages, spec.clock)
    # There is no trigger whose tags could confirm the lines.
    tagger.confirmed_end = lines
    # One thread per arm, because a camera's blocks are read in order.
    with writer, ThreadPoolExecutor(1) as a, ThreadPoolExecutor(1) as b:
        threads = dict(zip(ARMS, (a, b), strict=True))
        lost = _write(writer, tagger, _read_ahead(cameras, threads, lines), lines, progress)
    return Simulated(path, lines, time.perf_counter() - began, lines / config.line_rate_hz, lost)


def study(bench: Bench, code: Code, lines: int = STUDIED_LINES) -> Study:
    """Leave out one effect at a time, over ``lines`` lines of both arms that are exposed throughout."""
    from acquire.sim.effects import in_order

    check_integers(lines=lines)
    if lines < 1:
        raise UsageError(f"a study of {lines} lines is not possible", possible="1 or more")
    us_per_line = _times(bench, code, lines)
    stages = [stage for arm in ARMS for stage in bench.camera(arm, code).stages]
    place_of = {stage.effect: stage.place for stage in reversed(stages)}
    kinds = [effect.kind for effect in in_order(bench.scene.effects) if effect.kind in place_of]
    # The pixels of lost lines are 0, which would count as a change of all that they held.
    bench = bench.without(LOSS)
    full = _sample(bench, code, lines)
    again = _sample(replace(bench, realisation=bench.realisation + 1), code, lines)
    quiet = _sample(bench.without(*TEMPORAL_NOISE), code, lines)
    # The lines are rounded: their difference includes the rounding, unless it is all there is.
    noise_dn = float(np.sqrt(max(float(np.mean((full - again) ** 2)) / 2, QUANTISATION_DN2)))
    worths = []
    for effect in kinds:
        if effect in TEMPORAL_NOISE:
            change = full - _sample(bench.without(effect), code, lines)
        else:  # other lines draw other noise, which must not be attributed to the effect
            change = quiet - _sample(bench.without(effect, *TEMPORAL_NOISE), code, lines)
        change_dn = float(np.sqrt(np.mean(change**2)))
        noises = None if effect == LOSS else change_dn / noise_dn
        worths.append(Worth(effect, place_of[effect], change_dn, noises, us_per_line.get(effect, 0.0)))
    return Study(noise_dn, float(full.std()), us_per_line[BARE], sum(us_per_line.values()), tuple(worths))


def _write(
    writer: RecordingWriter,
    tagger: Tagger,
    blocks: Iterator[_Block],
    lines: int,
    progress: Callable[[int, int], object],
) -> dict[str, int]:
    lost = dict.fromkeys(ARMS, 0)
    try:
        for first, reads in blocks:
            for arm, read in reads.items():
                readout, white = read.result(), writer.spec.cameras[arm]["white_dn"]
                full = (readout.pixels >= white).any(axis=1)
                flags = readout.flags | np.where(full, np.uint16(LineFlag.SATURATED), np.uint16(0))
                writer.append(tagger.tag(arm, LineBlock(first, readout.pixels, flags)))
                edges = np.flatnonzero(np.diff(readout.missing, prepend=False, append=False))
                for begin, end in edges.reshape(-1, 2).tolist():
                    writer.add_gap(arm, first + begin, end - begin, Cause.CAMERA)
                lost[arm] += int(readout.missing.sum())
            if first // _BLOCK_LINES % _COMMIT_BLOCKS == 0:
                writer.commit()
            progress(min(first + _BLOCK_LINES, lines), lines)
    except BaseException as error:
        aborted = isinstance(error, Exception)
        reason = str(error.message if isinstance(error, AcquireError) else error) or "interrupted"
        # Sealed in any case: what was simulated can be read, and says that it is not all.
        writer.seal(RunCondition.ABORTED if aborted else RunCondition.INTERRUPTED, reason, {})
        raise
    condition = RunCondition.INCOMPLETE if any(lost.values()) else RunCondition.GOOD
    ledger = {arm: {"stored": lines - count, "missing": {"camera": count}} for arm, count in lost.items()}
    writer.seal(condition, "all lines simulated", {"pulses": lines, **ledger})
    return lost


def _read_ahead(
    cameras: dict[str, ArmSource], threads: dict[str, ThreadPoolExecutor], lines: int
) -> Iterator[_Block]:
    """Yield first line and readouts of each block; the next is computed while the caller handles this one."""
    waiting: deque[_Block] = deque()
    for first in range(0, lines, _BLOCK_LINES):
        count = min(_BLOCK_LINES, lines - first)
        reads = {arm: threads[arm].submit(camera.read, first, count) for arm, camera in cameras.items()}
        waiting.append((first, reads))
        if len(waiting) > 1:
            yield waiting.popleft()
    yield from waiting


def _spec(config: RigConfig, scene: SceneConfig) -> RecordingSpec:
    trigger = {"model": "simulated trigger", "serial": "simulated", "firmware": __version__}
    keys = ("white_dn", "black_level_dn", "responsivity_dn")
    cameras = {
        arm: {key: getattr(config.cameras.arm(arm), key) for key in keys}
        | {"PixelFormat": config.cameras.arm(arm).pixel_format}
        | config.cameras.arm(arm).noise_facts
        for arm in ARMS
    }
    recording, origin = config.recording, describe(scene)
    origin["plugins"] = [*origin["plugins"], *of_others([(CODECS, recording.codec)])]
    return RecordingSpec(
        run_id=f"{config.name}-simulated",
        stages=config.geometry.stages,
        substeps=config.geometry.substeps,
        pixels=config.pixels,
        dtype=config.cameras.a.dtype,
        first_line=0,
        clock=ClockFit(config.trigger.clock_hz, time.time_ns(), 1),
        code=config.code.build().to_attrs(),
        substep_ticks=config.trigger.substep_ticks,
        trigger={**trigger, "settings": config.trigger.model_dump(mode="json")},
        cameras=cameras,
        config=config.model_dump(mode="json"),
        extra=origin | carried_calibration(config, layout_of(config, scene)).attrs,
        chunk_lines=config.chunk_lines,
        shard_chunks=recording.shard_chunks,
        tag_chunks=config.tag_chunks,
        codec=configured_codec(config, auto="lz4"),  # no camera has to be kept up with
        fsync=recording.fsync,
        layout=layout_of(config, scene),
        fibre=config.laid_out,
    )


def _sample(bench: Bench, code: Code, lines: int) -> NDArray[np.float64]:
    """Return lines of both arms, one after the other: (2·lines, M)."""
    first = bench.geometry.stages + 1
    pixels = [bench.camera(arm, code).read(first, lines).pixels for arm in ARMS]
    return np.concatenate(pixels).astype(np.float64)


def _times(bench: Bench, code: Code, lines: int) -> dict[str, float]:
    """Return microseconds per line and arm of each effect alone, and of the bare model."""
    stopwatch = Stopwatch()
    cameras = [replace(bench, stopwatch=stopwatch).camera(arm, code) for arm in ARMS]
    for camera in cameras:
        camera.read(0, 1)  # the first read compiles
    stopwatch.seconds.clear()
    for camera in cameras:
        stopwatch.timed(BARE, camera.read)(bench.geometry.stages + 1, lines)
    return {name: seconds / (2 * lines) * 1e6 for name, seconds in stopwatch.seconds.items()}
