"""The step ``linearity``: a ramp of light whose ratios the trigger's clock determines, after EMVA 1288.

In every sub-step the light is on for w ticks. A line collects light in proportion to w, except that the
light's edges lengthen or shorten every pulse by the same w₀. A camera that reads d DN above its dark level
then has::

    f(d) = s·(w + w₀),   f(d) = d + Σ_k c_k·d^k,   k = 2 … 4

with c_k common to an arm's columns, and one s and w₀ per column, so that neither the lamp's edges nor the
scene need be known. This is linear in all unknowns: the residual of d from a column's straight line in w is
explained by the residuals of d², d³, d⁴. An F-test decides how many of these powers are significant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import f as f_distribution

from acquire.calibrate.calibration import Finding, Measured
from acquire.calibrate.checks import LOWEST_LIGHT_DN, MOST_SATURATED, offset_of, per_arm, refuse_coded
from acquire.calibrate.curve import knots_dn
from acquire.calibrate.exposure import moments, no_progress
from acquire.converter import ConverterCurve
from acquire.errors import UsageError
from acquire.lines import ARMS
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from acquire.calibrate.calibration import Calibration
    from acquire.calibrate.exposure import Exposure, Progress

MOST_POWERS = 3
"""Upper limit on the powers in addition to the straight line."""
CHANCE = 1e-3
"""Probability of accepting a power by chance."""
PARTS = 16
"""Parts of a sub-step: the dimmest level of a ramp has one of them, the brightest all but one."""
FEWEST_LEVELS = 8
FEWEST_BETWEEN = 5
LOWEST, HIGHEST = 0.05, 0.95
"""Shares of saturation: EMVA 1288's linearity error is that of the levels in between."""
STEADY = 1e-3
"""Relative change of a lamp between recordings; it sets the weight of dim relative to bright levels."""
FALLEN = 0.7
"""Share of the preceding level's variance below which pixels are full."""
REACHED = 0.8
"""Share of saturation below which a warning states the end of a ramp."""


@dataclass(frozen=True, slots=True, eq=False)
class Ramp:
    """Levels of one arm that are neither too dim nor full, dimmest first.

    Attributes
    ----------
    ticks : (level,) for which the light is on in a sub-step
    light_dn : (level, column) above black
    noise_dn : (level,) standard error of a level's mean over columns
    full_dn : saturation: white, or the level at which pixels are full if that is lower
    """

    ticks: NDArray[np.float64]
    light_dn: NDArray[np.float64]
    noise_dn: NDArray[np.float64]
    full_dn: float

    @property
    def level_dn(self) -> NDArray[np.float64]:
        """(level,) mean over the columns, above black."""
        return np.asarray(self.light_dn.mean(axis=1))

    @property
    def weight(self) -> NDArray[np.float64]:
        """1/σ² of the levels."""
        return np.asarray(1 / (self.noise_dn**2 + (STEADY * self.level_dn) ** 2))

    @property
    def reached(self) -> float:
        """The brightest level, relative to saturation."""
        return float(self.level_dn.max() / self.full_dn)


