"""Correction of a flat whose light ends at the field's edge: arm B's missing light is not a gain of columns.

Arm B's view is displaced from arm A's by some pixels. If the flat is larger than the field, arm B sees light
there, too. Otherwise the columns at its edge are partly dark, and a turn gives the columns in between a
slope. Once the alignment is known, so are both profiles, and the columns at the edge show which one applies.
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
"""Least light that a column must lack to distinguish the two profiles."""
BETTER = 0.25
"""Largest squared error of the ending field, relative to the unlimited one, with which it is accepted."""
LEAST_LIGHT = 0.3
"""Least share of its light with which a column's gain is still computed."""
PARABOLA = 2
BALANCE_ERROR = 5e-4
"""Uncertainty of the balance from some hundredths of a pixel in the alignment."""


def profile(alignment: Alignment, stages: int, substeps: int) -> NDArray[np.float64]:
    """Return the share of light that each pixel of arm B gets if only arm A's field is lit: (M,).

    A fine pixel across the field's edge gets the share of its area within the field.
    """
    size = stages * substeps
    down, right = (np.clip(np.minimum(each + 1, size - each), 0, 1) for each in alignment.sources(size))
    lit: NDArray[np.float64] = (down * right).mean(axis=1).reshape(stages, substeps).mean(axis=1)
    return lit


def without_field_edge(
    known: Calibration, alignment: Alignment, *, dimmed: bool = False
) -> dict[str, Measured]:
    """Return gain and balance without the profile of a flat that ends at the field's edge; else nothing.

    ``known`` holds the flat, and the orientation if it was measured. Columns that `flat` left at 1, because
    the edge is blurred, stay there. ``dimmed``: a lens takes light towards the edges, which is not where the
    field ends; the columns at the edge are then compared with a parabola through the others.
    """
    step = known.steps.get("flat", {})
    if not {"gain", "balance"} <= known.quantities.keys() or "edge_response" not in step:
        return {}
    view = MODEL if known.orientation is None else view_named(known.orientation)
    arm, name = (0, "a") if view.swapped else (1, "b")
    lit = profile(alignment, known.instrument.stages, known.instrument.substeps)
    if view.mirrored and not view.swapped:
        # in the order of the camera's own columns
        lit = lit[::-1]
    gain, balance = known.quantities["gain"], known.quantities["balance"]
    hidden = {int(column): value for column, value in step["edge_response"].get(name, {}).items()}
    response = gain.value[arm].copy()
    # `flat` has set these gains to 1; here their response counts
    response[list(hidden)] = list(hidden.values())
    witnesses = lit < 1 - TELLS
    others = ~witnesses
    others[list(hidden)] = False
    if dimmed and others.sum() > PARABOLA:
        x = np.linspace(-1, 1, len(response))
        response /= np.polynomial.Polynomial.fit(x[others], response[others], PARABOLA, [-1, 1])(x)
    ending, unlimited = (float(((response - each)[witnesses] ** 2).sum()) for each in (lit, 1.0))
    if not witnesses.any() or ending > BETTER * unlimited:
        return {}
    corrected = lit > LEAST_LIGHT
    corrected[list(hidden)] = False
    own = gain.value[arm, corrected] / lit[corrected]
    gains, arms = gain.value.copy(), balance.value.copy()
    gains[arm, corrected] = own / own.mean()
    # gains keep a mean of 1, and the balance takes their level
    arms[arm] *= own.mean()
    return {
        "gain": Measured(gains, gain.uncertainty),
        "balance": Measured(arms / arms.mean(), np.hypot(balance.uncertainty, BALANCE_ERROR)),
    }
