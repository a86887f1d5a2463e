"""Representations of objects in an interpreter and in a notebook.

``repr`` is one line of words; a notebook gets a table and, if there is one, a picture. Neither reads more
than a moment's worth of data, and neither fails: foreign text is escaped, and a picture that cannot be drawn
is left out.
"""

from __future__ import annotations

import base64
import html
import io
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.text import shortened

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

PICTURE_PX = 192
"""Height of a picture in a notebook."""
MOST_SHOWN = 2**22
"""Upper limit on the samples of a picture."""


def in_words(kind: str, *first: str, **facts: Any) -> str:
    """Return ``<Kind: first, name value, name value>``, without facts that are None."""
    named = (f"{name.replace('_', ' ')} {value}" for name, value in facts.items() if value is not None)
    return f"<{kind}: {', '.join(shortened(words, 200) for words in (*first, *named))}>"


def as_table(title: str, facts: Mapping[str, Any], picture: str = "") -> str:
    """Return HTML: a title, a row for each fact that is not None, and a picture next to them."""
    left = "style='text-align:left'"
    rows = "".join(
        f"<tr><th {left}>{_safe(name)}</th><td {left}>{_safe(value)}</td></tr>"
        for name, value in facts.items()
        if value is not None
    )
    return (
        f"<div style='display:flex;gap:1em;align-items:flex-start'>{picture}"
        f"<div><b>{_safe(title)}</b><table>{rows}</table></div></div>"
    )


def as_picture(image: NDArray[Any], words: str) -> str:
    """Return an ``<img>`` of (row, column), grey from 0 to nearly the brightest; empty without Pillow."""
    try:
        from PIL import Image
    except ModuleNotFoundError:
        return ""
    if not image.size or image.size > MOST_SHOWN or not np.isfinite(image).all():
        return ""
    # A few glaring pixels must not leave all others dark.
    white = float(np.quantile(image, 0.999)) or 1.0
    grey = np.clip(image.astype(np.float64) * (255 / white), 0, 255).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(grey).save(file, "PNG")
    data = base64.b64encode(file.getvalue()).decode("ascii")
    style = f"height:{PICTURE_PX}px;image-rendering:pixelated"
    return f"<img alt='{_safe(words)}' style='{style}' src='data:image/png;base64,{data}'>"


def _safe(value: object) -> str:
    return html.escape(shortened(value, 400))


def error_in_words(facts: Mapping[str, Any]) -> str:
    """Describe the estimated error of a video, given the facts in its provenance."""
    if "unknown" in facts:
        return f"unknown: {facts['unknown']}"
    rms, low, high = (f"{100 * facts[key] / facts['full_scale']:.2g}" for key in ("rms", "low", "high"))
    return f"about {rms} % of full scale ({low} to {high} % in nine of ten)"