@dataclass(frozen=True, slots=True, eq=False)
class Bend:
    """Non-linearity of one arm: c_k in units of its brightest level, none if it is linear."""

    powers: NDArray[np.float64]
    covariance: NDArray[np.float64]
    top_dn: float

    def excess(self, light_dn: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the excess of samples that are ``light_dn`` above black, and its standard uncertainty.

        Which readings are right is a matter of convention: here black and the brightest level are, as in the
        data sheets of converters. Below and above them, the curve continues straight.
        """
        x = light_dn / self.top_dn
        # less a straight line, so that the excess is 0 at black and at the brightest level
        bent = _powers(x, len(self.powers)) - x[..., None]
        # f of the brightest level is (1 + Σ c_k) times its reading; this makes the reading right
        scale = 1 / (1 + self.powers.sum())
        error = np.sqrt(np.einsum("...i,ij,...j->...", bent, self.covariance, bent))
        return -self.top_dn * scale * (bent @ self.powers), self.top_dn * abs(scale) * error


def linearity(
    exposures: Sequence[Exposure], known: Calibration, *, progress: Progress = no_progress
) -> Finding:
    """Measure EMVA 1288's linearity error of both cameras, and the curve of a non-linear one, from a ramp.

    ``exposures`` show a scene at rest under steady light that is on for different parts of a sub-step.
    Recordings with light for whole sub-steps are ignored, since they have no edges like the others. Raises
    UsageError without a dark, for light that follows a code, and for too few levels.
    """
    offset = offset_of(known, "linearity")
    usable = np.ones_like(offset, np.bool_) if known.usable is None else known.usable
    ramps = _ramps(exposures, offset, usable, progress)
    bends = [_bend(ramp) for ramp in ramps]
    knots = knots_dn(known.instrument)
    excess, doubt = [], []
    for bend, dn, row, good in zip(bends, knots, offset, usable, strict=True):
        # one curve for all columns of an arm, and thus from their mean black level
        found = bend.excess(dn - row[good].mean())
        excess.append(found[0])
        doubt.append(found[1])
    curve = ConverterCurve(knots, np.stack(excess))
    errors = [deviations(ramp, ramp.level_dn) for ramp in ramps]
    corrected = [
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
        "left_over": per_arm(np.array([each for each, _ in corrected])),
    }
    warnings = tuple(_doubts(ramps, bends, known))
    return Finding("linearity", exposures[0].instrument, quantities, facts=facts, warnings=warnings)


def level_ticks(dimmest: Exposure, offset: NDArray[np.float64]) -> list[int]:
    """Return the ticks of light for each level of a ramp, given a recording with a `PARTS`-th of a sub-step.

    The levels go up to white, or to the longest pulse that leaves room for an edge in a sub-step. Every
    second level is on the way up and the others on the way down, so that a lamp that grows dimmer does not
    look like a non-linearity.
    """
    lit, whole = lit_ticks(dimmest)
    light = (moments(dimmest).mean - offset).mean(axis=1)
    room = float((dimmest.camera("white_dn") - offset.mean(axis=1)).min())
    most = min(whole - lit, round(lit * room / max(float(light.max()), LOWEST_LIGHT_DN)))
    # without the dimmest, which is recorded already
    levels = sorted({round(each) for each in np.linspace(lit, max(most, lit), PARTS - 1)} - {lit})
    return levels[::2] + levels[1::2][::-1]


def lit_ticks(exposure: Exposure) -> tuple[int, int]:
    """Return the ticks of a sub-step for which the light is on, and all ticks of a sub-step."""
    trigger = exposure.recording.attrs["config"]["trigger"]
    light, whole = trigger["light"], int(trigger["substep_ticks"])
    closes = whole if light["close_ticks"] is None else int(light["close_ticks"])
    return closes - int(light["open_ticks"]), whole


def deviations(ramp: Ramp, light_dn: NDArray[np.float64]) -> tuple[float, float]:
    """Return EMVA 1288's linearity error, the mean of |y/(a₀ + a₁·H) − 1|, and its standard uncertainty.

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
    # divided by the levels, so that the squares are those of relative deviations
    design = np.stack([np.ones_like(H), H], axis=1) / y[:, None]
    line = np.linalg.lstsq(design, np.ones_like(y), rcond=None)[0]
    deviation = y / (line[0] + line[1] * H) - 1
    noise = ramp.noise_dn[between] / y
    return float(np.abs(deviation).mean()), float(np.sqrt((noise**2).sum()) / len(y))


def _ramps(
    exposures: Sequence[Exposure], offset: NDArray[np.float64], usable: NDArray[np.bool_], progress: Progress
) -> list[Ramp]:
    ramps, levels = [], []
    for done, exposure in enumerate(exposures):
        refuse_coded(exposure, "linearity")
        ticks, whole = lit_ticks(exposure)
        if ticks < whole:
            levels.append((ticks, whole, moments(exposure)))
        progress(done + 1, len(exposures))
    if len({whole for _, whole, _ in levels}) > 1:
        raise UsageError(
            "recordings with sub-steps of different length do not form a ramp",
            possible="one trigger.substep_ticks",
        )
    white = exposures[0].camera("white_dn")
    for i, arm in enumerate(ARMS):
        kept: list[tuple[int, NDArray[np.float64], float, float]] = []
        good, full = usable[i], float(white[i] - offset[i].mean())
        for ticks, _, found in sorted(levels, key=lambda each: each[0]):
            light, variance = (found.mean - offset)[i, good], found.own_variance[i, good]
            if found.saturated[i, good].mean() > MOST_SATURATED:
                break
            # full pixels have hardly any shot noise
            if kept and variance.mean() < FALLEN * kept[-1][3]:
                full = float(kept[-1][1].mean())
                break
            # of the columns' own noise; for what the lamp does there is `STEADY`
            noise = float(np.sqrt((variance / found.lines[i]).sum()) / good.sum())
            if light.mean() > LOWEST_LIGHT_DN:
                kept.append((ticks, light, noise, float(variance.mean())))
        if len(kept) < FEWEST_LEVELS:
            raise UsageError(
                f"arm {arm} has {counted(len(kept), 'level of light')} neither dark nor saturated",
                possible=f"{FEWEST_LEVELS} or more, with the light on for different parts of a sub-step",
                hint="acquire calibrate linearity records them; light the scene to 60 to 95 % of white",
            )
        columns = [np.array(each) for each in zip(*kept, strict=True)]
        ramps.append(Ramp(columns[0].astype(np.float64), columns[1], columns[2], full))
    return ramps


def _bend(ramp: Ramp) -> Bend:
    """Fit a ramp with as many powers as the F-test finds significant."""
    best, best_residual = _fitted(ramp, 0)
    # not ended by the first that is not significant: several powers together may be
    for count in range(1, MOST_POWERS + 1):
        bend, residual = _fitted(ramp, count)
        more, free = count - len(best.powers), len(ramp.ticks) - 2 - count
        ratio = (best_residual - residual) / more / (residual / free)
        if f_distribution.sf(ratio, more, free) < CHANCE:
            best, best_residual = bend, residual
    return best


def _fitted(ramp: Ramp, count: int) -> tuple[Bend, float]:
    """Fit ``count`` powers; return them and the residual of the levels' means, in squares of their σ."""
    top = float(ramp.level_dn.max())
    root = np.sqrt(ramp.weight)[:, None]
    # orthonormal basis of the weighted straight lines: `from_line` is what they leave over
    line = np.linalg.qr(root * np.stack([np.ones_like(ramp.ticks), ramp.ticks], axis=1))[0]

    def from_line(values: NDArray[np.float64]) -> NDArray[np.float64]:
        scaled = root * values.reshape(len(root), int(np.prod(values.shape[1:])))
        return np.asarray((scaled - line @ (line.T @ scaled)).reshape(values.shape))

    x = ramp.light_dn / top
    y, X = from_line(x), from_line(-_powers(x, count))
    powers = np.asarray(np.linalg.lstsq(X.reshape(y.size, count), y.ravel(), rcond=None)[0], np.float64)
    mean = X.mean(axis=1)
    residual = float(((y.mean(axis=1) - mean @ powers) ** 2).sum())
    # A lamp's fluctuations affect all columns alike, so the levels are independent but not their columns.
    covariance = np.linalg.pinv(mean.T @ mean) * residual / (len(y) - 2 - count)
    return Bend(powers, covariance, top), residual


def _powers(x: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return x², x³ … from 0 to 1, continued along their tangents below and above."""
    inside, beyond = np.clip(x, 0, 1), np.maximum(x - 1, 0)
    found = [inside**k + k * beyond for k in range(2, 2 + count)]
    return np.stack(found, axis=-1) if count else np.zeros((*x.shape, 0))


def _doubts(ramps: Sequence[Ramp], bends: Sequence[Bend], known: Calibration) -> list[str]:
    doubts = [
        f"the ramp of arm {arm} ends at {ramp.reached:.0%} of saturation; brighter levels were not measured"
        for arm, ramp in zip(ARMS, ramps, strict=True)
        if ramp.reached < REACHED
    ]
    before = [step for step in ("flat", "transfer") if step in known.steps]
    if before and any(len(bend.powers) for bend in bends):
        doubts.append(f"this curve was not known to {' and '.join(before)}: repeat them")
    return doubts
