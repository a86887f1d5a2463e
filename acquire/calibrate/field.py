"""Correction of a flat whose light ends at the field's edge: arm B's missing light is not a gain of columns.

Arm B's view is displaced from arm A's by some pixels. If the flat is larger than the field, arm B sees light
there, too. Otherwise the columns at its edge are partly dark, and a turn gives the columns in between a
slope. Once the alignment is known, so are both profiles, and the columns at the edge show which one applies.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import f as f_distribution

from acquire.calibrate.calibration import Measured
from acquire.calibrate.orientation import MODEL, view_named

if TYPE_CHECKING:
    from collections.abc import Mapping

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
"""Degree of the smooth course that the columns' own differences may have."""
CHANCE = 1e-3
"""Probability of taking the columns' own differences for a parabola."""
BALANCE_ERROR = 5e-4
"""Uncertainty of the balance from a few hundredths of a pixel in the alignment."""


def profile(alignment: Alignment, stages: int, substeps: int) -> NDArray[np.float64]:
    """Return the share of light that each pixel of arm B gets if only arm A's field is lit: (M,).

    A fine pixel across the field's edge gets the share of its area within the field.
    """
    size = stages * substeps
    down, right = (np.clip(np.minimum(each + 1, size - each), 0, 1) for each in alignment.sources(size))
    lit: NDArray[np.float64] = (down * right).mean(axis=1).reshape(stages, substeps).mean(axis=1)
    return lit


@dataclass(frozen=True, slots=True, eq=False)
class FieldEdge:
    """Whether the flat's light ``ends`` at the field's edge, and gain and balance as they are then.

    If the columns do not tell, the gains stay, and their uncertainties cover both possibilities.
    """

    ends: bool = False
    quantities: Mapping[str, Measured] = field(default_factory=dict)


def field_edge(known: Calibration, alignment: Alignment, *, dimmed: bool = False) -> FieldEdge:
    """Find out whether a flat ends at the field's edge, and take the profile that follows out of its gains.

    ``known`` holds the flat, and the orientation if it was measured. Columns that `flat` left at 1, because
    the edge is blurred, stay there. ``dimmed``: a lens takes light towards the edges, which is not where the
    field ends; the columns at the edge are then compared with a parabola through the others, as they are if
    these show one themselves.
    """
    step = known.steps.get("flat", {})
    if not {"gain", "balance"} <= known.quantities.keys() or "edge_response" not in step:
        return FieldEdge()
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
    ending, unlimited = (
        _left_over(response, light, others, witnesses, dimmed=dimmed) for light in (lit, np.ones_like(lit))
    )
    if not witnesses.any() or ending > BETTER * unlimited:
        told = witnesses.any() and unlimited <= BETTER * ending
        return FieldEdge() if told else FieldEdge(quantities=_either(gain, arm, lit))
    corrected = lit > LEAST_LIGHT
    corrected[list(hidden)] = False
    own = gain.value[arm, corrected] / lit[corrected]
    gains, arms = gain.value.copy(), balance.value.copy()
    gains[arm, corrected] = own / own.mean()
    # gains keep a mean of 1, and the balance takes their level
    arms[arm] *= own.mean()
    quantities = {
        "gain": Measured(gains, gain.uncertainty),
        "balance": Measured(arms / arms.mean(), np.hypot(balance.uncertainty, BALANCE_ERROR)),
    }
    return FieldEdge(ends=True, quantities=quantities)


def _left_over(
    response: NDArray[np.float64],
    light: NDArray[np.float64],
    others: NDArray[np.bool_],
    witnesses: NDArray[np.bool_],
    *,
    dimmed: bool,
) -> float:
    """Return the squared error of the columns at the edge if the flat gives columns this light."""
    x, own = np.linspace(-1, 1, len(response)), response / np.maximum(light, LEAST_LIGHT)
    free = int(others.sum()) - PARABOLA - 1
    level = np.ones_like(own)
    if free > 0:
        smooth = np.polynomial.Polynomial.fit(x[others], own[others], PARABOLA, [-1, 1])(x)
        rest = float(((own - smooth)[others] ** 2).sum())
        bent = float(((own[others] - own[others].mean()) ** 2).sum())
        seen = (
            rest > 0 and f_distribution.sf((bent - rest) / PARABOLA / (rest / free), PARABOLA, free) < CHANCE
        )
        if dimmed or seen:
            level = smooth
    return float(((response / level - light)[witnesses] ** 2).sum())


def _either(gain: Measured, arm: int, lit: NDArray[np.float64]) -> dict[str, Measured]:
    """Return the gains with the profile of an ending field in their uncertainty; nothing if there is none."""
    doubt = lit / lit.mean() - 1
    if not doubt.any():
        return {}
    uncertainty = gain.uncertainty.copy()
    uncertainty[arm] = np.hypot(uncertainty[arm], doubt)
    return {"gain": Measured(gain.value, uncertainty)}
