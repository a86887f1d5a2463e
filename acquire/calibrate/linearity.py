"""The step ``linearity``: a ramp of light whose ratios the trigger's clock knows, after EMVA 1288.

In every sub-step the light is on for w ticks, and a line gathers in proportion to w, but for edges that make
every pulse longer or shorter alike, by w₀. A camera that reads d DN above its dark level then has::

    f(d) = s·(w + w₀),   f(d) = d + Σ_k c_k·d^k,   k = 2 … 4

with c_k common to an arm's columns, and s and w₀ of every column, so that neither the lamp's edges nor the
scene need be known. That is linear in all unknowns: what a column's straight line in w leaves over of d is
explained by what it leaves over of d², d³, d⁴. Which of these powers are there, an F-test says.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import f as f_distribution

from acquire.calibrate.calibration import Finding, Measured
from acquire.calibrate.checks import LOWEST_LIGHT_DN, MOST_SATURATED, offset_of, per_arm, refuse_coded
from acquire.calibrate.curve import knots_dn
from acquire.calibrate.exposure import moments, unseen
from acquire.converter import ConverterCurve
from acquire.errors import UsageError
from acquire.lines import ARMS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from acquire.calibrate.calibration import Calibration
    from acquire.calibrate.exposure import Exposure, Progress

MOST_POWERS = 3
"""Beside the straight line."""
CHANCE = 1e-3
"""Of a power that is not there to be believed."""
PARTS = 16
"""Of a sub-step: the dimmest level of a ramp has one of them, the brightest all but one."""
FEWEST_LEVELS = 8
FEWEST_BETWEEN = 5
LOWEST, HIGHEST = 0.05, 0.95
"""Of saturation: EMVA 1288's linearity error is of the levels between."""
STEADY = 1e-3
"""Of a level, by which lamps may change between recordings: it weighs dim levels beside bright ones."""
FALLEN = 0.7
"""Of the largest variance, below which pixels are full."""
REACHED = 0.8
"""Of saturation, below which the end of a ramp is told."""


@dataclass(frozen=True, slots=True, eq=False)
class Ramp:
    """Levels of one arm that are neither too dim nor full, dimmest first.

    Attributes
    ----------
    ticks : (level,) for which the light is on in a sub-step
    light_dn : (level, column) above black
    noise_dn : (level,) standard error of a level's mean over columns
    full_dn : what the level is compared with, as saturation: white, or where pixels are full before
    """

    ticks: NDArray[np.float64]
    light_dn: NDArray[np.float64]
    noise_dn: NDArray[np.float64]
    full_dn: float

    @property
    def level_dn(self) -> NDArray[np.float64]:
        return np.asarray(self.light_dn.mean(axis=1))

    @property
    def weight(self) -> NDArray[np.float64]:
        """1/σ² of the levels."""
        return np.asarray(1 / (self.noise_dn**2 + (STEADY * self.level_dn) ** 2))

    @property
    def reached(self) -> float:
        """The brightest level, as part of saturation."""
        return float(self.level_dn.max() / self.full_dn)


