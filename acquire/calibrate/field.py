"""A flat whose light ends at the field's edge: what arm B does not see of it is no gain of its columns.

Arm B looks some pixels beside arm A. Where a flat is larger than the field it sees light there as well; where
it is not, the columns at its edge are dark in part, and a turn gives the columns between a slope. Once the
alignment is known, so is either profile, and the columns at the edge tell which of them it was.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.calibrate.calibration import Measured
from acquire.calibrate.orientation import MODEL, view_named

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.alignment import Alignment
    from acquire.calibrate.calibration import Calibration

TELLS = 0.02
"""Light that a column must lack for it to be a witness."""
BETTER = 0.25
"""Of the squared error of the whole field, below which the field that ends is believed."""
LEAST_LIGHT = 0.3
"""Of a column's, below which its gain is not calculated from what is left."""
BALANCE_ERROR = 5e-4
"""What some hundredths of a pixel leave in doubt."""


def profile(alignment: Alignment, stages: int, substeps: int) -> NDArray[np.float64]:
    """Part of the light that each pixel of arm B gets where nothing is lit beyond arm A's field: (M,).

    Of a fine pixel that reaches over the field's edge, the part within it.
    """
    size = stages * substeps
    down, right = (np.clip(np.minimum(each + 1, size - each), 0, 1) for each in alignment.sources(size))
    lit: NDArray[np.float64] = (down * right).mean(axis=1).reshape(stages, substeps).mean(axis=1)
    return lit


def mended(known: Calibration, alignment: Alignment) -> dict[str, Measured]:
    """Gain and balance without the profile of a flat that ends at the field's edge; nothing where it goes on.

    ``known`` holds the flat, and the orientation if it was found. Nor is it a gain that the edge is blurred:
    columns that `flat` left at 1 stay there.
    """
    step = known.steps.get("flat", {})
    if not {"gain", "balance"} <= known.quantities.keys() or "edge_response" not in step:
        return {}
    view = MODEL if known.orientation is None else view_named(known.orientation)
    arm, name = (0, "a") if view.swapped else (1, "b")
    lit = profile(alignment, known.instrument.stages, known.instrument.substeps)
    if view.mirrored and not view.swapped:
        lit = lit[::-1]
    gain, balance = known.quantities["gain"], known.quantities["balance"]
    hidden = {int(column): value for column, value in step["edge_response"].get(name, {}).items()}
    seen = gain.value[arm].copy()
    seen[list(hidden)] = list(hidden.values())
    witnesses = lit < 1 - TELLS
    dark, whole = (float(((seen - each)[witnesses] ** 2).sum()) for each in (lit, 1.0))
    if not witnesses.any() or dark > BETTER * whole:
        return {}
    told = lit > LEAST_LIGHT
    told[list(hidden)] = False
    own = gain.value[arm, told] / lit[told]
    gains, arms = gain.value.copy(), balance.value.copy()
    gains[arm, told] = own / own.mean()
    arms[arm] *= own.mean()
    return {
        "gain": Measured(gains, gain.uncertainty),
        "balance": Measured(arms / arms.mean(), np.hypot(balance.uncertainty, BALANCE_ERROR)),
    }
