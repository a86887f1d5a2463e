"""Steps that measure columns under a dark code or a steady light: dark, ambient, flat.

All samples of one column of a line-scan sensor come from one pixel, so means over lines are fixed patterns
and variances over lines are temporal noise (EMVA Standard 1288, release 4.0, Linear).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.calibrate.calibration import Finding, Measured, unusable_columns
from acquire.calibrate.checks import (
    offset_of,
    per_arm,
    refuse_clipped,
    refuse_coded,
    refuse_level,
    refuse_lit,
    refuse_texture,
    warn_of_drift,
    warn_of_exclusions,
    warn_of_later_corrections,
    warn_of_level,
)
from acquire.calibrate.curve import straightened
from acquire.calibrate.exposure import moments, no_progress
from acquire.errors import UsageError
from acquire.lines import ARMS
from acquire.noise import QUANTISATION_DN2, robust_sigma

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.calibrate.calibration import Calibration
    from acquire.calibrate.exposure import Exposure, Progress

NOISY = 6.0
"""Median absolute deviations of log noise beyond which a column is unusable."""
DEAD, DARK = 0.5, 0.05
"""Response, relative to the arm's median, below which a column is unusable, inside and at an edge, where it
may see half a field."""
DARK_EDGE = 4.0
"""Spreads of the gain below the median at which the optics must have darkened a column at the edge."""
TOGETHER, LEAST_LACK = 3.0, 2e-3
"""Least deficit of the outermost columns together, in standard errors and relative to 1, that counts."""
EDGE_SHARE = 0.125
"""Share of the columns at each edge among which dark ones are looked for."""
SMOOTH_DEGREE = 4


def dark(exposure: Exposure, *, covered: bool = False, progress: Progress = no_progress) -> Finding:
    """Measure offset and noise per column, from lines without the light.

    With ``covered``, the lens is covered: the code does not matter and ambient light is kept out, which the
    offset otherwise includes. Raises UsageError for a code that lights the scene, and for lines that reach 0,
    whose mean is wrong.
    """
    if exposure.code_value != 0 and not covered:
        raise UsageError(
            f"{exposure.recording} is not dark: its light {exposure.light}",
            possible="lines under code 0: code.kind = 'constant', code.value = 0; or a covered lens",
            hint="acquire arm --code dark, and record again; or --covered, if the lens was covered",
        )
    found = moments(exposure, progress)
    refuse_clipped(exposure, found)
    lit = refuse_lit(exposure, found, covered=covered)
    noise = np.sqrt(found.variance)
    lines = found.lines[:, None]
    # Usable columns have a noise like most others.
    size = np.log(np.maximum(noise, 1e-6))
    middle = np.median(size, axis=1, keepdims=True)
    spread = np.median(np.abs(size - middle), axis=1, keepdims=True)
    # where all columns are alike, up to three times their noise is still usable
    usable: NDArray[np.bool_] = size - middle <= np.maximum(NOISY * spread, np.log(3.0))
    quantities = {
        # readings that never change are still uncertain by their rounding
        "offset_dn": Measured(found.mean, np.sqrt(np.maximum(found.variance, QUANTISATION_DN2) / lines)),
        # The standard error of a standard deviation of n values is σ/√(2n).
        "noise_dn": Measured(noise, noise / np.sqrt(2 * lines)),
    }
    facts = {**exposure.facts(), "covered": covered}
    warnings = (*lit, *warn_of_drift(found), *warn_of_exclusions(usable, "noise"))
    return Finding("dark", exposure.instrument, quantities, usable, facts=facts, warnings=warnings)


def ambient(exposure: Exposure, known: Calibration, *, progress: Progress = no_progress) -> Finding:
    """Measure the ambient light on each column: an open lens under a dark code, less `dark`.

    Raises UsageError without a covered dark.
    """
    offset = offset_of(known, "ambient", with_ambient=False)
    if not known.steps["dark"].get("covered"):
        raise UsageError(
            "the offsets of this calibration include the ambient light already: its dark was not covered",
            possible="nothing more to do; or acquire calibrate dark --covered first",
        )
    found = dark(exposure, progress=progress)
    here = found.quantities["offset_dn"]
    spread = np.hypot(here.uncertainty, known.quantities["offset_dn"].uncertainty)
    quantities = {"ambient_dn": Measured(here.value - offset, spread)}
    facts = {**exposure.facts(), "mean_dn": per_arm((here.value - offset).mean(axis=1))}
    return Finding("ambient", exposure.instrument, quantities, facts=facts, warnings=found.warnings)


def flat(
    exposure: Exposure, known: Calibration, *, smooth: bool = False, progress: Progress = no_progress
) -> Finding:
    """Measure gain per column and the arms' balance, from a uniform scene under steady light.

    With ``smooth``, the scene is not quite uniform: a smooth profile (polynomial of degree 4) is attributed
    to it, not to the columns. Columns at the edge that the optics leave dark get the gain 1. The gain of the
    others at the edge may include some fall-off of the field, which their uncertainty covers. Raises
    UsageError for lines that are too dark or saturated, for a code that is not steady, and without a dark.
    """
    refuse_coded(exposure, "flat")
    offset = offset_of(known, "flat")
    found = moments(exposure, progress)
    light, _ = straightened(known, found.mean, offset)
    refuse_level(exposure, found, light)
    response = light / exposure.camera("responsivity_dn")[:, None]
    alive, middle = response > 0, np.median(response, axis=1, keepdims=True)
    shape = response / _profile(response, alive) if smooth else response
    edges = dark_edges(shape, alive)
    usable = response > np.where(edges, DARK, DEAD) * middle
    trusted = usable & ~edges
    if known.usable is not None:
        trusted &= known.usable
    if not trusted.any(axis=1).all():
        arm = ARMS[int(np.argmin(trusted.any(axis=1)))]
        raise UsageError(
            f"{exposure.recording}: no column of arm {arm} is left for a gain: all are excluded",
            possible="a column that the dark has not excluded, with light",
            hint="acquire calibrate show",
        )
    uneven = refuse_texture(exposure, response, trusted, smooth=smooth)
    level = np.array([row[good].mean() for row, good in zip(shape, trusted, strict=True)])[:, None]
    arms = np.array([row[good].mean() for row, good in zip(response, trusted, strict=True)])
    error = np.hypot(
        np.sqrt(found.variance / found.lines[:, None]), known.quantities["offset_dn"].uncertainty
    )
    # flicker of the light is common to all columns: it makes the arms' levels uncertain, not the gains
    own_error = np.sqrt(np.maximum(found.own_variance, QUANTISATION_DN2) / found.lines[:, None])
    relative = np.hypot(own_error, known.quantities["offset_dn"].uncertainty)
    relative = relative / np.where(alive, light, np.inf)  # a column without light has no gain
    relative[:, [0, -1]] = np.hypot(relative[:, [0, -1]], edge_doubt(shape, usable, edges)[:, None])
    gain = np.where(trusted, shape / level, 1.0)
    arm_error = np.sqrt((error**2).sum(axis=1)) / light.sum(axis=1)
    balance = arms / arms.mean()
    quantities = {
        # a gain of 1 that is assumed: a blurred edge of the field takes 5 % of a column's light
        "gain": Measured(gain, np.where(trusted, relative, 0.05)),
        # a/((a + b)/2) changes by half of the relative change of either arm
        "balance": Measured(balance, balance * np.hypot(*arm_error) / 2),
    }
    facts = {
        **exposure.facts(),
        "level_dn": per_arm(light.mean(axis=1)),
        "smooth": smooth,
        "part_a": round(float(balance[0] / balance.sum()), 6),
        "optics_hide_columns": unusable_columns(trusted | ~usable),
        "edge_response": {
            arm: {str(column): round(float(row[column]), 6) for column in np.flatnonzero(dark)}
            for arm, row, dark in zip(ARMS, shape / level, edges, strict=True)
        },
    }
    warnings = (
        *warn_of_level(exposure, light),
        *uneven,
        *warn_of_drift(found),
        *warn_of_exclusions(usable | ~exposure.lit, "response"),
        *warn_of_later_corrections(known),
    )
    return Finding("flat", exposure.instrument, quantities, usable, facts=facts, warnings=warnings)


def dark_edges(shape: NDArray[np.float64], usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the columns from each edge inwards that lie beyond the field and are therefore dark."""
    dark = np.zeros_like(usable)
    most = max(1, round(EDGE_SHARE * shape.shape[1]))
    for row, good, out in zip(shape, usable, dark, strict=True):
        # By medians, which the dark columns that are looked for hardly change.
        middle = np.median(row[good])
        spread = robust_sigma(row[good] - middle)
        low = row < middle - np.maximum(DARK_EDGE * spread, 2e-3 * middle)
        for order in (slice(None, most), slice(None, -most - 1, -1)):
            # from the edge inwards, up to the first column that is bright
            out[order] = np.logical_and.accumulate(low[order])
    return dark | _blurred_edges(shape, usable, dark)


