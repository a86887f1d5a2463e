"""A calibration on one page: the quantities of every column, the alignment of the arms, and the steps."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np

from acquire.calibrate.curve import curve_of, knots_dn
from acquire.evaluate.page import fill_template
from acquire.evaluate.themed import INK, MASKED, SOLVER_COLOURS, STYLE, canvas, save_drawing
from acquire.lines import ARMS

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from matplotlib.figure import Figure

    from acquire.calibrate.calibration import Calibration

PANELS = (
    ("offset_dn", "offset (DN)"),
    ("ambient_dn", "ambient (DN)"),
    ("noise_dn", "noise (DN)"),
    ("gain", "gain"),
)
SPOKES = 9
ENLARGED = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""Enlargements of the displacements; the largest for which no arrow reaches the next point is used."""


def write_page(known: Calibration, directory: Path, name: str, facts: Mapping[str, Any]) -> Path:
    """Write ``index.html``, ``calibration.json`` and the plots into ``directory``; return the page.

    ``facts`` are those printed by the command: label → text.
    """
    with mpl.rc_context(STYLE):
        figures = {"columns": _columns(known), "curve": _curve(known), "field": _field(known)}
        drawings = {
            key: save_drawing(figure, directory, key) for key, figure in figures.items() if figure is not None
        }
    # Without NaN, which Python writes but JSON does not have.
    text = json.dumps(known.to_attrs(), indent=1, allow_nan=False, ensure_ascii=False)
    (directory / "calibration.json").write_text(text + "\n", encoding="utf-8")
    # steps have a table of their own
    shown = {key: value for key, value in facts.items() if value is not None and key not in known.steps}
    steps = [{"name": step, **about} for step, about in known.steps.items()]
    page = directory / "index.html"
    page.write_text(
        fill_template("calibration.html.j2", {"name": name, "facts": shown, "steps": steps}, drawings),
        encoding="utf-8",
    )
    return page


def _columns(known: Calibration) -> Figure | None:
    """Plot every quantity of the columns of both arms, with bands of two standard uncertainties."""
    panels = [(key, label) for key, label in PANELS if key in known.quantities]
    if not panels:
        return None
    figure = canvas(1.9 * len(panels) + 0.4)
    axes = figure.subplots(len(panels), 1, squeeze=False, sharex=True).ravel()
    for ax, (key, label) in zip(axes, panels, strict=True):
        measured = known.quantities[key]
        usable = np.ones(measured.value.shape, np.bool_) if known.usable is None else known.usable
        hidden = known.steps.get("flat", {}).get("optics_hide_columns", {}) if key == "gain" else {}
        x = np.arange(measured.value.shape[1])
        # there are more colours than arms
        for arm, value, error, good, colour in zip(
            ARMS, measured.value, measured.uncertainty, usable, SOLVER_COLOURS, strict=False
        ):
            # matplotlib leaves a gap where a value is NaN.
            shown = np.where(np.isin(x, hidden.get(arm, [])) | ~good, np.nan, value)
            ax.fill_between(x, shown - 2 * error, shown + 2 * error, color=colour, alpha=0.25, lw=0)
            ax.plot(x, shown, ".-", color=colour, lw=1, ms=3, label=f"camera {arm.upper()}")
            ax.plot(x[~good], value[~good], "x", color=MASKED, ms=6)
        ax.set_ylabel(label)
    axes[-1].set_xlabel("column")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3)
    return figure


def _curve(known: Calibration) -> Figure | None:
    """Plot the deviation of the samples from a straight line, with bands of two standard uncertainties."""
    if curve_of(known) is None:
        return None
    measured = known.quantities["excess_dn"]
    figure = canvas(2.6)
    ax = figure.subplots()
    for arm, dn, value, error, colour in zip(
        ARMS, knots_dn(known.instrument), measured.value, measured.uncertainty, SOLVER_COLOURS, strict=False
    ):
        ax.fill_between(dn, value - 2 * error, value + 2 * error, color=colour, alpha=0.25, lw=0)
        ax.plot(dn, value, color=colour, lw=1.2, label=f"camera {arm.upper()}")
    ax.axhline(0, color=INK, lw=0.6)
    ax.set(xlabel="sample (DN)", ylabel="deviation (DN)")
    figure.legend(loc="outside upper right", ncols=2)
    return figure


def _field(known: Calibration) -> Figure | None:
    """Plot the displacement of arm B's image against arm A's, over the field."""
    if known.alignment is None:
        return None
    alignment, half = known.alignment.alignment, known.instrument.stages * known.instrument.substeps / 2
    at = np.linspace(-0.9 * half, 0.9 * half, SPOKES)
    points = np.stack(np.meshgrid(at, at, indexing="ij")).reshape(2, -1)
    displacement = alignment.to_b(points[:, :, None], half)[:, :, 0] - points
    largest = float(np.hypot(*displacement).max())
    factor = max((each for each in ENLARGED if each * largest < at[1] - at[0]), default=1)
    figure = canvas(4.6)
    ax = figure.subplots()
    ax.quiver(
        points[1],
        points[0],
        factor * displacement[1],
        factor * displacement[0],
        # arrows in units of the axes, enlarged by `factor` and by nothing else
        angles="xy",
        scale_units="xy",
        scale=1,
        color=SOLVER_COLOURS[1],
        width=0.004,
    )
    ax.plot(points[1], points[0], ".", color=INK, ms=3)
    ax.set(
        aspect="equal",
        xlabel="column (fine pixels from the centre)",
        ylabel="row (downwards)",
        xlim=(-1.15 * half, 1.15 * half),
        # rows count downwards
        ylim=(1.15 * half, -1.15 * half),
    )
    drawn = "" if factor == 1 else f",\nenlarged {factor} times"
    ax.set_title(f"Displacement up to {largest:.2f} fine pixels{drawn}")
    return figure
