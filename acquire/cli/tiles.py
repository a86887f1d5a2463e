"""Tiles of a scene behind a fibre, as they are named on the command line."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.errors import UsageError

if TYPE_CHECKING:
    from acquire.fibre import Fibre, Tile
    from acquire.store import Recording

TileOption = Annotated[
    str | None,
    typer.Option("--tile", metavar="ROW,COLUMN", help="Tile of a scene behind a fibre, counted from 0,0."),
]
TilesOption = Annotated[
    str | None,
    typer.Option(
        "--tiles",
        metavar="ROWS,COLUMNS",
        help="Tiles of a scene behind a fibre, counted from 0: 1,2 is one, 0-1,2-4 are six; absent: all.",
    ),
]


def tile_of(recording: Recording, text: str | None) -> Tile | None:
    """The one tile that is named; None for none. UsageError for several, and for one that is not there."""
    if text is None:
        return None
    tiles = tiles_of(recording, text)
    if len(tiles) > 1:
        raise UsageError(f"--tile takes one tile, and {text} is {len(tiles)}", possible=f"one, as {tiles[0]}")
    return tiles[0]


def tiles_of(recording: Recording, text: str | None) -> tuple[Tile, ...]:
    """The tiles of a rectangle, row by row; all of a recording where none is named, none without a fibre.

    Raises UsageError for what cannot be read, tiles that are not there, and a recording without a fibre.
    """
    from acquire.fibre import Tile

    fibre: Fibre | None = recording.fibre
    if fibre is None:
        if text is not None:
            raise UsageError(f"{recording} has no tiles: its lines see one scene", possible="no --tiles")
        return ()
    if text is None:
        return fibre.tiles
    found = re.fullmatch(r"(\d+)(?:-(\d+))?,(\d+)(?:-(\d+))?", text)
    if found is None:
        raise UsageError(
            f"tiles {text!r} cannot be read", possible="ROWS,COLUMNS from 0 on, as 1,2 or 0-1,2-4"
        )
    top, bottom, left, right = (None if each is None else int(each) for each in found.groups())
    last = Tile(top if bottom is None else bottom, left if right is None else right)  # type: ignore[arg-type]  # digits
    first = Tile(top, left)  # type: ignore[arg-type]  # digits
    fibre.check_tile(first)
    fibre.check_tile(last)
    tiles = tuple(
        Tile(row, column)
        for row in range(first.row, last.row + 1)
        for column in range(first.column, last.column + 1)
    )
    if not tiles:
        raise UsageError(
            f"the range of tiles {text!r} runs backwards", possible="the smaller number first, as 0-1,2-4"
        )
    return tiles
