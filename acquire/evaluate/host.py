"""How busy the machine was while something was measured: a time says little without it."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from statistics import fmean, median

from acquire.cores import slowness, usable_cores


@dataclass(frozen=True, slots=True)
class Busyness:
    """``cores`` that the process may use; ``load`` is the mean of the load averages of a minute.

    ``share`` of a core is what a thread got that wanted a whole one: the median, and ``least_share``.
    """

    cores: int
    load: float
    share: float
    least_share: float

    def facts(self) -> dict[str, float]:
        """As a page and its summary tell it."""
        return {
            "cores": self.cores,
            "load": round(self.load, 1),
            "share_percent": round(100 * self.share),
            "least_share_percent": round(100 * self.least_share),
        }


@dataclass(slots=True)
class HostWatch:
    """Looks at the machine between what is measured, so that it does not see the measured work itself."""

    _loads: list[float] = field(default_factory=list)
    _shares: list[float] = field(default_factory=list)

    def look(self) -> None:
        """Takes a core for some hundredths of a second."""
        self._loads.append(os.getloadavg()[0])
        self._shares.append(1 / slowness())

    def busyness(self) -> Busyness:
        """What was seen; looks now where nobody has looked yet."""
        if not self._loads:
            self.look()
        return Busyness(usable_cores(), fmean(self._loads), median(self._shares), min(self._shares))
