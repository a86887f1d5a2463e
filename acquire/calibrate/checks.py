"""Requirements of the steps on their recordings: errors and warnings for those that do not meet them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.errors import UsageError
from acquire.lines import ARMS
from acquire.noise import robust_sigma
from acquire.text import counted

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.calibrate.calibration import Calibration
    from acquire.calibrate.exposure import Exposure, Moments

MOST_AT_ZERO = 1e-3
"""Share of a dark column's samples at 0 above which its mean is wrong."""
MOST_SATURATED = 1e-3
"""Share of saturated samples from which a flat's means are too low to be used."""
DIMMEST, BRIGHTEST = 0.1, 0.9
"""Shares of the range below which a flat determines little, and above which noise may reach white."""
DRIFT = 6.0
"""Standard errors by which the columns' mean may drift without a warning."""
LOWEST_LIGHT_DN = 8.0
"""Least light above black in a flat, as the median of an arm's columns."""
AMBIENT, BRIGHT_DARK = 0.05, 0.25
"""Parts of the range above the camera's black level at which dark lines are doubtful, and at which a lens
that is said to be covered is not."""
BANDS, FOLLOWS, BY_CHANCE = 8, 0.1, 5.0
"""Bands of rows whose code is fitted to dark lines, the part of a column's variance from which they follow
it, and how many times as much as noise has by chance."""
TEXTURE, UNEVEN = 0.1, 0.06
"""Spread of a flat's columns about a smooth profile that no sensor has (1 to 3 % are usual), and the least
range of that profile that is mentioned."""
PROFILE_DEGREE = 4
"""Degree of the smooth profile across the columns."""
LEAST_COLUMNS = 16
"""Fewer columns do not tell texture from a profile."""


def offset_of(known: Calibration, step: str, *, with_ambient: bool = True) -> NDArray[np.float64]:
    """Return the DN of columns without our light (arm, column). Raises UsageError if it was not measured."""
    offset = known.value("offset_dn")
    if offset is None or "dark" not in known.steps:
        raise UsageError(
            f"{step} needs the offsets of the columns first",
            possible="acquire calibrate dark",
        )
    extra = known.value("ambient_dn") if with_ambient else None
    return offset if extra is None else offset + extra


def refuse_coded(exposure: Exposure, step: str) -> None:
    """Raise UsageError for a light that is not steady."""
    if exposure.code_value != 1:
        raise UsageError(
            f"{exposure.recording} does not have the steady light that {step} needs: its light "
            f"{exposure.light}",
            possible="lines under code 1: code.kind = 'constant', code.value = 1",
            hint="acquire arm --code steady, and record again",
        )


def refuse_constant(exposure: Exposure) -> None:
    """Raise UsageError for lines from which no image of a target follows: their light had no code."""
    if exposure.code_value is not None:
        raise UsageError(
            f"{exposure.recording} has a constant code, which does not distinguish the rows of a scene",
            possible="a pseudo-random code: code.kind = 'prbs'",
        )


def refuse_fibre(exposure: Exposure) -> None:
    """Raise UsageError for lines behind a fibre."""
    if exposure.recording.fibre is not None:
        raise UsageError(
            f"{exposure.recording} cannot be used: it shows a target behind a fibre, in bands",
            possible="a recording without a fibre",
        )


def refuse_lit(exposure: Exposure, found: Moments, *, covered: bool) -> list[str]:
    """Raise UsageError for dark lines that saw the light; return a warning if they may have."""
    if exposure.code_value is None and _follow_code(exposure):
        raise UsageError(
            f"{exposure.recording} is not dark: its lines follow the light's code, and so the lens was open",
            possible="a covered lens; or the light off: code.kind = 'constant', code.value = 0",
            hint="cover the lens, or acquire arm --code dark, and record again",
        )
    above = np.median(found.mean, axis=1) - exposure.camera("black_level_dn")
    share = float((above / exposure.camera("white_dn")).max())
    if covered and share > BRIGHT_DARK:
        raise UsageError(
            f"{exposure.recording} is not dark: its lines are {share:.0%} of white above the black level, "
            "and so the lens was open",
            possible="a covered lens; or, if it was covered, black_level_dn in the rig file as in the camera",
            hint="cover the lens, or correct black_level_dn, and record again",
        )
    if share <= AMBIENT:
        return []
    return [
        f"the dark lines are {share:.0%} of white above the black level: ambient light takes this part of "
        "the range and adds noise (switch it off or shield the lens, and record again), or black_level_dn in "
        "the rig file is not the camera's"
    ]


def _follow_code(exposure: Exposure) -> bool:
    """Return whether a column's lines follow the light's code: a band of lit rows adds its bits to a line.

    Whatever the scene is, and wherever: each column is fitted by the sums of the bits of each of the bands.
    """
    samples, usable = next(exposure.samples())
    segment = exposure.recording.cut(exposure.first_line, samples.shape[1])
    starts = segment.geometry.substeps * np.arange(samples.shape[1])
    ends = np.linspace(0, segment.geometry.size, BANDS + 1).astype(np.int64)
    total = np.concatenate([[0.0], np.cumsum(segment.code, dtype=np.float64)])
    bits = np.diff(total[starts[:, None] + ends], axis=1)
    for lines, good in zip(samples, usable, strict=True):
        arrived = good.any(axis=1)
        if arrived.sum() <= BANDS:
            continue
        design, seen = (each - each.mean(axis=0) for each in (bits[arrived], lines[arrived].astype(float)))
        fitted = design @ np.linalg.lstsq(design, seen, rcond=None)[0]
        part = (fitted**2).sum(axis=0) / np.maximum((seen**2).sum(axis=0), 1e-9)
        if part.max() > max(FOLLOWS, BY_CHANCE * BANDS / len(seen)):
            return True
    return False


