"""Limits on iterations: their number, a budget of wall time, and a stop from outside.

A budget is kept by checking the wall clock before each iteration: an iteration as long as the longest recent
one must still fit before the work that follows the last one. On a shared core all of them get longer alike.
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
"""Share of the budget kept for the work after the last iteration (the video and its quality), in addition
to"""
FINISH_ITERATIONS = 1.5
"""the time of this many iterations."""
REMEMBERED = 20
"""Number of recent iterations whose longest is the estimate for the next; some do more work than others, as
every 20th of a refinement."""
RESERVED_SHARE = 0.15
"""Upper limit on the share of the budget that is reserved for iterations after the solver's last."""
SLOWER = 1.1
"""Factor by which a reserved iteration may be longer than the longest before it."""
FIRST_OF_STAGE = 4.0
"""Factor by which the first iteration of a new stage may be longer than the longest before it."""


class IterationClock:
    """Counts the iterations of all stages of a solver, decides when they end, and records why (``ended``).

    ``done`` counts the iterations that the limit applies to, ``made`` all of them, trials included.

    Time is wall time since ``began`` (`time.monotonic`; now if None), without compilation and without the
    time spent in ``on_look``, which is called after iterations that have a video. ``shortcuts`` are sentences
    for the user about what was left out for lack of time; ``cause`` is their subject.
    """

    on_look: Callable[[Look], object] | None = None

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
        self._compiled_before, self._excluded_s = compiled_s(), 0.0
        self._processor_began_s = time.process_time()
        self._recent_s: deque[float] = deque(maxlen=REMEMBERED)
        self._stage = ""
        self._reserved = 0.0

    @property
    def seconds(self) -> float:
        """Wall time since the call began, without compilation: the time that a budget limits."""
        return time.monotonic() - self._began - self.compiled_s - self._excluded_s

    @property
    def processor_s(self) -> float:
        """Processor time of all threads of this process, compilation included."""
        return time.process_time() - self._processor_began_s

    @property
    def has_budget(self) -> bool:
        """Whether time is limited."""
        return self._budget_s is not None

    @property
    def stop_requested(self) -> bool:
        """Whether the caller wants the answer now."""
        return self._stop is not None and self._stop.is_set()

    @property
    def cause(self) -> str:
        """What leaves no more time: the caller's interruption, or the budget."""
        return "the interruption" if self.stop_requested else "the budget"

    @property
    def compiled_s(self) -> float:
        """Time spent compiling since the start: once after an installation, and not part of a budget."""
        return compiled_s() - self._compiled_before

    @property
    def longest_s(self) -> float:
        """Duration of the longest recent iteration; 0 before the first."""
        return max(self._recent_s, default=0.0)

    @property
    def mean_s(self) -> float:
        """Mean duration of the recent iterations; 0 before the first."""
        return sum(self._recent_s) / max(1, len(self._recent_s))

    def reserve(self, iterations: float) -> None:
        """Reserve the time of this many recent iterations for `run_reserved`, after the solver's last one."""
        self._reserved = iterations

    def run_reserved(self, most: int, least: int = 0, repeat: int = 0) -> Iterator[int]:
        """Yield before each iteration that time was reserved for, and release the reservation.

        The work after the last of these is estimated from their mean duration, because only some of them, as
        every fifth of a refinement, are much longer. The first ``least`` run if they themselves fit. With
        ``repeat``, as many iterations will be run a second time (at least ``repeat``): none starts unless
        both passes fit.
        """
        self._reserved = 0.0
        before, recent = self._recent_s, deque[float](maxlen=REMEMBERED)
        expected_s, self._recent_s = self.mean_s, recent
        for made in range(most):
            needed_s, after_s = SLOWER * self.longest_s, self.mean_s if made >= least else 0.0
            if repeat:
                one_s = self.mean_s or expected_s
                # The second pass has to fit, and what the first still lacks of ``repeat``.
                passes = max(repeat, made + 1) + max(repeat - made - 1, 0)
                needed_s = max(needed_s, one_s) + one_s * passes
            if self.stop_requested or not self._fits(needed_s, after_s):
                break
            begun = self.seconds
            yield made
            if made == 1:
                recent.clear()  # the first iteration also sets up what the others reuse
            recent.append(self.seconds - begun)
        if not recent:
            self._recent_s = before

    def run(
        self,
        most: int,
        stage: str,
        share: float = 1.0,
        video: Callable[[], NDArray[Any]] | None = None,
        *,
        first: float = FIRST_OF_STAGE,
    ) -> Iterator[int]:
        """Yield before each iteration of a stage that may take ``share`` of the budget.

        ``video`` returns the current answer, dimensionless; it is passed to ``on_look`` after an iteration.
        A new stage begins if ``first`` times the longest iteration before it fits.

        The very first iteration always runs, so that there is a result.
        """
        last = min(self.done + most, self.iterations)
        expected, before = self.longest_s, self._recent_s
        if stage != self._stage:
            # A stage that continues has measured its iterations; those of a new one are different.
            expected, self._recent_s = first * expected, deque(maxlen=REMEMBERED)
        while self.done < last and self._may_continue(expected, share):
            begun = self.seconds
            yield self.done
            self.done += 1
            self._count(self.seconds - begun, stage)
            expected = self.longest_s
            self._stage = stage
            if video is not None:
                self.show(stage, video)
        # If no iteration of the stage fitted, what is known of others remains.
        if not self._recent_s:
            self._recent_s = before

    def attempt(self, most: int, stage: str, share: float = 1.0) -> Iterator[int]:
        """Yield as `run` does, for a trial that may be discarded: its iterations do not count as ``done``.

        At least one runs. They are not shown: call `show` with the best candidate after a trial.
        """
        # A trial's iterations take their own time, which tells nothing about those before or after it.
        self._recent_s, self._stage = deque(maxlen=REMEMBERED), ""
        for tried in range(most):
            if tried and (self._stopped() or not self.affords(self.longest_s, share)):
                return
            begun = self.seconds
            yield tried
            self._count(self.seconds - begun, stage)

    def show(self, stage: str, video: Callable[[], NDArray[Any]]) -> None:
        """Pass the current answer, dimensionless, to ``on_look``; its time does not count."""
        if self.on_look is None:
            return
        seconds, wall, processor = self.seconds, time.monotonic(), time.process_time()
        self.on_look(Look(self.made, seconds, self.processor_s, stage, video))
        self._excluded_s += time.monotonic() - wall
        self._processor_began_s += time.process_time() - processor

    def spent(self, share: float) -> bool:
        """Whether this share of the budget is used up, or a stop was requested."""
        # Before the first iteration there is no result to stop with.
        if self.made and self._stopped():
            return True
        return self._budget_s is not None and self.seconds > share * self._budget_s

    def affords(self, seconds: float, share: float = 1.0) -> bool:
        """Whether work of this duration fits before the end, and into ``share`` of the budget."""
        return self._fits(seconds, self.longest_s, share)

    def reset(self) -> None:
        """Restart the count against the limit of iterations."""
        self.done = 0

    def converged(self) -> None:
        """Record that more iterations would gain nothing."""
        self.ended = "converged"

    def _count(self, seconds: float, stage: str) -> None:
        self.made += 1
        self._recent_s.append(seconds)
        if self._progress is not None:
            # Trials count as made, and may outnumber the limit: never more than the whole is done.
            self._progress(Progress(self.made, max(self.made, self.iterations), self.seconds, stage))

    def _fits(self, seconds: float, iteration_s: float, share: float = 1.0) -> bool:
        """As `affords`, with the final work estimated from an iteration of ``iteration_s``."""
        if self._budget_s is None:
            return True
        finish_s = FINISH_SHARE * self._budget_s + FINISH_ITERATIONS * iteration_s
        # The mean is used, because only some iterations, as every fifth of a refinement, are as long as the
        # longest.
        finish_s += min(self._reserved * self.mean_s, RESERVED_SHARE * self._budget_s)
        return self.seconds + seconds <= min(share * self._budget_s, self._budget_s - finish_s)

    def _may_continue(self, expected: float, share: float) -> bool:
        if self.made and self._stopped():
            return False
        if not self.made or self.affords(expected, share):
            return True
        # A stage that has used up its share ends, but not the run.
        if share >= 1:
            self.ended = "budget"
        return False

    def _stopped(self) -> bool:
        if not self.stop_requested:
            return False
        self.ended = "stopped"
        return True
