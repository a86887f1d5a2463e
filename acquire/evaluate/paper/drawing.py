"""Panels shared by the figures of the paper."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.evaluate.figures import bare, stamp
from acquire.evaluate.paper.studio import Picture
from acquire.evaluate.themed import HIGHLIGHT, NARROW_IN, WIDTH_IN, canvas

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike, NDArray

    Rows = Sequence[tuple[str, NDArray[Any]]]

NARROW_ACROSS = 4
LABEL_IN, STAMP_IN = 0.3, 0.2


def show(ax: Axes, frame: NDArray[Any], peak: float = 1.0, title: str = "") -> None:
    """Draw a frame in grey, from 0 (black) to ``peak`` (white), with sharp pixels."""
    ax.imshow(frame, cmap="gray", vmin=0, vmax=peak)
    bare(ax)
    if title:
        ax.set_title(title, fontsize=9, loc="left")


def strip(name: str, caption: str, rows: Rows, stamps: Sequence[str], peak: float = 1.0) -> Picture:
    """Draw rows of frames at the same instants, one per column; narrow pages get fewer columns."""
    narrow = strips(rows, stamps, peak, across=NARROW_ACROSS, width_in=NARROW_IN)
    return Picture(name, strips(rows, stamps, peak), caption, narrow=narrow)


def compared(
    name: str, caption: str, video: NDArray[Any], *, truth: NDArray[Any], picks: ArrayLike, frame_ms: float
) -> Picture:
    """Draw some frames of a video above those of the truth, with their times."""
    chosen = np.asarray(picks, np.intp)
    stamps = [f"{frame * frame_ms:.2f} ms" for frame in chosen.tolist()]
    return strip(name, caption, (("ours", video[chosen]), ("truth", truth[chosen])), stamps)


def strips(
    rows: Rows,
    stamps: Sequence[str],
    peak: float = 1.0,
    *,
    across: int | None = None,
    width_in: float = WIDTH_IN,
) -> Figure:
    """Draw rows of frames as one figure, with at most ``across`` instants side by side."""
    blocks = -(-len(stamps) // (across or len(stamps)))
    across = -(-len(stamps) // blocks)  # distribute the instants evenly over the blocks
    # Frames are square to the eye: the height of the figure follows from the width of one.
    side_in = (width_in - LABEL_IN) / across
    shape = rows[0][1].shape
    figure = canvas(blocks * (STAMP_IN + side_in * shape[1] / shape[2] * len(rows)), width_in)
    axes = figure.subplots(blocks * len(rows), across, squeeze=False)
    for ax in axes.ravel():
        # All of them: the last block may have fewer instants than columns.
        bare(ax)
    for number, text in enumerate(stamps):
        block, column = divmod(number, across)
        for row, (label, frames) in enumerate(rows):
            ax = axes[block * len(rows) + row, column]
            show(ax, frames[number], peak)
            if row == 0:
                stamp(ax, text)
            if column == 0:
                ax.set_ylabel(label, fontweight="bold")
    return figure


def box(ax: Axes, rows: slice, columns: slice, colour: str = HIGHLIGHT, width: float = 1.4) -> None:
    """Outline a rectangle of pixels."""
    from matplotlib.patches import Rectangle

    # imshow centres a pixel on whole numbers.
    corner = (columns.start - 0.5, rows.start - 0.5)
    size = (columns.stop - columns.start, rows.stop - rows.start)
    ax.add_patch(Rectangle(corner, *size, fill=False, edgecolor=colour, linewidth=width))


def correlation(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Return Pearson's correlation over the samples that are known in both."""
    # light cannot be known where the code is dark, and is NaN there
    known = np.isfinite(a) & np.isfinite(b)
    return float(np.corrcoef(a[known], b[known])[0, 1])
