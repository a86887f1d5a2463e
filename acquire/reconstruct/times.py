"""Conversion between a recording's sub-steps and the times that a user types and reads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.store import Recording

UNITS_NS = {"s": 1e9, "ms": 1e6, "us": 1e3}


@dataclass(frozen=True, slots=True)
class Times:
    """Times of a recording, counted from the first line's read-out, which begins at ``first_substep``."""

    first_substep: int
    substep_ns: float

    @classmethod
    def of(cls, recording: Recording) -> Times:
        geometry = recording.geometry_for(1)
        # Time stamps are those of read-out, n − 1 sub-steps after a line's first exposure.
        first = geometry.substeps * recording.first_line + geometry.readout_substep
        return cls(first, recording.line_period_ns / geometry.substeps)

    def substep(self, after_ns: int) -> int:
        """Return the sub-step that begins ``after_ns`` after the first read-out."""
        return self.first_substep + round(after_ns / self.substep_ns)

    def words(self, substep: int) -> str:
        """Return the time at which a sub-step begins, in the form of ``--from``: 52.03ms."""
        return duration((substep - self.first_substep) * self.substep_ns)

    def utc_ns(self, substeps: NDArray[np.int64], anchor: tuple[int, int]) -> NDArray[np.int64]:
        """Return the UTC at which sub-steps begin; ``anchor`` is a sub-step and its UTC."""
        offset: NDArray[np.int64] = np.rint((substeps - anchor[0]) * self.substep_ns).astype(np.int64)
        return anchor[1] + offset


def duration(ns: float) -> str:
    """Format a duration in the largest unit that gives at least 1: 52.03ms, 1.2s, 300us."""
    unit = next((unit for unit, length in UNITS_NS.items() if abs(ns) >= length), "us")
    return f"{ns / UNITS_NS[unit]:.6g}{unit}"
