"""Simulated trigger and cameras: the same protocols as the real ones, joined by a wire.

The trigger only writes its pulse train on the wire. A camera reads the train, waits until the pulses of its
next block have been issued and computes those lines from scene and code; the light's code comes with the
pulses, as it does on the bench. A camera that computes more slowly than the pulses come is no camera that
loses lines: the queue behind it has no end, it is merely late (``behind_lines``).
"""

from __future__ import annotations

import multiprocessing
import threading
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire import __version__
from acquire.camera.base import CameraBlock, CameraIdentity
from acquire.clock import NS_PER_S, ClockFit
from acquire.codes import code_from_attrs
from acquire.errors import CameraError, TriggerError, UsageError
from acquire.sim.blas import limit_blas_threads
from acquire.sim.lines import StreamingArm
from acquire.sim.scenes import build_scene
from acquire.trigger.base import LineTag, TriggerIdentity

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.config import CameraConfig, GeometryConfig, SceneConfig
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

    def expose(self, train: PulseTrain) -> StreamingArm:
        """The lines that the arm gives under a train's timing and code."""
        M, S = self.geometry.stages, self.geometry.substeps
        substep_s = float(train.line_period_ns / (S * NS_PER_S))
        return StreamingArm(
            build_scene(self.scene, M * S, substep_s), code_from_attrs(train.code), M, S, self.arm
        )


class SimulatedCamera:
    """A TDI camera that reads out one line per pulse on the wire, in blocks of ``block_lines``.

    It follows one train: the one that runs when it is armed, else the next one. Its line at pulse ``p`` is
    line number ``p − (M + 1)``. Values are those of an ideal converter:
    DN = clip(round(black level + responsivity · Y), 0, white). ``line_rate_hz`` is what it was set up for;
    the pulses alone decide.
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
        self._light: StreamingArm | None = None

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
        self._delivered = 0
        self._light = None

    def arm_like(self, other: SimulatedCamera) -> None:
        """Be armed from the same pulse on as ``other``, just armed: both are one sensor."""
        self._train, self._first_pulse = other._train, other._first_pulse
        self._delivered = 0
        self._light = None

    def next_block(self, timeout_s: float) -> CameraBlock | None:
        """The next ``block_lines`` lines; fewer only for the last of a train that was stopped."""
        if self._train is None:
            raise CameraError("a block was asked of a camera that is not armed", hint="arm it")
        if self._finished(self._wire.look()):
            self._wire.clock.sleep(timeout_s)
            return None
        pulses = self._first_pulse + self._delivered + self._block_lines
        reading = self._wire.wait(self._train, pulses, timeout_s)
        ready = min(self._behind(reading), self._block_lines)
        if ready < self._block_lines and not (ready and reading.stopped):
            return None
        return self._read_out(reading, ready)

    def times_ns(self, first_line: int, count: int) -> NDArray[np.int64]:
        """CLOCK_MONOTONIC at which lines, counted since arm, were triggered (count,)."""
        train = self._wire.look().train
        if train is None or train.run != self._train:
            raise CameraError("times were asked of a camera without its pulses")
        spacing = train.line_period_ns / train.speed
        pulses = self._first_pulse + first_line + np.arange(count, dtype=np.int64)
        times: NDArray[np.int64] = train.start_ns - (-pulses * spacing.numerator // spacing.denominator)
        return times

    def release(self, block: CameraBlock) -> None:
        """Nothing to give back: every block has memory of its own."""

    def disarm(self) -> None:
        self._train = None

    def statistics(self) -> dict[str, int]:
        behind = 0 if self._train is None else self._behind(self._wire.look())
        return {"lines": self._delivered, "lost": 0, "behind_lines": behind}

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

    def _read_out(self, reading: Reading, count: int) -> CameraBlock:
        if self._light is None:
            assert reading.train is not None
            self._light = self._optics.expose(reading.train)
        first_line = self._first_pulse + self._delivered - self._depth_lines
        pixels = self._convert(self._light.lines(first_line, count))
        block = CameraBlock(self._delivered, pixels, np.zeros(count, np.uint16))
        self._delivered += count
        return block

    def _convert(self, light: NDArray[np.float32]) -> NDArray[Any]:
        """Y of Eq. (1) to DN."""
        dn = light * np.float32(self._config.responsivity_dn) + np.float32(self._config.black_level_dn)
        pixels: NDArray[Any] = np.clip(np.rint(dn), 0, self._config.white_dn).astype(self._config.dtype)
        return pixels


@dataclass(frozen=True, slots=True)
class SimulatedCameraOpener:
    """Opens one simulated camera in the process that calls it; can be given to a process being spawned."""

    wire: Wire
    optics: SimulatedOptics
    config: CameraConfig
    block_lines: int
    line_rate_hz: float

    def __call__(self) -> SimulatedCamera:
        if multiprocessing.parent_process() is not None:
            limit_blas_threads(1)
        return SimulatedCamera(self.wire, self.optics, self.config, self.block_lines, self.line_rate_hz)
