"""Shapes of masks with smooth edges.

A shape is the signed distance to its outline in a square of side 1 around the origin: negative inside, with
rows counted downwards. A pixel whose centre lies within half a pixel of the outline is partly covered, so
that a shape moves smoothly by fractions of a pixel.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Grid = NDArray[np.float64]

_STROKE = 0.11
"""Half the stroke width of "x" and "equals"."""
_SPREAD = 0.22
"""Distance of the two bars of "equals" from the middle."""


def coverage(shape: str, row: Grid, column: Grid, pixel: float) -> NDArray[np.float32]:
    """Return the covered fraction (float32) of pixels of side ``pixel`` with centres (row, column).

    ``row`` and ``column`` broadcast; lengths are fractions of the shape's bounding square.
    """
    covered = np.clip(0.5 - SHAPES[shape](row, column) / pixel, 0, 1)
    return covered.astype(np.float32)


def _both(one: Grid, other: Grid) -> Grid:
    """Return the intersection of two shapes."""
    distance: Grid = np.maximum(one, other)
    return distance


def _box(row: Grid, column: Grid, half_height: float = 0.5) -> Grid:
    return _both(np.abs(row) - half_height, np.abs(column) - 0.5)


def _triangle(row: Grid, column: Grid) -> Grid:
    """A triangle with its apex in the middle of the upper side; the lower side is its base."""
    # the flank's normal is (−1, 2)/√5: the factor makes this a distance
    flank = (np.abs(column) - (row + 0.5) / 2) * (2 / np.sqrt(5))
    return _both(row - 0.5, flank)


def _cross(row: Grid, column: Grid) -> Grid:
    """Both diagonals, clipped to the bounding square."""
    # distance to the nearer diagonal
    diagonals = np.minimum(np.abs(row + column), np.abs(row - column)) / np.sqrt(2)
    return _both(diagonals - _STROKE, _box(row, column))


SHAPES: dict[str, Callable[[Grid, Grid], Grid]] = {
    "x": _cross,
    "triangle": _triangle,
    "circle": lambda row, column: np.hypot(row, column) - 0.5,
    "equals": lambda row, column: _box(np.abs(row) - _SPREAD, column, half_height=_STROKE),
    "square": _box,
}
