"""A simulated camera without a scene: stored lines (`acquire.pattern`), as fast as it is triggered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from acquire.pattern import Pattern
from acquire.sim.devices import SimulatedCamera
from acquire.sim.readout import Readout

if TYPE_CHECKING:
    from acquire.codes import Code
    from acquire.config import GeometryConfig
    from acquire.config.device import CameraConfig
    from acquire.sim.clock import PulseTrain, Wire
    from acquire.sim.pins import PinWire


@dataclass(frozen=True, slots=True)
class PatternLight:
    """A sensor that reads out stored lines, in place of `acquire.sim.pipeline.ArmSource`."""

    pattern: Pattern

    def read(self, first_line: int, count: int) -> Readout:
        return Readout(self.pattern.lines(first_line, count), np.zeros(count, bool))


@dataclass(frozen=True, slots=True)
class PatternOptics:
    """`acquire.sim.devices.SimulatedOptics` with a pattern in place of the scene."""

    geometry: GeometryConfig
    pattern: Pattern

    @property
    def pixels(self) -> int:
        return self.pattern.pixels

    def expose(self, train: PulseTrain, code: Code, config: CameraConfig) -> PatternLight:  # noqa: ARG002
        return PatternLight(self.pattern)


@dataclass(frozen=True, slots=True)
class PatternCameraOpener:
    """Opens a camera that reads out its pattern at the pulses of ``wire``. Picklable.

    ``pixels`` per line are those of the geometry, unless a load test needs more.
    """

    wire: Wire | PinWire
    arm: str
    geometry: GeometryConfig
    config: CameraConfig
    block_lines: int
    line_rate_hz: float
    pixels: int | None = None

    def __call__(self) -> SimulatedCamera:
        config = self.config
        pattern = Pattern(self.arm, self.pixels or self.geometry.stages, config.dtype, config.white_dn)
        pattern.lines(0, 1)  # builds the table now, rather than when the first lines are due
        optics = PatternOptics(self.geometry, pattern)
        return SimulatedCamera(self.wire, optics, config, self.block_lines, self.line_rate_hz)
