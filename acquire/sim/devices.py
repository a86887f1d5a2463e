"""Simulated cameras: the same protocol as the real ones, at the end of a simulated trigger's wire.

The trigger (`acquire.sim.trigger_model`) only writes its pulse train to the wire. A camera reads it, waits
until the pulses of its next block have been issued and computes those lines from scene and code; the light's
code comes with the pulses, as it does on the bench. A camera that computes more slowly than the pulses come
loses no lines: its queue of pulses is unlimited, and it is merely late (``behind_lines``).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from acquire import __version__
from acquire.camera.base import CameraBlock, CameraIdentity
from acquire.clock import NS_PER_S
from acquire.cores import limit_blas
from acquire.errors import CameraError
from acquire.lines import ARMS
from acquire.processes import nursery

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.codes import Code
    from acquire.config import GeometryConfig
    from acquire.config.device import CameraConfig
    from acquire.config.scene import SceneConfig
    from acquire.fibre import Fibre
    from acquire.sim.clock import PulseTrain, Wire, WireReading
    from acquire.sim.pins import PinWire
    from acquire.sim.pipeline import ArmSource
    from acquire.sim.readout import Readout


class Sensor(Protocol):
    """Returns lines by their numbers."""

    def read(self, first_line: int, count: int) -> Readout:
        """Return ``count`` lines from ``first_line`` on, and which of them the camera loses."""
        ...


class Optics(Protocol):
    """The source of a simulated sensor's lines."""

    @property
    def geometry(self) -> GeometryConfig:
        """M and S, by which a pulse train's sub-steps are counted."""
        ...

    def expose(self, train: PulseTrain, code: Code, config: CameraConfig) -> Sensor:
        """Return the camera's lines under a train's timing and the light's code."""
        ...


@dataclass(frozen=True, slots=True)
class SimulatedOptics:
    """The optics before a simulated sensor: the arm, the geometry, the scene and the fibre, if any."""

    arm: str
    geometry: GeometryConfig
    scene: SceneConfig
    fibre: Fibre | None = None

    @property
    def pixels(self) -> int:
        """Pixels of a line: the stages, or all columns of the sensor behind a fibre."""
        return self.geometry.stages if self.fibre is None else self.fibre.sensor_pixels

    def expose(self, train: PulseTrain, code: Code, config: CameraConfig) -> ArmSource:
        """Return the lines of the arm's camera under a train's timing and the light's code."""
        from acquire.sim.pipeline import Bench  # imports scenes, which other optics do not need

        substep_s = float(train.line_period_ns / (self.geometry.substeps * NS_PER_S))
        cameras = dict.fromkeys(ARMS, config)
        bench = Bench(
            self.scene,
            self.geometry,
            cameras,
            substep_s,
            settled_s=train.settled_s,
            lit_part=train.lit_part,
            fibre=self.fibre,
        )
        return bench.camera(self.arm, code)


