"""The step ``transfer``: conversion of DN to electrons, by EMVA 1288's photon transfer method."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from acquire.calibrate.calibration import Finding, Measured
from acquire.calibrate.checks import (
    LOWEST_LIGHT_DN,
    MOST_SATURATED,
    offset_of,
    per_arm,
    refuse_coded,
)
from acquire.calibrate.curve import straightened
from acquire.calibrate.exposure import moments, no_progress
from acquire.errors import UsageError
from acquire.lines import ARMS
from acquire.noise import QUANTISATION_DN2

if TYPE_CHECKING:
    from collections.abc import Sequence

    from acquire.calibrate.calibration import Calibration
    from acquire.calibrate.exposure import Exposure, Progress


FALLEN = 3.0
"""Standard errors by which a level's variance falls below the preceding one when pixels are full."""
ROUGHLY = 0.05
"""Relative uncertainty of a full well between two levels."""


@dataclass(frozen=True, slots=True)
class LightLevel:
    """One level of light on one arm: means over its columns, in DN and DN²."""

    light: float
    variance: float
    error: float
    saturated: float


def transfer(
    exposures: Sequence[Exposure], known: Calibration, *, progress: Progress = no_progress
) -> Finding:
    """Measure DN per electron, read noise and, if the lines reach it, full well.

    K = (σ² − σ_d²) / (μ − μ_d) (EMVA 1288 Eq. 13), over the levels of ``exposures`` until pixels are full.
    An earlier full well that these lines do not reach is kept; ``full_well_made`` of the facts says when it
    was measured. Variations common to all columns of a line are excluded, since they come from the light and
    not from the sensor. Raises UsageError without a dark, for a light that is not steady, and for lines
    without shot noise.
    """
    dark_lines = int(known.steps.get("dark", {}).get("lines", 0))
    offset = offset_of(known, "transfer")
    # a curve stretches noise by its slope
    dark_noise = straightened(known, offset, offset)[1] * known.quantities["noise_dn"].value
    usable = np.ones_like(offset, np.bool_) if known.usable is None else known.usable
    points: dict[str, list[LightLevel]] = {arm: [] for arm in ARMS}
    for exposure in exposures:
        refuse_coded(exposure, "transfer")
        found = moments(exposure, progress)
        light, slope = straightened(known, found.mean, offset)
        for i, arm in enumerate(ARMS):
            good = usable[i]
            own, dark = (slope**2 * found.own_variance)[i, good], dark_noise[i, good] ** 2
            # A variance σ² that was measured with n values has itself a variance of 2σ⁴/n.
            errors = 2 * (own**2 / found.lines[i] + dark**2 / dark_lines)
            points[arm].append(
                LightLevel(
                    light=float(light[i, good].mean()),
                    variance=float((own - dark).mean()),
                    error=float(np.sqrt(errors.sum()) / good.sum()),
                    saturated=float(found.saturated[i, good].mean()),
                )
            )
    slopes = [_slope(sorted(points[arm], key=lambda point: point.light), arm) for arm in ARMS]
    K, error, full_dn = (np.array(each) for each in zip(*slopes, strict=True))
    # Rounding to whole DN also scatters the samples, but is not noise of the pixels.
    read = np.sqrt(np.maximum((dark_noise**2).mean(axis=1) - QUANTISATION_DN2, 0)) / K
    read_error = read * np.hypot(error / K, 1 / np.sqrt(2.0 * dark_lines * offset.shape[1]))
    quantities = {"dn_per_electron": Measured(K, error), "read_noise_e": Measured(read, read_error)}
    # of both arms or none: a quantity has a value for each
    if np.isfinite(full_dn).all():
        quantities["full_well_e"] = Measured(full_dn / K, full_dn / K * np.maximum(error / K, ROUGHLY))
    facts = {
        "recordings": [exposure.facts() for exposure in exposures],
        "lines": sum(exposure.lines for exposure in exposures),
        "levels": len(exposures),
        "brightest_e": per_arm(np.array([max(p.light for p in points[arm]) for arm in ARMS]) / K),
    }
    if "full_well_e" not in quantities and "full_well_e" in known.quantities:
        # It stays in the calibration, and must not pass for a result of these lines.
        before = known.steps.get("transfer", {})
        facts["full_well_made"] = before.get("full_well_made", before.get("made"))
    return Finding("transfer", exposures[0].instrument, quantities, facts=facts)


def _slope(points: list[LightLevel], arm: str) -> tuple[float, float, float]:
    """Return K, its standard error, and the light in DN of the last level before pixels are full, or inf.

    ``points`` are in the order of rising light.
    """
    kept: list[LightLevel] = []
    full_dn = float("inf")
    for point in points:
        fallen = bool(kept) and point.variance < kept[-1].variance - FALLEN * (point.error + kept[-1].error)
        if point.saturated > MOST_SATURATED or fallen:
            full_dn = kept[-1].light if kept else point.light
            break
        if point.light > LOWEST_LIGHT_DN:
            kept.append(point)
    if not kept:
        raise UsageError(
            f"arm {arm} has no level of light above {LOWEST_LIGHT_DN:g} DN at which pixels are not full",
            hint="record flats at 10 to 90 % of white",
        )
    # the error of variance/light is error/light
    weights = np.array([(point.light / point.error) ** 2 for point in kept])
    # lines through the origin, as the dark is subtracted from both
    slopes = np.array([point.variance / point.light for point in kept])
    K, error = float((weights * slopes).sum() / weights.sum()), float(weights.sum() ** -0.5)
    if FALLEN * error > K:
        raise UsageError(
            f"the lines of arm {arm} have no more noise in the light than in the dark",
            possible="shot noise that the lines resolve",
            hint="record brighter flats, or more lines",
        )
    return K, error, full_dn
