"""A calibration's curve of a non-linear camera, and its effect on measured levels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.calibrate.calibration import KNOTS
from acquire.converter import ConverterCurve
from acquire.lines import ARMS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.calibrate.calibration import Calibration, Instrument


def knots_dn(instrument: Instrument) -> NDArray[np.float64]:
    """Return the readings (arm, knot), from 0 to white, at which a calibration gives the excess."""
    white = [float(instrument.cameras[arm]["white_dn"]) for arm in ARMS]
    return np.linspace(0.0, white, KNOTS, axis=1)


def curve_of(known: Calibration) -> ConverterCurve | None:
    """Return the curve, or None if it was not measured or both cameras are linear."""
    excess = known.value("excess_dn")
    # linear cameras have an excess of 0, and no curve, whose application would take time
    if excess is None or not excess.any():
        return None
    return ConverterCurve(knots_dn(known.instrument), excess)


def straightened(
    known: Calibration, mean: NDArray[np.float64], offset: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the light on columns (arm, column) in a linear camera's DN, and the slope of that correction."""
    curve = curve_of(known)
    if curve is None:
        return mean - offset, np.ones_like(mean)
    return curve.straight(mean) - curve.straight(offset), curve.slope(mean)
