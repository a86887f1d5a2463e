"""The sheet: a target that shows orientation, alignment, the optics' blur and the veil in one recording.

The drawing repeats a tile of four blocks, with other dots and other turns in every tile::

    ┌───────────────┬───────────────┐
    │  a bright     │  dots         │   dots     of 2 to 6 fine pixels: orientation, alignment
    │  square       │               │   squares  turned by some degrees, nothing near them: blur
    ├───────────────┼───────────────┤   patch    dark, without anything: veil
    │  dots around  │  another      │
    │  a dark patch │  square       │
    └───────────────┴───────────────┘

It is bright on dark, and not the reverse, since light adds noise: at the brightest that saturates no pixel,
edges of dark squares on a bright ground had twice the noise relative to their step. Positions are in fine
pixels from the centre, rows downwards.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

BLOCK = 32
"""Side of a block in coarse pixels: a sensor of 64 stages sees a whole tile."""
TILE = 2 * BLOCK
SQUARE = 18
"""Side of a bright square in coarse pixels, on which the window of a fit has room between two corners."""
CLEAR = 28
"""Side of the surroundings of a square that are dark, so that a window sees nothing but one edge."""
PATCH = 20
"""Side of the dark patch. With 14, the noise of 1024 lines left the veil uncertain by half a percent."""
DOTS = (2, 6)
"""Least and largest side of a dot in fine pixels, as fine as the cameras show and the alignment needs."""
FILLED = 0.35
"""Share of the dots' own area that is bright. Half would show most detail, but more light is more noise."""
TURNS = (-16, -12, -8, 8, 12, 16)
"""Degrees by which squares are turned. A sheet that hangs askew by 5 leaves all of them slanted enough."""
SEED = 1951
"""Of the dots. It is part of the drawing: another number draws another sheet."""
MARGIN = 0.15
"""Part of the field's side that the sheet extends beyond it on every side: nobody aims exactly."""
FINER = 8
"""Points per fine pixel and direction over which a picture's light is averaged."""
STRIP = 0.06
"""Height of the strip of text below the sheet, relative to the field's side."""


