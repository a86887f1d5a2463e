"""Repeated runs as one curve with its band, and what is worth saying of it: where more time stops paying.

An answer stands until the next: a curve is a staircase, level after the last answer. A *knee* is where
doubling the time begins to buy less than `STEEP_DB`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from acquire.evaluate.tradeoff import Run

Clock = Literal["seconds", "processor_s"]

STEEP_DB = 3.0
"""Half the error's power: what a doubling of the time must buy to be worth a sentence's "next"."""
LOST_DB = 1.0
"""Below its best, what an end is said to have lost."""


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """A quantity at ``times_s`` over repeats: lowest, median and highest, from when all have an answer."""

    times_s: NDArray[np.float64]
    low: NDArray[np.float64]
    middle: NDArray[np.float64]
    high: NDArray[np.float64]

    def at(self, seconds: float) -> float:
        """The median after so long; that of the ends beyond them."""
        place = int(np.searchsorted(self.times_s, seconds * (1 + 1e-9), "right")) - 1
        return float(self.middle[max(place, 0)])


@dataclass(frozen=True, slots=True)
class Knee:
    """After ``seconds`` there are ``value``; as long again buys ``gain`` more, or all that is left."""

    seconds: float
    value: float
    gain: float
    last: bool
    """The run ended by itself before twice the time."""


def band(runs: Sequence[Run], name: str, clock: Clock = "seconds") -> Band | None:
    """A quantity of all repeats over the wall's or the processor's time; None where it is not known."""
    stairs = []
    for run in runs:
        known = [(getattr(each, clock), getattr(each, name)) for each in run.points]
        steps = [(at, value) for at, value in known if value is not None and math.isfinite(value)]
        if steps:
            stairs.append(np.array(sorted(steps)))
    if not stairs:
        return None
    begin = max(each[0, 0] for each in stairs)
    times_s = np.unique(np.concatenate([[begin], *(each[:, 0] for each in stairs)]))
    times_s = times_s[times_s >= begin]
    places = [np.searchsorted(each[:, 0], times_s * (1 + 1e-9), "right") - 1 for each in stairs]
    values = np.array([each[place, 1] for each, place in zip(stairs, places, strict=True)])
    return Band(times_s, values.min(axis=0), np.median(values, axis=0), values.max(axis=0))


def knees(curve: Band, *, ended: bool) -> list[Knee]:
    """Where doubling the time stops paying; ``ended``: by itself, so that there is nothing after the end.

    What stops before it has begun to climb is no knee, unless it never climbs.
    """
    end, first = float(curve.times_s[-1]), float(curve.middle[0])
    found: list[Knee] = []
    flat = -math.inf
    for seconds in map(float, curve.times_s):
        last = 2 * seconds > end
        if last and not ended:
            break
        value = curve.at(seconds)
        gain = curve.at(2 * seconds) - value
        if gain < STEEP_DB and value >= flat + STEEP_DB:
            found.append(Knee(seconds, value, gain, last))
            flat = value
    return [each for each in found if each.value >= first + STEEP_DB] or found[-1:]


def sentences(runs: Sequence[Run]) -> list[str]:
    """What the time of one solver, preset and dtype buys, in words; nothing where the truth is not known."""
    curve = band(runs, "psnr_db")
    if curve is None:
        return []
    name, end = f"{runs[0].solver}, {runs[0].preset}", float(curve.times_s[-1])
    cut = any(run.cut for run in runs)
    found = [_in_words(knee, end) for knee in knees(curve, ended=not cut)]
    best = int(np.argmax(curve.middle))
    if (lost := float(curve.middle[best] - curve.middle[-1])) >= LOST_DB:
        found.append(
            f"best after {plain(curve.times_s[best])} s with {curve.middle[best]:.0f} dB; "
            f"going on to {plain(end)} s loses {lost:.0f}"
        )
    if not cut:
        return [f"{name}: {each}." for each in found]
    climbed = curve.at(end) - curve.at(end / 2)
    rest = (
        f"cut by its budget after {plain(end)} s with {curve.at(end):.0f} dB; "
        f"the second half of that time bought {_amount(climbed)}"
    )
    return [f"{name}: {each}." for each in [*found, rest]]


def _in_words(knee: Knee, end_s: float) -> str:
    bought = f"{plain(knee.seconds)} s buy {knee.value:.0f} dB"
    if knee.last and end_s <= 1.02 * knee.seconds:
        return f"{bought}, and there it ends"
    if knee.last:
        return f"{bought}; the rest, to {plain(end_s)} s, buys {_amount(knee.gain)}"
    return f"{bought}; the next {plain(knee.seconds)} s buy {_amount(knee.gain)}"


def _amount(decibel: float) -> str:
    return f"{decibel:.0f} more" if decibel >= 0.5 else "nothing"


def plain(seconds: float) -> str:
    """Two digits, without an exponent: 0.85, 15, 120."""
    if seconds <= 0:
        return "0"
    digits = 1 - math.floor(math.log10(seconds))
    return f"{round(seconds, digits):.{max(0, digits)}f}"
