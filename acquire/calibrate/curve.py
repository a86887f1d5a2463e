"""The curve of a camera that bends, as a calibration holds it, and what it makes of measured levels."""

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
    """(arm, knot) readings from 0 to white, at which a calibration has the excess."""
    white = [float(instrument.cameras[arm]["white_dn"]) for arm in ARMS]
    return np.linspace(0.0, white, KNOTS, axis=1)


def curve_of(known: Calibration) -> ConverterCurve | None:
    """None where it was not measured, or no camera bends."""
    excess = known.value("excess_dn")
    if excess is None or not excess.any():
        return None
    return ConverterCurve(knots_dn(known.instrument), excess)


def straightened(
    known: Calibration, mean: NDArray[np.float64], offset: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Light of columns (arm, column) as a linear camera would have it, and by how much the camera's curve
    stretches small differences there.
    """
    curve = curve_of(known)
    if curve is None:
        return mean - offset, np.ones_like(mean)
    return curve.straight(mean) - curve.straight(offset), curve.slope(mean)
