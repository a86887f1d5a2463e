"""A simulated camera without a scene: stored lines, as fast as the trigger asks, at next to no cost.

What it shows follows from the line's number alone, so that any line can be checked by itself: line ``l`` of
an arm is row ``l mod rows`` of a table, noise around a profile as a sensor has it, which a codec packs as it
packs real lines. For loads, endurance and proofs, where computing a scene would be what is measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.lines import ARMS
from acquire.sim.devices import SimulatedCamera
from acquire.sim.readout import Readout

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.codes import Code
    from acquire.config import GeometryConfig
    from acquire.config.device import CameraConfig
    from acquire.sim.clock import PulseTrain, Wire
    from acquire.sim.pins import PinWire

_TABLE_BYTES = 1 << 25
"""More than a processor's cache holds: copying lines costs what it costs with a real camera."""
_MOST_ROWS = 1 << 16
_NOISE_REPEATS = 16
_FULL_WELL = 10_000.0
"""Electrons at the top of the range: what noise there is (its root) sets what can be packed."""


@dataclass(frozen=True, slots=True)
class Pattern:
    """The lines of one arm: ``pixels`` samples of ``dtype``, none above ``white_dn`` - 1."""

    arm: str
    pixels: int
    dtype: str
    white_dn: int

    @property
    def rows(self) -> int:
        """Lines after which the pattern repeats: odd, so that no block's length divides it."""
        return min(_MOST_ROWS, _TABLE_BYTES // (self.pixels * np.dtype(self.dtype).itemsize)) | 1

    def lines(self, first_line: int, count: int) -> NDArray[Any]:
        """Lines ``first_line .. first_line + count - 1`` (count, pixels); a view wherever it can be one."""
        table, first = _table(self), first_line % self.rows
        if first + count <= len(table):
            return table[first : first + count]
        return table[(first + np.arange(count)) % self.rows]


@cache
def _table(pattern: Pattern) -> NDArray[Any]:
    """(row, pixel): one round, and half of it again so that few stretches meet its end."""
    rng = np.random.default_rng(ARMS.index(pattern.arm))
    few = pattern.rows // _NOISE_REPEATS + 1
    profile = 0.4 + 0.2 * np.sin(np.linspace(0, 20, pattern.pixels, dtype=np.float32))
    noise = rng.standard_normal((few, pattern.pixels), np.float32) * np.sqrt(profile / _FULL_WELL)
    dn = ((profile + noise) * pattern.white_dn).clip(1, 0.9 * pattern.white_dn - 1).astype(pattern.dtype)
    drift = np.linspace(0, 0.1 * pattern.white_dn, pattern.rows).astype(pattern.dtype)
    row = np.arange(pattern.rows + pattern.rows // 2) % pattern.rows
    table: NDArray[Any] = dn[row % few] + drift[row, None]
    return table


@dataclass(frozen=True, slots=True)
class PatternLight:
    """What a simulated camera reads out, where `acquire.sim.pipeline.Camera` stands otherwise."""

    pattern: Pattern

    def read(self, first_line: int, count: int) -> Readout:
        return Readout(self.pattern.lines(first_line, count), np.zeros(count, bool))


@dataclass(frozen=True, slots=True)
class PatternOptics:
    """`acquire.sim.devices.SimulatedOptics` with a pattern in place of the scene."""

    geometry: GeometryConfig
    pattern: Pattern

    def expose(self, train: PulseTrain, code: Code, config: CameraConfig) -> PatternLight:  # noqa: ARG002
        return PatternLight(self.pattern)


@dataclass(frozen=True, slots=True)
class PatternCameraOpener:
    """Opens a camera that shows its pattern at the pulses of ``wire``. Picklable.

    ``pixels`` per line; those of the geometry, unless a load asks for more.
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
        pattern.lines(0, 1)  # the table is made now, not when the first lines are due
        optics = PatternOptics(self.geometry, pattern)
        return SimulatedCamera(self.wire, optics, config, self.block_lines, self.line_rate_hz)
