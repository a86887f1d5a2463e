"""Iterations within limits: their number, a budget of time, and a stop from outside."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from acquire.recon.result import Progress

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.recon.request import Stop

FINISH_SHARE = 0.04
"""Of a budget, kept for what comes after the last iteration: the video and its quality."""


class IterationClock:
    """Counts iterations over all stages of a solver and says when they must end, and why (``ended``)."""

    def __init__(
        self,
        iterations: int,
        budget_s: float | None = None,
        progress: Callable[[Progress], None] | None = None,
        stop: Stop | None = None,
    ) -> None:
        self.iterations, self.done, self.ended = iterations, 0, "done"
        self._budget_s, self._progress, self._stop = budget_s, progress, stop
        self._began = time.perf_counter()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._began

    def run(self, most: int, stage: str, share: float = 1.0) -> Iterator[int]:
        """Yields before each iteration of a stage that may take ``share`` of the budget.

        The very first iteration of all is always made, so that there is something to show.
        """
        begun, last = self.seconds, min(self.done + most, self.iterations)
        first = self.done
        while self.done < last and self._may_go_on(begun, first, share):
            yield self.done
            self.done += 1
            if self._progress is not None:
                self._progress(Progress(self.done, self.iterations, self.seconds, stage))

    def spent(self, share: float) -> bool:
        """Whether that share of the budget is gone."""
        return self._budget_s is not None and self.seconds > share * self._budget_s

    def converged(self) -> None:
        """Nothing is to be gained from more iterations."""
        self.ended = "converged"

    def _may_go_on(self, begun: float, first: int, share: float) -> bool:
        if self.done and self._stop is not None and self._stop.is_set():
            self.ended = "stopped"
            return False
        if self._budget_s is None or not self.done:
            return True
        made = self.done - first
        one = (self.seconds - begun) / made if made else 0.0
        allowed = self._budget_s * share * (1 - FINISH_SHARE)
        if self.seconds + one <= allowed:
            return True
        if share >= 1:
            self.ended = "budget"
        return False
