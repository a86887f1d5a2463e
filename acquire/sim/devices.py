"""Simulated trigger and cameras: the same protocols as the real ones, joined by a wire.

The trigger only writes its pulse train on the wire. A camera reads the train, waits until the pulses of its
next block have been issued and computes those lines from scene and code; the light's code comes with the
pulses, as it does on the bench. A camera that computes more slowly than the pulses come is no camera that
loses lines: the queue behind it has no end, it is merely late (``behind_lines``).
"""

from __future__ import annotations

import multiprocessing
import threading
from collections import deque
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire import __version__
from acquire.camera import base
from acquire.camera.base import CameraBlock, CameraIdentity
from acquire.clock import NS_PER_S, ClockFit
from acquire.codes import code_from_attrs
from acquire.errors import CameraError, TriggerError, UsageError
from acquire.lines import ARMS
from acquire.sim.blas import limit_blas_threads
from acquire.sim.pipeline import Bench, Camera, Readout
from acquire.trigger.base import LineTag, TriggerIdentity

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.config import CameraConfig, GeometryConfig
    from acquire.scene_config import SceneConfig
    from acquire.sim.clock import PulseTrain, Reading, Wire
    from acquire.trigger.base import TriggerRun

_SUBSTEP_TICKS = range(5, 2**24 + 1)
"""What the gateware's counter can do."""
_TAGS_PER_CALL = 4096


class SimulatedTrigger:
    """A trigger whose pulses are worked out instead of sent.

    Parameters
    ----------
    wire : the pulses' way to the cameras; the trigger is its only writer
    clock_hz : frequency of its clock, in simulated time
    substeps : S of the cameras that hang on the wire
    speed : simulated seconds per second, taken as the decimal number it is written as

    The clock fit holds at the start of a run; when ``speed`` is not 1, simulated time leaves UTC from there.
    """

    def __init__(self, wire: Wire, clock_hz: int, substeps: int, speed: float = 1.0) -> None:
        self._wire = wire
        self._clock_hz = clock_hz
        self._substeps = substeps
        self._speed = Fraction(str(speed))
        self._lock = threading.Lock()
        self._prepared: TriggerRun | None = None
        self._run: TriggerRun | None = None
        self._tags = 0

    def identify(self) -> TriggerIdentity:
        return TriggerIdentity("simulated trigger", "simulated", __version__, self._clock_hz)

    def prepare(self, run: TriggerRun) -> None:
        """Check and keep the run. Preparing the same run again changes nothing, even while it runs."""
        with self._lock:
            if self._wire.look().running:
                if run == self._run:
                    return
                raise TriggerError(
                    f"run {run.run_id!r} prepared while another one runs", hint="stop it first"
                )
            self._check(run)
            self._prepared = run

    def start(self) -> ClockFit:
        with self._lock:
            run = self._prepared
            if run is None:
                raise TriggerError("start of a trigger without a run", hint="prepare one")
            utc_ns, monotonic_ns, uncertainty_ns = self._compare_clocks()
            line_period_ns = Fraction(run.line_period_ticks * NS_PER_S, self._clock_hz)
            train = self._wire.start(line_period_ns, self._speed, run.code.to_attrs())
            self._run, self._prepared, self._tags = run, None, 0
            return ClockFit(self._clock_hz, utc_ns + train.start_ns - monotonic_ns, uncertainty_ns)

    def tags(self, timeout_s: float) -> list[LineTag]:
        """At most 4096 tags at a time; a stop ends the wait."""
        run = self._run
        reading = self._wire.look()
        if run is None or (reading.stopped and reading.issued <= self._tags * run.tag_every_lines):
            self._wire.clock.sleep(timeout_s)
            return []
        line = self._tags * run.tag_every_lines
        reading = self._wire.wait(reading.run, line + 1, timeout_s)
        ready = range(line, reading.issued, run.tag_every_lines)[:_TAGS_PER_CALL]
        self._tags += len(ready)
        return [LineTag(k, k * run.substeps, k * run.line_period_ticks) for k in ready]

    def stop(self) -> int:
        with self._lock:
            self._prepared = None
            return self._wire.stop()

    def statistics(self) -> dict[str, Any]:
        return {"pulses": self._wire.look().issued, "tags": self._tags}

    def close(self) -> None:
        self.stop()

    def _check(self, run: TriggerRun) -> None:
        if run.substep_ticks not in _SUBSTEP_TICKS:
            raise TriggerError(
                f"sub-step of {run.substep_ticks} ticks",
                possible=f"{_SUBSTEP_TICKS.start} to {_SUBSTEP_TICKS.stop - 1}",
            )
        if run.substeps != self._substeps:
            raise TriggerError(
                f"{run.substeps} sub-steps per line", possible=f"{self._substeps}, as the cameras have"
            )
        if run.tag_every_lines < 1:
            raise TriggerError(f"a tag every {run.tag_every_lines} lines", possible="1 or more")
        try:
            code_from_attrs(run.code.to_attrs())
        except UsageError as error:
            raise TriggerError(f"the trigger cannot generate the code: {error}") from error

    def _compare_clocks(self) -> tuple[int, int, int]:
        """UTC, the monotonic clock at the same moment, and how far the two may be apart (ns)."""
        clock = self._wire.clock
        readings = [(clock.monotonic_ns(), clock.utc_ns(), clock.monotonic_ns()) for _ in range(5)]
        before_ns, utc_ns, after_ns = min(readings, key=lambda reading: reading[2] - reading[0])
        return utc_ns, (before_ns + after_ns) // 2, (after_ns - before_ns) // 2 + 1


