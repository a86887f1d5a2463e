"""Drawings for a page: SVG whose ink follows the reader's theme."""

from __future__ import annotations

import re
from io import StringIO
from typing import TYPE_CHECKING, Any

import matplotlib as mpl

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from matplotlib.figure import Figure

SVG: Any = {"svg.fonttype": "none", "svg.hashsalt": "acquire", "font.family": "sans-serif"}
"""Text stays text, in the reader's own font; the same figure gives the same file."""


def save_drawing(figure: Figure, path: Path, dark: Mapping[str, str]) -> None:
    """Write ``figure`` as SVG without a background. ``dark``: colour → what takes its place on a dark page,
    that of plain text first.
    """
    file = StringIO()
    with mpl.rc_context(SVG):
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    path.write_text(_themed(file.getvalue(), dark), encoding="utf-8")


def _themed(svg: str, dark: Mapping[str, str]) -> str:
    names = {colour: f"--ink{number}" for number, colour in enumerate(dark)}
    for colour, name in names.items():
        svg = re.sub(rf"(?<=[:\s]){colour}\b", f"var({name})", svg)
    light = "".join(f"{name}:{colour};" for colour, name in names.items())
    night = "".join(f"{names[colour]}:{other};" for colour, other in dark.items())
    dark_rule = f"@media (prefers-color-scheme: dark){{svg{{{night}}}}}"
    style = f"<style>svg{{{light}}}{dark_rule}text{{fill:var(--ink0)}}</style>"
    return re.sub(r"(<svg[^>]*>)", lambda found: found[1] + style, svg, count=1)