def refuse_texture(
    exposure: Exposure, response: NDArray[np.float64], trusted: NDArray[np.bool_], *, smooth: bool
) -> list[str]:
    """Raise UsageError for a flat of a scene with texture; return a warning if its light is uneven.

    Behind a fibre neighbouring columns differ as their fibres do, and nothing is claimed.
    """
    if exposure.recording.fibre is not None:
        return []
    warnings = []
    x = np.linspace(-1, 1, response.shape[1])
    for arm, row, good in zip(ARMS, response, trusted, strict=True):
        if good.sum() < LEAST_COLUMNS:
            continue
        own = row[good] / np.median(row[good])
        profile = np.polynomial.Chebyshev.fit(x[good], own, PROFILE_DEGREE, [-1, 1])(x[good])
        rough, uneven = robust_sigma(own - profile), 1 - profile.min() / profile.max()
        if rough > TEXTURE:
            raise UsageError(
                f"{exposure.recording} is not uniform: neighbouring columns of arm {arm} differ by "
                f"{rough:.0%}, more than those of a sensor",
                possible="a white scene without texture, larger than the field",
                hint="put a white card in place of the target, and record again",
            )
        if uneven > UNEVEN and not smooth:
            warnings.append(
                f"the light falls smoothly by {uneven:.0%} over the columns of arm {arm}: by the lens, then "
                "all is well, and align separates it; or by an uneven lamp or scene, then make it even, or "
                "repeat flat with --smooth"
            )
    return warnings


def refuse_clipped(exposure: Exposure, found: Moments) -> None:
    """Raise UsageError for dark lines that reach 0, or white."""
    # by the median, so that a few hot columns do not refuse a dark
    saturated = np.median(found.saturated, axis=1).max()
    if saturated > MOST_SATURATED:
        raise UsageError(
            f"{exposure.recording} is not dark: {saturated:.0%} of its samples are saturated",
            possible="dark lines a few percent of white above 0",
            hint="switch off what lights the scene, the room or a light that stays on (acquire trigger "
            "blink), and record again",
        )
    clipped = found.at_zero > MOST_AT_ZERO
    if clipped.any():
        raise UsageError(
            f"{exposure.recording}: {clipped.sum()} columns of dark lines reach 0 DN, in up to "
            f"{found.at_zero.max():.1%} of their samples: noise below 0 is cut off",
            possible="a black level several standard deviations of the noise above 0",
            hint="raise the camera's BlackLevel (simulated: cameras.a.black_level_dn), and record again",
        )


def refuse_level(exposure: Exposure, found: Moments, light: NDArray[np.float64]) -> None:
    """Raise UsageError for a flat that is saturated, or too dark; ``light`` (arm, column) in DN."""
    # by the median, so that a few hot columns do not refuse a flat
    saturated = np.median(found.saturated, axis=1).max()
    if saturated > MOST_SATURATED:
        raise UsageError(
            f"{exposure.recording}: {saturated:.0%} of the samples are saturated",
            possible="a flat at 50 to 70 % of white",
            hint="less light: steady light is twice what a pseudo-random code lets through",
        )
    if np.median(light, axis=1).min() < LOWEST_LIGHT_DN:
        raise UsageError(
            f"{exposure.recording}: the light adds only {np.median(light, axis=1).min():.2g} DN to an arm",
            possible=f"{LOWEST_LIGHT_DN:g} DN or more; 50 to 70 % of white are best",
            hint="check that the light is on and the scene white",
        )


def warn_of_level(exposure: Exposure, light: NDArray[np.float64]) -> list[str]:
    """Warn of a flat that is darker or brighter than it should be."""
    share = light.mean(axis=1) / exposure.camera("white_dn")
    if share.min() >= DIMMEST and share.max() <= BRIGHTEST:
        return []
    return [
        f"the flat is at {share.min():.0%} to {share.max():.0%} of white; 50 to 70 % determine gains best"
    ]


def warn_of_drift(found: Moments) -> list[str]:
    """Warn of column means that drift."""
    drift = float(np.median(found.drift))
    return [f"the mean of the columns drifts, by {drift:.0f} standard errors"] if drift > DRIFT else []


def warn_of_exclusions(usable: NDArray[np.bool_], reason: str) -> list[str]:
    """Warn of columns that are left out."""
    count = int((~usable).sum())
    of = "its" if count == 1 else "their"
    return [f"{counted(count, 'column', 'is')} left out for {of} {reason}"] if count else []


def warn_of_later_corrections(known: Calibration) -> list[str]:
    """Warn of a flat that replaces one which the target has corrected: the corrections are lost with it."""
    lost = known.steps.get("align", {}).get("corrected", [])
    if not lost:
        return []
    return [f"align has corrected {' and '.join(lost)} of the flat before this one: repeat align"]


def per_arm(values: NDArray[np.float64]) -> list[float]:
    """Round values for JSON."""
    return [round(float(value), 6) for value in values]
