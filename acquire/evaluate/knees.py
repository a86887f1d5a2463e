"""Repeated runs as one curve with a band, and sentences about the point where more time stops paying off.

A result holds until the next one, so a curve is a staircase that stays level after the last result. A *knee*
is where doubling the time begins to gain less than `STEEP_DB`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from acquire.evaluate.tradeoff import TradeoffRun

Clock = Literal["seconds", "processor_s"]

STEEP_DB = 3.0
"""Gain that makes doubling the time worthwhile: it halves the power of the error."""
LOST_DB = 1.0
"""A run that ends this far below its best result is reported to have lost accuracy."""


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """Lowest, median and highest value of a quantity over the repeats, once all of them have a result."""

    times_s: NDArray[np.float64]
    low: NDArray[np.float64]
    middle: NDArray[np.float64]
    high: NDArray[np.float64]

    def at(self, seconds: float) -> float:
        """Return the median at a time; outside the curve, its first or last value."""
        # A result holds from its own time on, also if rounding has made ``seconds`` a little smaller.
        place = int(np.searchsorted(self.times_s, seconds * (1 + 1e-9), "right")) - 1
        return float(self.middle[max(place, 0)])


@dataclass(frozen=True, slots=True)
class Knee:
    """``value`` is reached after ``seconds``; the same time again, or the rest, adds only ``gain``."""

    seconds: float
    value: float
    gain: float
    last: bool
    """The run ended normally before twice this time."""


def band(runs: Sequence[TradeoffRun], name: str, clock: Clock = "seconds") -> Band | None:
    """Return a quantity of all repeats over the wall or processor time; None if it is not known."""
    stairs = []
    for run in runs:
        known = [(getattr(each, clock), getattr(each, name)) for each in run.points]
        steps = [(at, value) for at, value in known if value is not None and math.isfinite(value)]
        if steps:
            # By time: `searchsorted` needs it below.
            stairs.append(np.array(sorted(steps)))
    if not stairs:
        return None
    # before that, the median would be one of fewer repeats
    begin = max(each[0, 0] for each in stairs)
    times_s = np.unique(np.concatenate([[begin], *(each[:, 0] for each in stairs)]))
    times_s = times_s[times_s >= begin]
    # as in `Band.at`
    places = [np.searchsorted(each[:, 0], times_s * (1 + 1e-9), "right") - 1 for each in stairs]
    values = np.array([each[place, 1] for each, place in zip(stairs, places, strict=True)])
    return Band(times_s, values.min(axis=0), np.median(values, axis=0), values.max(axis=0))


def knees(curve: Band, *, ended: bool) -> list[Knee]:
    """Return the points where doubling the time stops paying off.

    ``ended`` states that the runs ended normally, so that there is nothing to gain after the end. A flat part
    before the curve begins to rise is not a knee, unless the curve never rises.
    """
    end, first = float(curve.times_s[-1]), float(curve.middle[0])
    found: list[Knee] = []
    flat = -math.inf
    for seconds in map(float, curve.times_s):
        last = 2 * seconds > end
        # for a run that was cut, the gain of doubling the time is unknown
        if last and not ended:
            break
        value = curve.at(seconds)
        gain = curve.at(2 * seconds) - value
        if gain < STEEP_DB and value >= flat + STEEP_DB:
            found.append(Knee(seconds, value, gain, last))
            flat = value
    return [each for each in found if each.value >= first + STEEP_DB] or found[-1:]


def sentences(runs: Sequence[TradeoffRun]) -> list[str]:
    """Describe what the time gains for one solver, preset and dtype; empty if the truth is not known."""
    curve = band(runs, "psnr_db")
    if curve is None:
        return []
    name, end = f"{runs[0].solver}, {runs[0].preset}", float(curve.times_s[-1])
    cut = any(run.cut for run in runs)
    found = []
    for knee in knees(curve, ended=not cut):
        if not knee.last:
            then = f"; the next {plain(knee.seconds)} s add {_amount(knee.gain)}"
        # What is left of the run is too short to gain anything.
        elif end <= 1.02 * knee.seconds:
            then = ", where the run ends"
        else:
            then = f"; the rest, to {plain(end)} s, adds {_amount(knee.gain)}"
        found.append(f"{plain(knee.seconds)} s give {knee.value:.0f} dB{then}")
    best = int(np.argmax(curve.middle))
    if (lost := float(curve.middle[best] - curve.middle[-1])) >= LOST_DB:
        found.append(
            f"best after {plain(curve.times_s[best])} s with {curve.middle[best]:.0f} dB; "
            f"continuing to {plain(end)} s loses {lost:.0f} dB"
        )
    if not cut:
        return [f"{name}: {each}." for each in found]
    climbed = curve.at(end) - curve.at(end / 2)
    rest = (
        f"cut by its time limit after {plain(end)} s with {curve.at(end):.0f} dB; "
        f"the second half of that time gained {_amount(climbed)}"
    )
    return [f"{name}: {each}." for each in [*found, rest]]


def _amount(decibel: float) -> str:
    return f"{decibel:.0f} dB" if decibel >= 0.5 else "nothing"


def plain(seconds: float) -> str:
    """Format a time with two digits and without an exponent: 0.85, 15, 120."""
    if seconds <= 0:
        return "0"
    # rounded first: 9.96 has its two digits as 10
    rounded = float(f"{seconds:.1e}")
    return f"{rounded:.{max(0, 1 - math.floor(math.log10(rounded)))}f}"
