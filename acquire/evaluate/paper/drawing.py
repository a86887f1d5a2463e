"""Panels that the figures of the paper have in common."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from acquire.evaluate.figures import HIGHLIGHT, WIDTH_IN, bare, stamp

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

FRAME_IN = 1.55


def canvas(height_in: float) -> Figure:
    return Figure(figsize=(WIDTH_IN, height_in), layout="constrained")


def show(ax: Axes, frame: NDArray[Any], peak: float = 1.0, title: str = "") -> None:
    """A frame in grey, 0 black and ``peak`` white, its pixels sharp."""
    ax.imshow(frame, cmap="gray", vmin=0, vmax=peak, interpolation="nearest")
    bare(ax)
    if title:
        ax.set_title(title, fontsize=9, loc="left")


def strips(rows: Sequence[tuple[str, NDArray[Any]]], stamps: Sequence[str], peak: float = 1.0) -> Figure:
    """Rows of frames at the same instants, one instant per column."""
    figure = canvas(0.2 + FRAME_IN * len(rows) * 6 / len(stamps))
    axes = figure.subplots(len(rows), len(stamps), squeeze=False)
    for (label, frames), line in zip(rows, axes, strict=True):
        for ax, frame, text in zip(line, frames, stamps, strict=True):
            show(ax, frame, peak)
            stamp(ax, text)
        line[0].set_ylabel(label, fontweight="bold")
    return figure


def box(ax: Axes, rows: slice, columns: slice, colour: str = HIGHLIGHT, width: float = 1.4) -> None:
    """Outline a rectangle of pixels."""
    from matplotlib.patches import Rectangle

    corner = (columns.start - 0.5, rows.start - 0.5)
    size = (columns.stop - columns.start, rows.stop - rows.start)
    ax.add_patch(Rectangle(corner, *size, fill=False, edgecolor=colour, linewidth=width))


def correlation(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Pearson's, over what is known of both."""
    known = np.isfinite(a) & np.isfinite(b)
    return float(np.corrcoef(a[known], b[known])[0, 1])