@dataclass(frozen=True, slots=True)
class Square:
    """A bright square: its centre in fine pixels, its side, and its turn in degrees counter-clockwise."""

    row: float
    column: float
    side: float
    turn_deg: float

    def holds(self, rows: NDArray[np.float64], columns: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which of these positions are within it."""
        y, x, angle = rows - self.row, columns - self.column, np.deg2rad(self.turn_deg)
        along = y * np.cos(angle) + x * np.sin(angle)
        across = x * np.cos(angle) - y * np.sin(angle)
        inside: NDArray[np.bool_] = np.maximum(np.abs(along), np.abs(across)) < self.side / 2
        return inside

    @property
    def corners(self) -> NDArray[np.float64]:
        """Rows and columns of the corners, in order: (4, 2)."""
        angle = np.deg2rad(self.turn_deg)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        ends = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]]) * self.side / 2
        return np.asarray(ends @ turn.T + (self.row, self.column))


@dataclass(frozen=True, slots=True)
class Tile:
    """One tile: its squares and dots, and where the dots are bright, per fine pixel of the tile."""

    squares: tuple[Square, ...]
    dots: tuple[tuple[int, int, int], ...]
    """Upper row, left column and side, in fine pixels from the tile's corner."""
    bright: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Sheet:
    """The drawing for cameras with ``substeps`` fine pixels per coarse one; it has no end."""

    substeps: int
    _tiles: dict[tuple[int, int], Tile] = field(default_factory=dict, repr=False)

    @property
    def side(self) -> int:
        """Side of a tile in fine pixels."""
        return TILE * self.substeps

    def tile(self, down: int, right: int) -> Tile:
        """Return a tile, numbered from the one in the middle."""
        at = down, right
        if at not in self._tiles:
            self._tiles[at] = _drawn(self.substeps, down, right)
        return self._tiles[at]

    def bright(self, rows: NDArray[np.float64], columns: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which positions are bright."""
        side = self.side
        # the middle of the sheet is that of a tile
        y, x = np.asarray(rows) + side / 2, np.asarray(columns) + side / 2
        down, right = np.floor(y / side).astype(np.int64), np.floor(x / side).astype(np.int64)
        out = np.zeros(y.shape, np.bool_)
        for i in range(int(down.min()), int(down.max()) + 1):
            for j in range(int(right.min()), int(right.max()) + 1):
                here = (down == i) & (right == j)
                if not here.any():
                    continue
                tile, own_y, own_x = self.tile(i, j), y[here] - i * side, x[here] - j * side
                dots = tile.bright[own_y.astype(np.int64), own_x.astype(np.int64)]
                squares = [each.holds(own_y, own_x) for each in tile.squares]
                out[here] = np.logical_or.reduce([dots, *squares])
        return out

    def picture(
        self,
        size: int,
        shift: tuple[float, float] = (0.0, 0.0),
        turn_deg: float = 0.0,
        scale: float = 1.0,
        finer: int = FINER,
    ) -> NDArray[np.float32]:
        """Return the light on ``size`` × ``size`` pixels, 0 to 1: the mean over each one's area.

        The sheet is ``scale`` times as large, turned counter-clockwise, and then shifted by rows and columns.
        """
        at = (np.arange(size * finer) + 0.5) / finer - size / 2
        angle, light = np.deg2rad(turn_deg), np.empty((size, size), np.float32)
        x = at[None, :] - shift[1]
        for row in range(size):
            # a row at a time, as all points together would take hundreds of megabytes
            y = at[row * finer : (row + 1) * finer, None] - shift[0]
            # the turn backwards: from the picture to the sheet
            u = (y * np.cos(angle) + x * np.sin(angle)) / scale
            v = (x * np.cos(angle) - y * np.sin(angle)) / scale
            light[row] = self.bright(u, v).reshape(finer, size, finer).mean(axis=(0, 2))
        return light


def _drawn(substeps: int, down: int, right: int) -> Tile:
    # no negative numbers seed a generator
    rng = np.random.default_rng([SEED, substeps, down + 2**16, right + 2**16])
    S, side = substeps, TILE * substeps
    centres = BLOCK / 2 * S, 3 * BLOCK / 2 * S
    squares = tuple(Square(at, at, SQUARE * S, float(rng.choice(TURNS))) for at in centres)
    free = np.ones((side, side), np.bool_)
    first, second = centres
    for row, column, clear in ((first, first, CLEAR), (second, second, CLEAR), (second, first, PATCH)):
        _cut(free, row, column, clear * S)
    bright, dots, wanted = np.zeros_like(free), [], FILLED * free.sum()
    while bright.sum() < wanted:
        size = int(rng.integers(DOTS[0], DOTS[1] + 1))
        row, column = (int(each) for each in rng.integers(0, side - size + 1, 2))
        here = slice(row, row + size), slice(column, column + size)
        if free[here].all():
            bright[here] = True
            dots.append((row, column, size))
    return Tile(squares, tuple(dots), bright)


def _cut(free: NDArray[np.bool_], row: float, column: float, side: int) -> None:
    top, left = int(row - side / 2), int(column - side / 2)
    free[top : top + side, left : left + side] = False


def svg(substeps: int, stages: int, field_mm: float) -> str:
    """Return the drawing for printing, of which the cameras see ``field_mm`` × ``field_mm``.

    It is larger than that on every side, and a strip below it has its size in words and a line as long as
    the field.
    """
    sheet, n = Sheet(substeps), stages * substeps
    half, strip, mm = n * (0.5 + MARGIN), n * STRIP, field_mm / n
    # of tiles on either side of the middle one, which is centred
    reach = int(np.ceil((half - sheet.side / 2) / sheet.side))
    numbers = range(-reach, reach + 1)
    shapes = [
        shape
        for i in numbers
        for j in numbers
        for shape in _shapes(sheet.tile(i, j), (i - 0.5) * sheet.side, (j - 0.5) * sheet.side)
    ]
    wide, tall = 2 * half, 2 * half + strip
    ground = f'<rect x="{-half:g}" y="{-half:g}" width="{wide:g}" height="{wide:g}"'
    words = f"The cameras see {field_mm:g} mm × {field_mm:g} mm of it, as wide as this line."
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{wide * mm:.4f}mm" height="{tall * mm:.4f}mm" '
        f'viewBox="{-half:g} {-half:g} {wide:g} {tall:g}">',
        f'<clipPath id="sheet">{ground}/></clipPath>',
        f'{ground} fill="#000"/>',
        '<g clip-path="url(#sheet)"><path fill="#fff" d="',
        *shapes,
        '"/></g>',
        f'<path stroke="#000" stroke-width="{strip / 40:g}" d="M{-n / 2:g} {half + strip / 4:g}h{n:g}"/>',
        f'<text x="{-n / 2:g}" y="{half + 0.75 * strip:g}" font-size="{strip / 3:g}" '
        f'font-family="sans-serif">{words} A fine pixel is {mm:.3g} mm.</text>',
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def _shapes(tile: Tile, top: float, left: float) -> list[str]:
    """Return the outlines of a tile's dots and squares."""
    found = [f"M{left + x:g} {top + y:g}h{size}v{size}h-{size}z" for y, x, size in tile.dots]
    for square in tile.squares:
        points = " L".join(f"{left + x:.3f} {top + y:.3f}" for y, x in square.corners)
        found.append(f"M{points}z")
    return found
