"""Contrast of the bars of a USAF 1951 target, element by element (Fig. 6c)."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.sim.targets import usaf_bars

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.sim.targets import Bar

THRESHOLD = 0.1
"""Contrast at which the paper calls an element resolved."""


def contrasts(picture: NDArray[Any], field_mm: float, groups: tuple[int, ...]) -> dict[str, float]:
    """Return (bright − dark)/(bright + dark) of each element ``"group/element"``, for the worse direction.

    Bright is the mean along the middle of the bars, at the centre of each bar's width; dark is the same at
    the centre of each gap.
    """
    found: dict[str, float] = {}
    bars = [bar for bar in usaf_bars(groups) if bar.element > 0]
    for name in dict.fromkeys(f"{bar.group}/{bar.element}" for bar in bars):
        own = [bar for bar in bars if f"{bar.group}/{bar.element}" == name]
        lying = [bar for bar in own if bar.width > bar.height]
        standing = [bar for bar in own if bar.height > bar.width]
        found[name] = min(_contrast(picture, three, field_mm) for three in (lying, standing))
    return found


def last_resolved(contrast: dict[str, float]) -> str:
    """Return the finest element up to which all reach `THRESHOLD`; ``–`` if the first does not."""
    last = "–"
    # As texts, which is their order in size: groups and elements have one digit.
    for name, value in sorted(contrast.items()):
        if value < THRESHOLD:
            break
        last = name
    return last


def place_of(element: str) -> int:
    """Number an element through the groups; ``–`` comes right before the first element of group 2."""
    group, _, number = element.partition("/")
    return 6 * int(group) + int(number) if number else 6 * 2


def _contrast(picture: NDArray[Any], bars: list[Bar], field_mm: float) -> float:
    size = len(picture)
    lying = bars[0].width > bars[0].height
    view = picture if lying else picture.T
    along = [(bar.left, bar.width) if lying else (bar.top, bar.height) for bar in bars]
    across = sorted((bar.top, bar.height) if lying else (bar.left, bar.width) for bar in bars)
    begin, length = along[0]
    # the middle half, away from the ends, at which blur mixes bars with the ground around them
    low, high = (_pixel(begin + part * length, field_mm, size) for part in (0.25, 0.75))
    middle = slice(int(low), max(int(low) + 1, int(np.ceil(high))))
    profile = view[:, middle].mean(axis=1)
    bright = [_at(profile, top + width / 2, field_mm) for top, width in across]
    dark = [_at(profile, (a + wa + b) / 2, field_mm) for (a, wa), (b, _) in pairwise(across)]
    level = np.mean(bright) + np.mean(dark)
    return float((np.mean(bright) - np.mean(dark)) / level) if level > 0 else 0.0


def _pixel(millimetres: float, field_mm: float, size: int) -> float:
    return (millimetres / field_mm + 0.5) * size


def _at(profile: NDArray[Any], millimetres: float, field_mm: float) -> float:
    """Interpolate the profile between the centres of its pixels."""
    # pixel k is centred at k + ½
    place = _pixel(millimetres, field_mm, len(profile)) - 0.5
    return float(np.interp(place, np.arange(len(profile)), profile))
