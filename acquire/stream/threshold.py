"""Detects when the lines' mean crosses a level, with hysteresis, so that noise at the level is one event."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.flags import NO_IMAGE

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MOST_COLUMNS = 64
"""Evenly spaced columns over which a line's mean is taken, at most."""


@dataclass(frozen=True, slots=True)
class ThresholdPlan:
    """Level for the mean of ``average_lines`` lines of ``arm``; re-armed ``hysteresis_dn`` back from it."""

    arm: str
    level_dn: float
    hysteresis_dn: float
    rising: bool
    average_lines: int


class Threshold:
    """Finds the crossings in lines that come block by block. The first lines only fix the initial side."""

    def __init__(self, plan: ThresholdPlan) -> None:
        self.plan = plan
        self._beyond: bool | None = None

    def crossings(self, first_line: int, pixels: NDArray[Any], flags: NDArray[np.uint16]) -> list[int]:
        """Return the first line of every averaged group in ``pixels`` (line, pixel) that has a crossing.

        Lines without an image, by their ``flags``, have no part in the means.
        """
        plan, sign = self.plan, 1.0 if self.plan.rising else -1.0
        found = []
        # Means of average_lines lines each, and of the remainder, over some of the columns: a threshold needs
        # no more, and all columns of a wide sensor would take a processor.
        step = -(-pixels.shape[1] // _MOST_COLUMNS)
        levels = pixels[:, ::step].mean(axis=1, dtype=np.float32)
        usable = (flags & NO_IMAGE) == 0
        starts = np.arange(0, len(levels), plan.average_lines)
        counts = np.add.reduceat(usable, starts, dtype=np.int64)
        totals = np.add.reduceat(np.where(usable, levels, 0), starts)
        for number in np.flatnonzero(counts).tolist():
            above = sign * (float(totals[number] / counts[number]) - plan.level_dn)
            if above >= 0 and self._beyond is False:
                found.append(first_line + number * plan.average_lines)
            if above >= 0:
                self._beyond = True
            elif self._beyond is None or above < -plan.hysteresis_dn:
                self._beyond = False
        return found
