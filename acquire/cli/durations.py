"""Durations on the command line: ``2s``, ``500ms``, ``1.5min``; a bare number is seconds."""

from __future__ import annotations

import math
import re

import typer

UNITS_S = {"us": 1e-6, "ms": 1e-3, "s": 1.0, "": 1.0, "min": 60.0, "h": 3600.0}
_FORM = re.compile(r"\s*([0-9.eE+-]*[0-9.])\s*([a-z]*)\s*")


def seconds(text: str | float) -> float:
    """Seconds of a duration in words. typer.BadParameter names what can be written."""
    found = _FORM.fullmatch(str(text))
    try:
        value = float(found[1]) * UNITS_S[found[2]] if found else math.nan
    except (KeyError, ValueError):
        value = math.nan
    if not math.isfinite(value) or value < 0:
        raise typer.BadParameter(f"{text!r} is no duration: 2s, 500ms, 1.5min, 1h, or seconds as a number")
    return value