@dataclass(frozen=True, slots=True)
class SimulatedOptics:
    """What stands in front of a simulated sensor: which arm, how large, which scene."""

    arm: str
    geometry: GeometryConfig
    scene: SceneConfig

    def expose(self, train: PulseTrain, config: CameraConfig) -> Camera:
        """The lines that the arm's camera gives under a train's timing and code."""
        substep_s = float(train.line_period_ns / (self.geometry.substeps * NS_PER_S))
        bench = Bench(self.scene, self.geometry, dict.fromkeys(ARMS, config), substep_s)
        return bench.camera(self.arm, code_from_attrs(train.code))


class SimulatedCamera:
    """A TDI camera that reads out one line per pulse on the wire, in blocks of ``block_lines``.

    It follows one train: the one that runs when it is armed, else the next one. Its line at pulse ``p`` is
    line number ``p − (M + 1)``. What its lines hold is said in `acquire.sim.pipeline`; lines that an effect
    drops are jumped over in its count. ``line_rate_hz`` is what it was set up for; the pulses alone decide.
    """

    def __init__(
        self, wire: Wire, optics: SimulatedOptics, config: CameraConfig, block_lines: int, line_rate_hz: float
    ) -> None:
        self._wire, self._optics, self._config, self._block_lines = wire, optics, config, block_lines
        self._line_rate_hz = line_rate_hz
        self._depth_lines = optics.geometry.segment(1).depth_lines
        self._train: int | None = None
        self._first_pulse = 0
        self._delivered = 0
        self._lost = 0
        self._ready: deque[CameraBlock] = deque()
        self._light: Camera | None = None

    def identify(self) -> CameraIdentity:
        return CameraIdentity("acquire", "simulated TDI camera", self._config.serial, __version__)

    def settings(self) -> dict[str, Any]:
        return {
            "DeviceScanType": "Linescan",
            "SensorWidth": self._optics.geometry.stages,
            "Width": self._optics.geometry.stages,
            "OffsetX": 0,
            "PixelFormat": self._config.pixel_format,
            "AcquisitionMode": "Continuous",
            "AcquisitionLineRate": self._line_rate_hz,
            "TriggerSelector": "LineStart",
            "TriggerMode": "On",
            "TriggerSource": "Line0",
            "TriggerActivation": "RisingEdge",
            "white_dn": self._config.white_dn,
            "black_level_dn": self._config.black_level_dn,
            "responsivity_dn": self._config.responsivity_dn,
        }

    def arm(self) -> None:
        reading = self._wire.look()
        self._train = reading.run if reading.running else reading.run + 1
        self._first_pulse = reading.issued if reading.running else 0
        self._delivered = self._lost = 0
        self._ready.clear()
        self._light = None

    def next_block(self, timeout_s: float) -> CameraBlock | None:
        """The next ``block_lines`` lines; fewer only for the last of a train that was stopped."""
        if self._train is None:
            raise CameraError("a block was asked of a camera that is not armed", hint="arm it")
        if self._ready:
            return self._ready.popleft()
        if self._finished(self._wire.look()):
            self._wire.clock.sleep(timeout_s)
            return None
        pulses = self._first_pulse + self._delivered + self._block_lines
        reading = self._wire.wait(self._train, pulses, timeout_s)
        ready = min(self._behind(reading), self._block_lines)
        if ready < self._block_lines and not (ready and reading.stopped):
            return None
        return self._read_out(reading, ready)

    def release(self, block: CameraBlock) -> None:
        """Nothing to give back: every block has memory of its own."""

    def disarm(self) -> None:
        self._train = None

    def statistics(self) -> dict[str, int]:
        behind = 0 if self._train is None else self._behind(self._wire.look())
        return {"lines": self._delivered - self._lost, "lost": self._lost, "behind_lines": behind}

    def close(self) -> None:
        self.disarm()

    def _behind(self, reading: Reading) -> int:
        """Lines that are due and not delivered; CameraError when another train has taken the wire."""
        assert self._train is not None
        if reading.run > self._train:
            raise CameraError(
                f"the trigger started train {reading.run} with a camera armed for train {self._train}",
                hint="arm the camera before every start",
            )
        if reading.run < self._train:
            return 0
        return reading.issued - self._first_pulse - self._delivered

    def _finished(self, reading: Reading) -> bool:
        return reading.run == self._train and reading.stopped and not self._behind(reading)

    def _read_out(self, reading: Reading, count: int) -> CameraBlock | None:
        if self._light is None:
            assert reading.train is not None
            self._light = self._optics.expose(reading.train, self._config)
        first_line = self._first_pulse + self._delivered - self._depth_lines
        lines = self._light.read(first_line, count)
        if not lines.missing.any():
            block = CameraBlock(self._delivered, lines.pixels, np.zeros(count, np.uint16))
            self._delivered += count
            return block
        self._lost += int(lines.missing.sum())
        self._ready.extend(_whole_runs(self._delivered, lines))
        self._delivered += count
        return self._ready.popleft() if self._ready else None


def _whole_runs(first: int, lines: Readout) -> Iterator[CameraBlock]:
    """The stretches between lines that did not come."""
    edges = np.flatnonzero(np.diff(lines.missing, prepend=True, append=True))
    for begin, end in edges.reshape(-1, 2).tolist():
        yield CameraBlock(first + begin, lines.pixels[begin:end], np.zeros(end - begin, np.uint16))


@dataclass(frozen=True, slots=True)
class SimulatedCameraOpener:
    """Opens one simulated camera in the process that calls it; can be given to a process being spawned."""

    wire: Wire
    optics: SimulatedOptics
    config: CameraConfig
    block_lines: int
    line_rate_hz: float

    def __call__(self) -> base.Camera:
        if multiprocessing.parent_process() is not None:
            limit_blas_threads(1)
        return SimulatedCamera(self.wire, self.optics, self.config, self.block_lines, self.line_rate_hz)
