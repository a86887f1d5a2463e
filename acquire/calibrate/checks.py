"""Requirements of the steps on their recordings: errors and warnings for those that do not meet them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.calibrate.calibration import Calibration
    from acquire.calibrate.exposure import Exposure, Moments

MOST_AT_ZERO = 1e-3
"""Share of a dark column's samples at 0 above which its mean is wrong."""
MOST_SATURATED = 1e-3
DIMMEST, BRIGHTEST = 0.1, 0.9
"""Shares of the range below which a flat determines little, and above which noise may reach white."""
DRIFT = 6.0
LOWEST_LIGHT_DN = 8.0


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
            f"{exposure.recording} does not have the steady light that {step} needs: its code is "
            f"{exposure.recording.attrs['code']}",
            possible="code.kind = 'constant', code.value = 1",
        )


def refuse_clipped(exposure: Exposure, found: Moments) -> None:
    """Raise UsageError for dark lines that reach 0."""
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
    return [f"{count} columns are left out for their {reason}"] if count else []


def warn_of_later_corrections(known: Calibration) -> list[str]:
    """Warn of a flat that replaces one which the target has corrected: the corrections are lost with it."""
    lost = known.steps.get("align", {}).get("corrected", [])
    if not lost:
        return []
    return [f"align has corrected {' and '.join(lost)} of the flat before this one: repeat align"]


def per_arm(values: NDArray[np.float64]) -> list[float]:
    """Round values for JSON."""
    return [round(float(value), 6) for value in values]
