"""The paper's figures from simulated recordings: record, reconstruct, compare, draw.

::

    studio     scene file ──▶ recording ──▶ reconstruction, and the truth in the same voxels
    fig6 … fig11     what the figure shows, and its table beside the paper's statement
    page       all of them in one page

One function per figure takes a `Studio` and gives a `PaperFigure`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.evaluate.paper.against import Row
from acquire.evaluate.paper.studio import PaperFigure, Picture, Studio

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["FIGURES", "PaperFigure", "Picture", "Row", "Studio", "make"]

FIGURES = ("fig6", "fig7", "fig8", "fig9", "fig10", "fig11")


def make(name: str, studio: Studio) -> PaperFigure:
    """Record, reconstruct and draw one of `FIGURES`; what it needs is imported when it is asked for."""
    from importlib import import_module

    import matplotlib as mpl

    from acquire.evaluate.themed import STYLE

    figure: Callable[[Studio], PaperFigure] = import_module(f"acquire.evaluate.paper.{name}").figure
    with mpl.rc_context(STYLE):
        return figure(studio)
