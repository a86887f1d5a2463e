"""The load of the machine during a measurement, without which a measured time means little."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from statistics import fmean, median

from acquire.cores import slowness, usable_cores


@dataclass(frozen=True, slots=True)
class Busyness:
    """Load of the machine: the ``cores`` that the process may use, and the mean one-minute ``load`` average.

    ``share`` is the median share of a core that a busy thread got, ``least_share`` the smallest.
    """

    cores: int
    load: float
    share: float
    least_share: float

    def facts(self) -> dict[str, float]:
        """Return the numbers for a page and its summary."""
        return {
            "cores": self.cores,
            "load": round(self.load, 1),
            "share_percent": round(100 * self.share),
            "least_share_percent": round(100 * self.least_share),
        }


@dataclass(slots=True)
class HostWatch:
    """Samples the load between measurements, so that the measured work itself is not counted."""

    _loads: list[float] = field(default_factory=list)
    _shares: list[float] = field(default_factory=list)

    def look(self) -> None:
        """Take a sample, which occupies a core for a few hundredths of a second."""
        self._loads.append(os.getloadavg()[0])
        # The load average counts the last minute, this what a thread gets at this moment.
        self._shares.append(1 / slowness())

    def busyness(self) -> Busyness:
        """Summarise the samples; take one now if there are none yet."""
        if not self._loads:
            self.look()
        # The least share as well: a median hides a neighbour that was busy during one measurement.
        return Busyness(usable_cores(), fmean(self._loads), median(self._shares), min(self._shares))
