"""Test patterns of the light: square waves from the code memory, for the eye and for an oscilloscope."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from acquire.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.trigger.settings import Capabilities


@dataclass(frozen=True, slots=True, eq=False)
class SquareWave:
    """Alternately lit and dark for ``half_substeps`` each; sub-steps of ``substep_ticks``."""

    half_substeps: int
    substep_ticks: int

    @property
    def bits(self) -> NDArray[np.uint8]:
        """One period (sub-step), 0 or 1 each; the code memory repeats it."""
        return np.repeat(np.array([1, 0], np.uint8), self.half_substeps)

    def frequency_hz(self, clock_hz: int) -> float:
        """Return the frequency with a trigger's clock of ``clock_hz``."""
        return clock_hz / (2 * self.half_substeps * self.substep_ticks)


def blink(hz: float, substep_ticks: int, device: Capabilities) -> SquareWave:
    """Return a square wave of about ``hz``.

    Its sub-steps have ``substep_ticks``, or the next multiple for which the code memory holds a period.
    Raises UsageError if it is too fast or too slow for the device.
    """
    slowest = device.clock_hz / device.code_bits / device.substep_ticks_max
    fastest = device.clock_hz / (2 * substep_ticks)
    if not slowest <= hz <= fastest:
        raise UsageError(
            f"the light cannot blink {hz:g} times a second",
            possible=f"{slowest:.3g} to {fastest:.6g} Hz, with sub-steps of {substep_ticks} ticks",
        )
    half_ticks = device.clock_hz / (2 * hz)
    # The smallest multiple with which half a period fits into half of the code memory.
    longer = int(-(-half_ticks // (substep_ticks * (device.code_bits // 2))))
    ticks = min(longer * substep_ticks, device.substep_ticks_max)
    return SquareWave(max(1, round(half_ticks / ticks)), ticks)


def square(half_substeps: int, substep_ticks: int, device: Capabilities) -> SquareWave:
    """Return a square wave. Raises UsageError if it exceeds the code memory."""
    most = device.code_bits // 2
    if not 1 <= half_substeps <= most:
        raise UsageError(
            f"the light cannot be on for {half_substeps} sub-steps at a time", possible=f"1 to {most}"
        )
    return SquareWave(half_substeps, substep_ticks)
