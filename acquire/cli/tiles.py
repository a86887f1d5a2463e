"""The options that select tiles of a scene behind a fibre."""

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
    typer.Option(
        "--tile",
        metavar="ROW,COLUMN",
        help="For a scene behind a fibre: row and column of the tile to use, each counted from 0.",
    ),
]
TilesOption = Annotated[
    str | None,
    typer.Option(
        "--tiles",
        metavar="ROWS,COLUMNS",
        help="For a scene behind a fibre: rows and columns of the tiles to use, counted from 0: 1,2 is one "
        "tile, 0-1,2-4 are six tiles. Default: all tiles.",
    ),
]


def tile_of(recording: Recording, text: str | None) -> Tile | None:
    """Return the selected tile, None without one. Raises UsageError for several tiles, or one outside."""
    if text is None:
        return None
    tiles = tiles_of(recording, text)
    if len(tiles) > 1:
        raise UsageError(
            f"--tile takes one tile, but {text} selects {len(tiles)}",
            possible=f"one tile, such as {tiles[0]}",
        )
    return tiles[0]


def tiles_of(recording: Recording, text: str | None) -> tuple[Tile, ...]:
    """Return the selected tiles, row by row; all tiles of the recording if ``text`` is None.

    A recording without a fibre has none. Raises UsageError for text that cannot be read, for tiles outside
    the scene, and for tiles of a recording without a fibre.
    """
    from acquire.fibre import Tile

    fibre: Fibre | None = recording.fibre
    if fibre is None:
        if text is not None:
            raise UsageError(
                f"{recording} has no tiles, because it was not recorded behind a fibre",
                possible="no --tile or --tiles",
            )
        return ()
    if text is None:
        return fibre.tiles
    # Nine digits at most: Python refuses to convert thousands.
    found = re.fullmatch(r"(\d{1,9})(?:-(\d{1,9}))?,(\d{1,9})(?:-(\d{1,9}))?", text)
    if found is None:
        raise UsageError(
            f"the tiles {text!r} cannot be read", possible="ROWS,COLUMNS from 0, such as 1,2 or 0-1,2-4"
        )
    top, bottom, left, right = (None if each is None else int(each) for each in found.groups())
    last = Tile(top if bottom is None else bottom, left if right is None else right)  # type: ignore[arg-type]  # digits
    first = Tile(top, left)  # type: ignore[arg-type]  # digits
    # Before the range is made: of such numbers it could have 10^18 tiles.
    fibre.check_tile(first)
    fibre.check_tile(last)
    tiles = tuple(
        Tile(row, column)
        for row in range(first.row, last.row + 1)
        for column in range(first.column, last.column + 1)
    )
    if not tiles:
        raise UsageError(
            f"the range of tiles {text!r} runs backwards",
            possible="the smaller number first, such as 0-1,2-4",
        )
    return tiles
