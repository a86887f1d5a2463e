"""What recordings must be for a step, and what is wrong with those that are not; in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.calibrate.calibration import Calibration
    from acquire.calibrate.exposure import Exposure, Moments

QUANTISATION = 1 / 12
"""Variance of rounding, DN²."""
MOST_AT_ZERO = 1e-3
"""Share of a dark column's samples at 0 from which on its mean is not to be believed."""
MOST_SATURATED = 1e-3
DIMMEST, BRIGHTEST = 0.1, 0.9
"""Of the range: where a flat tells little, and where noise may reach white."""
DRIFT = 6.0
LOWEST_LIGHT_DN = 8.0


def offset_of(known: Calibration, step: str, *, with_ambient: bool = True) -> NDArray[np.float64]:
    """DN of a column without our light (arm, column); UsageError where it was not measured."""
    offset = known.value("offset_dn")
    if offset is None or "dark" not in known.steps:
        raise UsageError(
            f"{step} needs the offsets of the columns first",
            possible="acquire calibrate dark",
        )
    extra = known.value("ambient_dn") if with_ambient else None
    return offset if extra is None else offset + extra


def refuse_coded(exposure: Exposure, step: str) -> None:
    """UsageError for a light that is not steady."""
    if exposure.code_value != 1:
        raise UsageError(
            f"{exposure.recording} is no steady light for {step}: code {exposure.recording.attrs['code']}",
            possible="code.kind = 'constant', code.value = 1",
        )


def refuse_clipped(exposure: Exposure, found: Moments) -> None:
    """UsageError for dark lines that reach 0."""
    clipped = found.at_zero > MOST_AT_ZERO
    if clipped.any():
        raise UsageError(
            f"{exposure.recording}: {clipped.sum()} columns of dark lines reach 0 DN, in up to "
            f"{found.at_zero.max():.1%} of their samples: what noise would be below is cut off",
            possible="a black level some noises above 0",
            hint="raise the camera's BlackLevel (simulated: cameras.a.black_level_dn), and record again",
        )


def refuse_level(exposure: Exposure, found: Moments, light: NDArray[np.float64]) -> None:
    """UsageError for a flat that is saturated, or none; ``light`` (arm, column) in DN."""
    saturated = np.median(found.saturated, axis=1).max()
    if saturated > MOST_SATURATED:
        raise UsageError(
            f"{exposure.recording}: {saturated:.0%} of the samples are saturated",
            possible="a flat at 50 to 70 % of white",
            hint="less light: steady light is twice what a pseudo-random code lets through",
        )
    if np.median(light, axis=1).min() < LOWEST_LIGHT_DN:
        raise UsageError(
            f"{exposure.recording}: the light adds {np.median(light, axis=1).min():.2g} DN to an arm",
            possible=f"{LOWEST_LIGHT_DN:g} DN or more; 50 to 70 % of white are best",
            hint="is the light on, and the scene white?",
        )


def dim(exposure: Exposure, light: NDArray[np.float64]) -> list[str]:
    """A warning, where a flat is too dark or too bright to be good."""
    share = light.mean(axis=1) / exposure.camera("white_dn")
    if share.min() >= DIMMEST and share.max() <= BRIGHTEST:
        return []
    return [
        f"the flat is at {share.min():.0%} to {share.max():.0%} of white; 50 to 70 % tell most of the gains"
    ]


def drift(found: Moments) -> list[str]:
    """A warning, where the columns' means move."""
    moved = float(np.median(found.drift))
    return [f"the mean of the columns drifts, by {moved:.0f} standard errors"] if moved > DRIFT else []


def left_out(usable: NDArray[np.bool_], why: str) -> list[str]:
    """A warning, where columns are no good."""
    count = int((~usable).sum())
    return [f"{count} columns are left out for their {why}"] if count else []


def per_arm(values: NDArray[np.float64]) -> list[float]:
    """As JSON."""
    return [round(float(value), 6) for value in values]
