"""Iterations within limits: their number, a budget of wall time, and a stop from outside.

A budget is kept by looking at the wall before each iteration: whether one as long as the longest of late
still fits before what comes after the last. A core that is shared makes all of them longer alike.
"""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING

from acquire.recon.compiling import compiled_s
from acquire.recon.result import Look, Progress

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import Any

    from numpy.typing import NDArray

    from acquire.recon.options import Stop

FINISH_SHARE = 0.02
"""Of a budget, kept for what comes after the last iteration (the video and its quality), and"""
FINISH_ITERATIONS = 1.5
"""as long as so many iterations."""
REMEMBERED = 20
"""Iterations of which the longest is what the next may take; some do more than others, as every 20th of a
refinement."""
RESERVED_SHARE = 0.15
"""Of a budget, the most that is kept for iterations after the last."""
SLOWER = 1.1
"""Than the longest before it an iteration of these may be."""
FIRST_OF_STAGE = 4.0
"""The first of another stage may take so many times the longest before it."""


class IterationClock:
    """Counts iterations over all stages of a solver and says when they must end, and why (``ended``).

    ``done`` are those that the limit is for, ``made`` all, those of trials too.

    Its time is the wall's since ``began`` (`time.monotonic`; else now), without what compiling took.
    ``shortcuts`` are sentences about what was left out for want of time. ``looks`` is called after iterations
    of what has a video already; the time it takes does not count.
    """

    looks: Callable[[Look], object] | None = None

    def __init__(
        self,
        iterations: int,
        budget_s: float | None = None,
        progress: Callable[[Progress], None] | None = None,
        stop: Stop | None = None,
        began: float | None = None,
    ) -> None:
        self.iterations, self.done, self.ended = iterations, 0, "done"
        self.made = 0
        self.shortcuts: list[str] = []
        self._budget_s, self._progress, self._stop = budget_s, progress, stop
        self._began = time.monotonic() if began is None else began
        self._compiled_before, self._aside_s = compiled_s(), 0.0
        self._processor_began_s = time.process_time()
        self._lately_s: deque[float] = deque(maxlen=REMEMBERED)
        self._reserved = 0.0

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._began - self.compiled_s - self._aside_s

    @property
    def processor_s(self) -> float:
        """Of all threads of this process, whatever it compiled."""
        return time.process_time() - self._processor_began_s

    @property
    def asked(self) -> bool:
        """Whether who looks on wants the answer now."""
        return self._stop is not None and self._stop.is_set()

    @property
    def compiled_s(self) -> float:
        """What compiling took meanwhile: once after an installation, and no part of a budget."""
        return compiled_s() - self._compiled_before

    @property
    def longest_s(self) -> float:
        """The longest iteration of late; 0 before the first."""
        return max(self._lately_s, default=0.0)

    @property
    def mean_s(self) -> float:
        """An iteration of late in the mean; 0 before the first."""
        return sum(self._lately_s) / max(1, len(self._lately_s))

    def reserve(self, iterations: float) -> None:
        """Keep time for so many after the last of the solver's (`afterwards`), as long as those of late."""
        self._reserved = iterations

    def afterwards(self, most: int, least: int = 0, twice: int = 0) -> Iterator[int]:
        """Yields before each iteration that time was kept for: nothing is kept from now on.

        What comes after the last of these is told by their mean: only some of them, as a refinement's every
        fifth, are much longer. The first ``least`` are made where they fit themselves. With ``twice``, as
        many again are to follow: none is made where not that many fit twice.
        """
        self._reserved = 0.0
        before, lately = self._lately_s, deque[float](maxlen=REMEMBERED)
        expected_s, self._lately_s = self.mean_s, lately
        for made in range(most):
            needed_s, after_s = SLOWER * self.longest_s, self.mean_s if made >= least else 0.0
            if twice:
                one_s = self.mean_s or expected_s
                needed_s = max(needed_s, one_s) + one_s * (max(twice, made + 1) + max(twice - made - 1, 0))
            if self.asked or not self._fits(needed_s, after_s):
                break
            begun = self.seconds
            yield made
            if made == 1:
                lately.clear()  # the first prepares what the others have
            lately.append(self.seconds - begun)
        if not lately:
            self._lately_s = before

    def run(
        self, most: int, stage: str, share: float = 1.0, video: Callable[[], NDArray[Any]] | None = None
    ) -> Iterator[int]:
        """Yields before each iteration of a stage that may take ``share`` of the budget.

        ``video`` gives the answer as it is after an iteration, dimensionless, to who looks on.

        The very first iteration of all is always made, so that there is something to show.
        """
        last = min(self.done + most, self.iterations)
        expected = FIRST_OF_STAGE * self.longest_s
        before, lately = self._lately_s, deque[float](maxlen=REMEMBERED)
        self._lately_s = lately
        while self.done < last and self._may_go_on(expected, share):
            begun = self.seconds
            yield self.done
            self.done += 1
            self.made += 1
            lately.append(self.seconds - begun)
            expected = self.longest_s
            if self._progress is not None:
                self._progress(Progress(self.made, max(self.made, self.iterations), self.seconds, stage))
            if video is not None:
                self.show(stage, video)
        if not lately:
            self._lately_s = before

    def attempt(self, most: int, stage: str, share: float = 1.0) -> Iterator[int]:
        """As `run`, for iterations beside the limit, of a trial that may come to nothing; one is made.

        Nobody sees them: `show` what is the best after a trial.
        """
        lately = self._lately_s = deque(maxlen=REMEMBERED)
        for tried in range(most):
            if tried and (self._stopped() or not self.affords(self.longest_s, share)):
                return
            begun = self.seconds
            yield tried
            self.made += 1
            lately.append(self.seconds - begun)
            if self._progress is not None:
                self._progress(Progress(self.made, max(self.made, self.iterations), self.seconds, stage))

    def show(self, stage: str, video: Callable[[], NDArray[Any]]) -> None:
        """The answer as it would be now, dimensionless, to who looks on."""
        if self.looks is not None:
            self._show(self.looks, stage, video)

    def spent(self, share: float) -> bool:
        """Whether that share of the budget is gone, or all is to stop."""
        if self.made and self._stopped():
            return True
        return self._budget_s is not None and self.seconds > share * self._budget_s

    def affords(self, seconds: float, share: float = 1.0) -> bool:
        """Whether work of so long fits before the end, or into that share of the budget."""
        return self._fits(seconds, self.longest_s, share)

    def _fits(self, seconds: float, iteration_s: float, share: float = 1.0) -> bool:
        """As `affords`, where what comes after the last iteration is told by one of so long."""
        if self._budget_s is None:
            return True
        finish_s = FINISH_SHARE * self._budget_s + FINISH_ITERATIONS * iteration_s
        finish_s += min(self._reserved * self.mean_s, RESERVED_SHARE * self._budget_s)
        return self.seconds + seconds <= min(share * self._budget_s, self._budget_s - finish_s)

    def begin_anew(self) -> None:
        """What was done so far does not count against the limit of iterations."""
        self.done = 0

    def converged(self) -> None:
        """Nothing is to be gained from more iterations."""
        self.ended = "converged"

    def _show(self, looks: Callable[[Look], object], stage: str, video: Callable[[], NDArray[Any]]) -> None:
        seconds, wall, processor = self.seconds, time.monotonic(), time.process_time()
        looks(Look(self.made, seconds, self.processor_s, stage, video))
        self._aside_s += time.monotonic() - wall
        self._processor_began_s += time.process_time() - processor

    def _may_go_on(self, expected: float, share: float) -> bool:
        if self.made and self._stopped():
            return False
        if not self.made or self.affords(expected, share):
            return True
        if share >= 1:
            self.ended = "budget"
        return False

    def _stopped(self) -> bool:
        if not self.asked:
            return False
        self.ended = "stopped"
        return True
