"""The highest line rate at which a load runs without a loss, by halving what is not known yet."""

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
"""Ends when the lowest rate that failed is no more than so many times the highest that held."""
MOST_RUNS = 9
_RING_GOOD = 0.5
"""A ring that was fuller than this would have overflowed in a longer run."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One run at one rate; ``report`` is None where the capture path could not go through with it."""

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
    tell: Callable[[Trial], object] | None = None,
    most_runs: int = MOST_RUNS,
) -> list[Trial]:
    """Every run in its order, from ``first_hz`` on; `best` picks the result."""
    trials: list[Trial] = []
    good, bad, rate = 0.0, float("inf"), first_hz
    while len(trials) < most_runs and bad > good * NEAR:
        trial = _try(replace(load, line_rate_hz=rate), directory, seconds)
        trials.append(trial)
        if tell is not None:
            tell(trial)
        if trial.held:
            good = rate
        else:
            bad = rate
        rate = good * 1.5 if bad == float("inf") else (good + bad) / 2
    return trials


def best(trials: list[Trial]) -> Trial | None:
    """The fastest that held, None where none did."""
    return max((trial for trial in trials if trial.held), key=lambda trial: trial.line_rate_hz, default=None)


def _try(load: Load, directory: Path, seconds: float) -> Trial:
    try:
        return Trial(load.line_rate_hz, run_load(load, directory, seconds))
    except (DataError, DeviceError) as error:
        return Trial(load.line_rate_hz, None, str(error))