class SimulatedCamera:
    """A TDI camera that reads out one line per pulse on the wire, in blocks of ``block_lines``.

    It follows one train: the one that runs when it is armed, else the next one. Its line at pulse ``p`` is
    line number ``p − (M + 1)``. `acquire.sim.pipeline` computes its lines; its line count skips those that
    an effect drops. ``line_rate_hz`` is only reported as a setting: the pulses alone set the rate.
    """

    def __init__(
        self,
        wire: Wire | PinWire,
        optics: Optics,
        config: CameraConfig,
        block_lines: int,
        line_rate_hz: float,
    ) -> None:
        self._wire, self._optics, self._config, self._block_lines = wire, optics, config, block_lines
        self._line_rate_hz = line_rate_hz
        # the lines whose exposure began before the first pulse: M + 1
        self._depth_lines = optics.geometry.segment(1).depth_lines
        self._train: int | None = None
        self._first_pulse = 0
        self._delivered = 0
        self._lost = 0
        self._ready: deque[CameraBlock] = deque()
        self._light: Sensor | None = None

    def identify(self) -> CameraIdentity:
        return CameraIdentity("acquire", "simulated TDI camera", self._config.serial, __version__)

    def settings(self) -> dict[str, Any]:
        # Optics of plug-ins that predate fibres have no ``pixels``: one pixel per stage.
        pixels = getattr(self._optics, "pixels", self._optics.geometry.stages)
        return {
            "DeviceScanType": "Linescan",
            "SensorWidth": pixels,
            "Width": pixels,
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
        # Like a real camera, one that is armed during a train counts from the next pulse.
        reading = self._wire.read()
        self._train = reading.run if reading.running else reading.run + 1
        self._first_pulse = reading.issued if reading.running else 0
        self._delivered = self._lost = 0
        self._ready.clear()
        self._light = None

    def arm_like(self, other: SimulatedCamera) -> None:
        """Arm from the same pulse as ``other``, which was just armed: both are parts of one sensor."""
        self._train, self._first_pulse = other._train, other._first_pulse
        self._delivered = self._lost = 0
        self._ready.clear()
        self._light = None

    def next_block(self, timeout_s: float) -> CameraBlock | None:
        """Return the next ``block_lines`` lines; only the last block of a stopped train is shorter."""
        if self._train is None:
            raise CameraError("a block was requested from a camera that is not armed", hint="arm it")
        if self._ready:
            return self._ready.popleft()
        reading = self._wire.read()
        if reading.run == self._train and reading.stopped and not self._behind(reading):
            self._wire.clock.sleep(timeout_s)  # as a real camera waits for triggers that will not come
            return None
        pulses = self._first_pulse + self._delivered + self._block_lines
        reading = self._wire.wait(self._train, pulses, timeout_s)
        count = min(self._behind(reading), self._block_lines)
        if count < self._block_lines and not (count and reading.stopped):
            return None
        # The sensor is set up here and not in `arm`, because code and timing come with the pulses.
        if self._light is None:
            assert reading.train is not None
            code = self._wire.code(reading.train)
            self._light = self._optics.expose(reading.train, code, self._config)
        # Line 0 begins at pulse 0 and is read out M + 1 pulses later.
        first_line = self._first_pulse + self._delivered - self._depth_lines
        lines = self._light.read(first_line, count)
        first, times_ns = self._delivered, self.times_ns(self._delivered, count)
        self._delivered += count
        if not lines.missing.any():
            return CameraBlock(first, lines.pixels, np.zeros(count, np.uint16), time_ns=int(times_ns[0]))
        # A block holds consecutive lines only: one for each range between missing lines.
        edges = np.flatnonzero(np.diff(lines.missing, prepend=True, append=True))
        for begin, end in edges.reshape(-1, 2).tolist():
            flags = np.zeros(end - begin, np.uint16)
            self._ready.append(
                CameraBlock(first + begin, lines.pixels[begin:end], flags, time_ns=int(times_ns[begin]))
            )
        self._lost += int(lines.missing.sum())
        return self._ready.popleft() if self._ready else None

    def times_ns(self, first_line: int, count: int) -> NDArray[np.int64]:
        """Return CLOCK_MONOTONIC of the triggers of lines, which are counted since arming: (count,)."""
        train = self._wire.read().train
        if train is None or train.run != self._train:
            raise CameraError(
                "line times were requested from a camera that has seen no pulses of its train",
                hint="read its lines first",
            )
        spacing = train.line_period_ns / train.speed
        pulses = self._first_pulse + first_line + np.arange(count, dtype=np.int64)
        # Whole nanoseconds and the rest separately: pulses · numerator would overflow 64 bits.
        whole, rest = divmod(spacing.numerator, spacing.denominator)
        elapsed_ns = pulses * whole - (-pulses * rest // spacing.denominator)
        times: NDArray[np.int64] = train.start_ns + elapsed_ns
        return times

    def release(self, block: CameraBlock) -> None:
        """Do nothing: every block has its own memory."""

    def disarm(self) -> None:
        self._train = None

    def statistics(self) -> dict[str, int]:
        behind = 0 if self._train is None else self._behind(self._wire.read())
        return {"lines": self._delivered - self._lost, "lost": self._lost, "behind_lines": behind}

    def close(self) -> None:
        self.disarm()

    @property
    def passed(self) -> int:
        """The line before which all were handed out or lost, since arming."""
        return self._ready[0].first_line if self._ready else self._delivered

    def _behind(self, reading: WireReading) -> int:
        """Return the lines due but not delivered. Raises CameraError once another train has started."""
        assert self._train is not None
        if reading.run > self._train:
            raise CameraError(
                f"the trigger started train {reading.run} with a camera armed for train {self._train}",
                hint="arm the camera before every start",
            )
        if reading.run < self._train:
            return 0
        return reading.issued - self._first_pulse - self._delivered


@dataclass(frozen=True, slots=True)
class SimulatedCameraOpener:
    """Opens one simulated camera in the calling process; can be passed to a process being spawned."""

    wire: Wire | PinWire
    optics: SimulatedOptics
    config: CameraConfig
    block_lines: int
    line_rate_hz: float

    def __call__(self) -> SimulatedCamera:
        if nursery.is_worker():
            limit_blas(1)  # the other cores belong to the capture path
        return SimulatedCamera(self.wire, self.optics, self.config, self.block_lines, self.line_rate_hz)
