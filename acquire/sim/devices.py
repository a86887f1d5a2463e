"""Simulated cameras: the same protocol as the real ones, at the end of a simulated trigger's wire.

The trigger (`acquire.sim.trigger_model`) only writes its pulse train there. A camera reads it, waits until
the pulses of its next block have been issued and computes those lines from scene and code; the light's code
comes with the pulses, as it does on the bench. A camera that computes more slowly than the pulses come is no
camera that loses lines: the queue behind it has no end, it is merely late (``behind_lines``).
"""

from __future__ import annotations

import multiprocessing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire import __version__
from acquire.camera.base import Camera, CameraBlock, CameraIdentity
from acquire.clock import NS_PER_S
from acquire.errors import CameraError
from acquire.sim.blas import limit_blas_threads
from acquire.sim.lines import StreamingArm
from acquire.sim.scenes import build_scene

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.codes import Code
    from acquire.config import CameraConfig, GeometryConfig, SceneConfig
    from acquire.sim.clock import PulseTrain, Reading, Wire
    from acquire.sim.pins import PinWire


@dataclass(frozen=True, slots=True)
class SimulatedOptics:
    """What stands in front of a simulated sensor: which arm, how large, which scene."""

    arm: str
    geometry: GeometryConfig
    scene: SceneConfig

    def expose(self, train: PulseTrain, code: Code) -> StreamingArm:
        """The lines that the arm gives under a train's timing and the light's code."""
        M, S = self.geometry.stages, self.geometry.substeps
        substep_s = float(train.line_period_ns / (S * NS_PER_S))
        return StreamingArm(build_scene(self.scene, M * S, substep_s), code, M, S, self.arm)


class SimulatedCamera:
    """A TDI camera that reads out one line per pulse on the wire, in blocks of ``block_lines``.

    It follows one train: the one that runs when it is armed, else the next one. Its line at pulse ``p`` is
    line number ``p − (M + 1)``. Values are those of an ideal converter:
    DN = clip(round(black level + responsivity · Y), 0, white). ``line_rate_hz`` is what it was set up for;
    the pulses alone decide.
    """

    def __init__(
        self,
        wire: Wire | PinWire,
        optics: SimulatedOptics,
        config: CameraConfig,
        block_lines: int,
        line_rate_hz: float,
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
            self._light = self._optics.expose(reading.train, self._wire.code(reading.train))
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

    wire: Wire | PinWire
    optics: SimulatedOptics
    config: CameraConfig
    block_lines: int
    line_rate_hz: float

    def __call__(self) -> Camera:
        if multiprocessing.parent_process() is not None:
            limit_blas_threads(1)
        return SimulatedCamera(self.wire, self.optics, self.config, self.block_lines, self.line_rate_hz)
