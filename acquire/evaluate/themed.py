"""Drawings for a page: SVG with colours that follow the reader's theme, for wide and for narrow pages.

One figure gives a PNG and two shapes of the SVG: the text keeps its size, and the rest is laid out again.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from io import StringIO
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

if TYPE_CHECKING:
    from pathlib import Path

DPI = 150
WIDTH_IN, NARROW_IN = 10.0, 4.6
"""Width of a drawing on a page and on a phone, where its text is then as large as the small print."""

INK, EDGE, GRID = "#1f2933", "#7b8794", "#e4e7eb"
SOFT = "#52606d"
THEORY = "#9aa5b1"
HIGHLIGHT = "#f0b429"
MASKED = "#d55e00"
SOLVER_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
"""Okabe and Ito's palette, which remains distinct with the common colour vision deficiencies."""

DARK = {
    INK: "#e4e9ef",
    EDGE: "#8592a0",
    GRID: "#303a46",
    SOFT: "#a3b0be",
    THEORY: "#6b7785",
    SOLVER_COLOURS[0]: "#4aa8e0",
    SOLVER_COLOURS[1]: "#f0894a",
    SOLVER_COLOURS[2]: "#2fcf9f",
    SOLVER_COLOURS[3]: "#e6a3cc",
}
"""Colours of drawings → their replacements on a dark page."""

STYLE: Any = {
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelcolor": INK,
    "axes.edgecolor": EDGE,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.frameon": False,
    "image.interpolation": "none",  # keeps the pixels of a picture, so that it is small in the SVG
    # For the PNG, which has no theme; the SVG is transparent.
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}

ROOM_IN = 0.08
"""Padding around the axes: twice matplotlib's default."""
SVG: Any = {"svg.fonttype": "none", "svg.hashsalt": "acquire", "font.family": "sans-serif"}
"""Text stays text, in the reader's own font; the same figure always gives the same file."""


def canvas(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    """Make an empty figure without pyplot's global state, with room for a larger font of the reader."""
    return Figure(figsize=(width_in, height_in), layout=ConstrainedLayoutEngine(w_pad=ROOM_IN, h_pad=ROOM_IN))


@dataclass(frozen=True, slots=True)
class Drawing:
    """A figure as SVG for a page, and for a narrow page if that needs another shape."""

    svg: str
    narrow: str | None = None


def save_drawing(
    figure: Figure,
    directory: Path,
    name: str,
    *,
    narrow: Figure | None = None,
    narrow_in: float | None = None,
) -> Drawing:
    """Write ``NAME.png`` and ``NAME.svg``; return the drawing to embed in a page, as `drawing_of`."""
    # the PNG first, because `drawing_of` may give the figure another shape
    figure.savefig(directory / f"{name}.png", dpi=DPI)
    drawing = drawing_of(figure, narrow=narrow, narrow_in=narrow_in)
    (directory / f"{name}.svg").write_text(drawing.svg, encoding="utf-8")
    return drawing


def drawing_of(figure: Figure, *, narrow: Figure | None = None, narrow_in: float | None = None) -> Drawing:
    """Return a figure as SVG without a background.

    On narrow pages it is replaced by ``narrow``, or by the same figure in another shape, ``narrow_in`` high
    (by default as high as before). A figure that is narrow already serves both.
    """
    wide = _svg(figure)
    if narrow is None and figure.get_figwidth() <= NARROW_IN:
        return Drawing(wide)
    if narrow is None:
        figure.set_size_inches(NARROW_IN, narrow_in or figure.get_figheight())
        narrow = figure
    return Drawing(wide, _svg(narrow))


def _svg(figure: Figure) -> str:
    file = StringIO()
    with mpl.rc_context(SVG):
        # without a date, so that the same figure gives the same file
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    # Paths are rounded to 0.01 pt, which nobody can see: a curve of 600 points takes a fifth less.
    svg = re.sub(r' d="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path[0]), file.getvalue())
    # Colours become variables, to which a rule in the drawing gives other values on dark screens.
    names = {colour: f"--ink{number}" for number, colour in enumerate(DARK)}
    for colour, name in names.items():
        # after a colon or a space, as in a style; elsewhere it may be part of a text
        svg = re.sub(rf"(?<=[:\s]){colour}\b", f"var({name})", svg)
    light = "".join(f"{name}:{colour};" for colour, name in names.items())
    night = "".join(f"{names[colour]}:{other};" for colour, other in DARK.items())
    # On a screen only: paper stays white when the page is printed.
    dark_rule = f"@media screen and (prefers-color-scheme: dark){{svg{{{night}}}}}"
    style = f"<style>svg{{{light}}}{dark_rule}text{{fill:var({names[INK]})}}</style>"
    return re.sub(r"(<svg[^>]*>)", lambda found: found[1] + style, svg, count=1)