@dataclass(frozen=True, slots=True, eq=False)
class Bend:
    """How one arm bends: c_k in units of its brightest level, none where it is straight."""

    powers: NDArray[np.float64]
    covariance: NDArray[np.float64]
    top_dn: float

    def excess(self, light_dn: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """By how much samples so far above black are too high, and its standard uncertainty.

        What is right of it is a matter of choice: here black and the brightest level are, as data sheets of
        converters have it. Below and above, the curve goes straight on.
        """
        x = light_dn / self.top_dn
        count = len(self.powers)
        bent = _powers(x, count) - x[..., None]
        scale = 1 / (1 + self.powers.sum())
        error = np.sqrt(np.einsum("...i,ij,...j->...", bent, self.covariance, bent))
        return -self.top_dn * scale * (bent @ self.powers), self.top_dn * abs(scale) * error


def linearity(exposures: Sequence[Exposure], known: Calibration, *, progress: Progress = unseen) -> Finding:
    """EMVA 1288's linearity error of both cameras, and the curve of one that bends, from a ramp of light.

    ``exposures`` show a scene at rest under steady light that is on for different parts of a sub-step; light
    that is on all the time has no edges, and tells nothing here. UsageError without a dark, for light that
    follows a code, and for too few levels.
    """
    offset = offset_of(known, "linearity")
    usable = np.ones_like(offset, np.bool_) if known.usable is None else known.usable
    ramps = _ramps(exposures, offset, usable, progress)
    bends = [_bend(ramp) for ramp in ramps]
    knots = knots_dn(known.instrument)
    excess, doubt = [], []
    for bend, dn, row, good in zip(bends, knots, offset, usable, strict=True):
        found = bend.excess(dn - row[good].mean())
        excess.append(found[0])
        doubt.append(found[1])
    curve = ConverterCurve(knots, np.stack(excess))
    errors = [deviations(ramp, ramp.level_dn) for ramp in ramps]
    left = [
        deviations(ramp, ramp.level_dn - bend.excess(ramp.level_dn)[0])
        for ramp, bend in zip(ramps, bends, strict=True)
    ]
    quantities = {
        "linearity_error": Measured(*map(np.array, zip(*errors, strict=True))),
        "excess_dn": Measured(curve.excess_dn, np.stack(doubt)),
    }
    facts = {
        "recordings": [exposure.facts() for exposure in exposures],
        "lines": sum(exposure.lines for exposure in exposures),
        "levels": [len(ramp.ticks) for ramp in ramps],
        "reached": per_arm(np.array([ramp.reached for ramp in ramps])),
        "powers": [len(bend.powers) for bend in bends],
        "left_over": per_arm(np.array([each for each, _ in left])),
    }
    warnings = tuple(_doubts(ramps, bends, known))
    return Finding("linearity", exposures[0].instrument, quantities, facts=facts, warnings=warnings)


def level_ticks(dimmest: Exposure, offset: NDArray[np.float64]) -> list[int]:
    """For how many ticks the light is to be on in a ramp, given a recording with a `PARTS`-th of it.

    Up to white, or all that a sub-step has room for with an edge at its end. Every second level on the way up
    and the others on the way down: a lamp that grows dimmer is no bend.
    """
    lit, whole = lit_ticks(dimmest)
    light = (moments(dimmest).mean - offset).mean(axis=1)
    room = float((dimmest.camera("white_dn") - offset.mean(axis=1)).min())
    most = min(whole - lit, round(lit * room / max(float(light.max()), LOWEST_LIGHT_DN)))
    levels = sorted({round(each) for each in np.linspace(lit, max(most, lit), PARTS - 1)} - {lit})
    return levels[::2] + levels[1::2][::-1]


def lit_ticks(exposure: Exposure) -> tuple[int, int]:
    """For how many ticks of a sub-step the light is on, and how many a sub-step has."""
    trigger = exposure.recording.attrs["config"]["trigger"]
    light, whole = trigger["light"], int(trigger["substep_ticks"])
    closes = whole if light["close_ticks"] is None else int(light["close_ticks"])
    return closes - int(light["open_ticks"]), whole


def deviations(ramp: Ramp, light_dn: NDArray[np.float64]) -> tuple[float, float]:
    """EMVA 1288's linearity error, and its standard uncertainty: the mean of |y/(a₀ + a₁·H) − 1|.

    The line is fitted to the levels from 5 to 95 % of saturation, for the least relative deviations.
    """
    between = (light_dn >= LOWEST * ramp.full_dn) & (light_dn <= HIGHEST * ramp.full_dn)
    H, y = ramp.ticks[between], light_dn[between]
    if len(y) < FEWEST_BETWEEN:
        raise UsageError(
            f"the ramp has {len(y)} levels between {LOWEST:.0%} and {HIGHEST:.0%} of saturation",
            possible=f"{FEWEST_BETWEEN} or more",
            hint="more light, or more levels",
        )
    design = np.stack([np.ones_like(H), H], axis=1) / y[:, None]
    line = np.linalg.lstsq(design, np.ones_like(y), rcond=None)[0]
    deviation = y / (line[0] + line[1] * H) - 1
    noise = ramp.noise_dn[between] / y
    return float(np.abs(deviation).mean()), float(np.sqrt((noise**2).sum()) / len(y))


def _ramps(
    exposures: Sequence[Exposure], offset: NDArray[np.float64], usable: NDArray[np.bool_], progress: Progress
) -> list[Ramp]:
    ramps, seen = [], []
    for done, exposure in enumerate(exposures):
        refuse_coded(exposure, "linearity")
        ticks, whole = lit_ticks(exposure)
        if ticks < whole:
            seen.append((ticks, whole, moments(exposure)))
        progress(done + 1, len(exposures))
    if len({whole for _, whole, _ in seen}) > 1:
        raise UsageError(
            "recordings with sub-steps of different length are no ramp", possible="one trigger.substep_ticks"
        )
    white = exposures[0].camera("white_dn")
    for i, arm in enumerate(ARMS):
        kept: list[tuple[int, NDArray[np.float64], float, float]] = []
        good, full = usable[i], float(white[i] - offset[i].mean())
        for ticks, _, found in sorted(seen, key=lambda each: each[0]):
            light, variance = (found.mean - offset)[i, good], found.own_variance[i, good]
            if found.saturated[i, good].mean() > MOST_SATURATED:
                break
            if kept and variance.mean() < FALLEN * kept[-1][3]:
                full = float(kept[-1][1].mean())
                break
            noise = float(np.sqrt((variance / found.lines[i]).sum()) / good.sum())
            if light.mean() > LOWEST_LIGHT_DN:
                kept.append((ticks, light, noise, float(variance.mean())))
        if len(kept) < FEWEST_LEVELS:
            raise UsageError(
                f"arm {arm} has {len(kept)} levels of light that are neither dark nor saturated",
                possible=f"{FEWEST_LEVELS} or more, each with the light on for another part of a sub-step",
                hint="acquire calibrate linearity records them; is the scene white, at 60 to 95 % of white?",
            )
        columns = [np.array(each) for each in zip(*kept, strict=True)]
        ramps.append(Ramp(columns[0].astype(np.float64), columns[1], columns[2], full))
    return ramps


def _bend(ramp: Ramp) -> Bend:
    """With as many powers as the levels call for."""
    best, best_left = _fitted(ramp, 0)
    for count in range(1, MOST_POWERS + 1):
        bend, left = _fitted(ramp, count)
        more, free = count - len(best.powers), len(ramp.ticks) - 2 - count
        ratio = (best_left - left) / more / (left / free)
        if f_distribution.sf(ratio, more, free) < CHANCE:
            best, best_left = bend, left
    return best


def _fitted(ramp: Ramp, count: int) -> tuple[Bend, float]:
    """With so many powers: the bend, and what is left of the levels' means, in squares of their σ."""
    top = float(ramp.level_dn.max())
    root = np.sqrt(ramp.weight)[:, None]
    line = np.linalg.qr(root * np.stack([np.ones_like(ramp.ticks), ramp.ticks], axis=1))[0]

    def beside_line(values: NDArray[np.float64]) -> NDArray[np.float64]:
        scaled = root * values.reshape(len(root), int(np.prod(values.shape[1:])))
        return np.asarray((scaled - line @ (line.T @ scaled)).reshape(values.shape))

    x = ramp.light_dn / top
    y, X = beside_line(x), beside_line(-_powers(x, count))
    powers = np.asarray(np.linalg.lstsq(X.reshape(y.size, count), y.ravel(), rcond=None)[0], np.float64)
    mean = X.mean(axis=1)
    left = float(((y.mean(axis=1) - mean @ powers) ** 2).sum())
    # a lamp shakes all columns alike: the levels are what is independent, not their columns
    covariance = np.linalg.pinv(mean.T @ mean) * left / (len(y) - 2 - count)
    return Bend(powers, covariance, top), left


def _powers(x: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """x², x³ … from 0 to 1, and on along their tangents below and above."""
    inside, beyond = np.clip(x, 0, 1), np.maximum(x - 1, 0)
    found = [inside**k + k * beyond for k in range(2, 2 + count)]
    return np.stack(found, axis=-1) if count else np.zeros((*x.shape, 0))


def _doubts(ramps: Sequence[Ramp], bends: Sequence[Bend], known: Calibration) -> list[str]:
    dim = [
        f"the ramp of arm {arm} ends at {ramp.reached:.0%} of saturation: what is above is not measured"
        for arm, ramp in zip(ARMS, ramps, strict=True)
        if ramp.reached < REACHED
    ]
    before = [step for step in ("flat", "transfer") if step in known.steps]
    if before and any(len(bend.powers) for bend in bends):
        dim.append(f"{' and '.join(before)} knew nothing of this curve: make them once more")
    return dim