def _blurred_edges(
    shape: NDArray[np.float64], usable: NDArray[np.bool_], dark: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return the outermost columns, if together they lack light because a lens blurs the field's edge.

    The deficit of one column is no larger than the differences between columns, but all four of both arms do
    not have one by chance. Within an arm, one dark column is evidence against the other, too, which its own
    gain may make as bright as the rest.
    """
    outermost = np.zeros_like(usable)
    outermost[:, [0, -1]] = True
    witnesses = outermost & usable
    inner = usable & ~outermost
    if not inner.any(axis=1).all():
        # One or two columns are all at an edge: there is nothing to compare them with.
        return np.zeros_like(usable)
    middle = np.array([[np.median(row[good])] for row, good in zip(shape, inner, strict=True)])
    lack, spread = 1 - shape / middle, _spread(shape, inner)
    of_one_arm = [witnesses & arm[:, None] for arm in np.eye(len(shape), dtype=bool)]
    hidden = np.zeros_like(usable)
    for group in (witnesses & ~dark, *of_one_arm):
        count = group.sum()
        if count and float(lack[group].mean()) > max(TOGETHER * spread / np.sqrt(count), LEAST_LACK):
            hidden |= group
    return hidden


def edge_doubt(
    shape: NDArray[np.float64], usable: NDArray[np.bool_], dark: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return for each arm the part of the light that its outermost columns may lack without being dark.

    The spread of the columns' own gains hides it: their common deficit, of all or of those of the arm, is an
    estimate of it as uncertain as the mean of so many gains.
    """
    outermost = np.zeros_like(usable)
    outermost[:, [0, -1]] = True
    inner = usable & ~outermost & ~dark
    if not inner.any(axis=1).all():
        return np.zeros(len(shape))
    spread = _spread(shape, inner)
    lack = 1 - shape / np.array([[np.median(row[good])] for row, good in zip(shape, inner, strict=True)])
    witnesses = outermost & usable & ~dark

    def doubt(group: NDArray[np.bool_]) -> float:
        count = int(group.sum())
        return float(np.hypot(max(0.0, lack[group].mean()), spread / np.sqrt(count))) if count else 0.0

    together = doubt(witnesses)
    return np.array(
        [max(together, doubt(witnesses & arm[:, None])) for arm in np.eye(len(shape), dtype=bool)]
    )


def _spread(shape: NDArray[np.float64], usable: NDArray[np.bool_]) -> float:
    """Return the standard deviation of the columns' own response, averaged over the arms."""
    inner = [row[good] for row, good in zip(shape, usable, strict=True)]
    return float(np.mean([robust_sigma(row / np.median(row) - 1) for row in inner]))


def _profile(response: NDArray[np.float64], usable: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the smooth part of each arm's response: a polynomial over the columns."""
    x = np.linspace(-1, 1, response.shape[1])
    inner = usable & ~dark_edges(response, usable)
    fits = [
        # over the domain of all columns, whichever are fitted
        np.polynomial.chebyshev.Chebyshev.fit(x[good], row[good], min(SMOOTH_DEGREE, good.sum() - 1), [-1, 1])
        for row, good in zip(response, inner, strict=True)
    ]
    profile = np.stack([fit(x) for fit in fits])
    level = np.array([row[good].mean() for row, good in zip(profile, inner, strict=True)])
    relative: NDArray[np.float64] = profile / level[:, None]
    return relative
