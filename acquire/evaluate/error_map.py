"""The map of a video's estimated error: its regions next to a frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np

from acquire.evaluate.themed import STYLE, Drawing, canvas, drawing_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.store import VideoFile

MOST_FRAMES = 500
"""Largest number of frames that a map averages; a video may have any number."""
HEIGHT_IN = 2.35


def draw_error(file: VideoFile) -> Drawing | None:
    """Draw the middle one of the trusted frames and the error of the regions over all of them.

    Return None if the error is not known.
    """
    shown = range(len(file.time_ns)) if file.trusted is None else file.trusted
    full_scale = ((file.attrs.get("provenance") or {}).get("error") or {}).get("full_scale")
    if file.error is None or not shown or not full_scale:
        return None
    percent = 100 / full_scale * error_of_regions(file, shown)
    if not np.isfinite(percent).any():
        return None
    middle = shown[len(shown) // 2]
    frame = file.frames(middle, middle + 1)[0].astype(np.float64)
    with mpl.rc_context(STYLE | {"axes.grid": False}):
        figure = canvas(HEIGHT_IN)
        left, right = figure.subplots(1, 2)
        rows, columns = frame.shape
        left.imshow(frame, cmap="gray", vmin=0, vmax=full_scale)
        left.set_title("frame")
        # The regions are stretched over the frame's pixels, so that both pictures have one scale.
        image = right.imshow(percent, cmap="viridis", vmin=0, extent=(0, columns, rows, 0))
        right.set_title("error (%)")
        for ax in (left, right):
            ax.set(xticks=[], yticks=[])
            ax.spines[:].set_visible(False)
        figure.colorbar(image, ax=right, shrink=0.8)
        return drawing_of(figure, narrow_in=HEIGHT_IN)


def error_of_regions(file: VideoFile, frames: range) -> NDArray[np.float64]:
    """Return the RMS of the error over frames (region_y, region_x); NaN where it is not known."""
    stored = file.errors(frames.start, frames.stop, max(1, len(frames) // MOST_FRAMES))
    assert stored is not None
    found = stored.astype(np.float64)
    known = np.isfinite(found)
    # A region whose error is known in no frame divides 0 by 0, and is NaN as promised.
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = np.where(known, found, 0) ** 2
        return np.asarray(np.sqrt(squares.sum(0) / known.sum(0)))
