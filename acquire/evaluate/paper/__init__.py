"""The paper's figures from simulated recordings: record, reconstruct, compare and draw.

::

    studio         scene file ──▶ recording ──▶ reconstruction, and the truth in the same voxels
    fig6 … fig11   the drawings of each figure, and a table of its results and the paper's statements
    comparison     the rows of these tables, with their verdicts
    page           all figures on one page

One function per figure takes a `Studio` and returns a `PaperFigure`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.evaluate.paper.comparison import Row
from acquire.evaluate.paper.studio import PaperFigure, Picture, Studio

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["FIGURES", "PaperFigure", "Picture", "Row", "Studio", "make"]

FIGURES = ("fig6", "fig7", "fig8", "fig9", "fig10", "fig11")


def make(name: str, studio: Studio) -> PaperFigure:
    """Record, reconstruct and draw one of `FIGURES`; its module is imported on demand."""
    from importlib import import_module

    import matplotlib as mpl

    from acquire.evaluate.themed import STYLE

    figure: Callable[[Studio], PaperFigure] = import_module(f"acquire.evaluate.paper.{name}").figure
    with mpl.rc_context(STYLE):
        return figure(studio)
