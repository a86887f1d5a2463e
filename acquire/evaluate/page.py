"""Pages in a single file, with pictures, style and script inside and no external references."""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING, Any

import jinja2

if TYPE_CHECKING:
    from collections.abc import Mapping

    from acquire.evaluate.themed import Drawing

NARROW_SPACE = "\N{NARROW NO-BREAK SPACE}"
MINUS = "\N{MINUS SIGN}"


def fill_template(template: str, facts: Mapping[str, Any], drawings: Mapping[str, Drawing]) -> str:
    """Fill one of our templates; the drawings become ``images`` of the same names."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("acquire.evaluate"),
        # titles and marks are other people's text
        autoescape=True,
        # a misspelt fact is an error, not a blank
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"num": number, "hz": hertz}
    images = {
        name: {"wide": svg_uri(each.svg), "narrow": each.narrow and svg_uri(each.narrow)}
        for name, each in drawings.items()
    }
    return environment.get_template(template).render(**facts, images=images)


def svg_uri(svg: str) -> str:
    """Return a drawing as a ``data:`` URI."""
    return _data_uri("image/svg+xml", svg.encode())


def webp_uri(webp: bytes) -> str:
    """Return an animation as a data URI."""
    return _data_uri("image/webp", webp)


def _data_uri(media_type: str, content: bytes) -> str:
    return f"data:{media_type};base64,{base64.b64encode(content).decode('ascii')}"


def number(value: float | None, digits: int | None = None, *, signed: bool = False) -> str:
    """Format a number for a page: with grouped thousands, a true minus sign, and an en dash for None.

    Without ``digits`` a float is shown with all its digits, and a whole one without decimals.
    """
    if value is None:
        return "–"
    # No plus before 0, which is neither more nor less.
    text = f"{value:{'+' if signed and value else ''},{'' if digits is None else f'.{digits}f'}}"
    if digits is None:
        text = text.removesuffix(".0")
    return text.replace(",", NARROW_SPACE).replace("-", MINUS)


def hertz(value: float | None) -> str:
    """Format a frequency that was set: ``5 kHz``, ``30 Hz``, or ``constant``."""
    if value is None:
        return "constant"
    return f"{value / 1e3:g}{NARROW_SPACE}kHz" if value >= 1e3 else f"{value:g}{NARROW_SPACE}Hz"
