"""Find the highest line rate at which a load runs without loss, by bisection."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from acquire.capacity.run import run_load
from acquire.errors import DataError, DeviceError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from acquire.capacity.load import Load
    from acquire.capacity.run import LoadReport

RUN_S = 2.0
NEAR = 1.08
"""The search ends when the lowest rate that failed is at most this multiple of the highest sustained one."""
MOST_RUNS = 9
_RING_GOOD = 0.5
"""A ring that was fuller than this would have overflowed in a longer run."""


@dataclass(frozen=True, slots=True)
class RateTrial:
    """One run at one rate; ``report`` is None if the capture path failed, and ``trouble`` is the reason."""

    line_rate_hz: float
    report: LoadReport | None
    trouble: str = ""

    @property
    def held(self) -> bool:
        return self.report is not None and self.report.clean and self.report.ring_peak <= _RING_GOOD


def search_rate(
    load: Load,
    directory: Path,
    first_hz: float,
    seconds: float = RUN_S,
    progress: Callable[[RateTrial], object] | None = None,
    most_runs: int = MOST_RUNS,
) -> list[RateTrial]:
    """Return all runs in order, of which the first is at ``first_hz``; `best` selects the result."""
    trials: list[RateTrial] = []
    good, bad, rate = 0.0, float("inf"), first_hz
    while len(trials) < most_runs and bad > good * NEAR:
        try:
            trial = RateTrial(rate, run_load(replace(load, line_rate_hz=rate), directory, seconds))
        # A capture path that fails at this rate is a result of the search, not its end.
        except (DataError, DeviceError) as error:
            trial = RateTrial(rate, None, str(error))
        trials.append(trial)
        if progress is not None:
            progress(trial)
        if trial.held:
            good = rate
        else:
            bad = rate
        # Until a rate has failed there is nothing to bisect.
        rate = good * 1.5 if bad == float("inf") else (good + bad) / 2
    return trials


def best(trials: list[RateTrial]) -> RateTrial | None:
    """Return the fastest run that was sustained; None if none was."""
    return max((trial for trial in trials if trial.held), key=lambda trial: trial.line_rate_hz, default=None)
