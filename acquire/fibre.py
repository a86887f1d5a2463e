"""An image-transmitting fibre: it lays bands of a scene larger than the sensors side by side on them.

The paper's conclusion describes a sensor of 4640 columns and 256 stages that looks at a scene of 768 x 1536
through a fibre that is cut into bands at one end. Camera A's bands are n rows of the scene high. Camera B
sees the scene turned by 90° counter-clockwise, and its bands are n columns wide, each turned::

    scene, R × C                    arm A, n stages                     arm B, n stages
    ┌────┬────┬────┬────┐    ┌────────────┬────────────┐    ┌───────┬───────┬───────┬───────┐
    │0,0 │0,1 │0,2 │0,3 │    │0,0 0,1 … 3 │1,0 1,1 … 3 │    │0,0 1,0│0,1 1,1│0,2 1,2│0,3 1,3│
    ├────┼────┼────┼────┤    └────────────┴────────────┘    └───────┴───────┴───────┴───────┘
    │1,0 │1,1 │1,2 │1,3 │     band 0: C/S     band 1          R/S: the scene's rows of column-band 0, …
    └────┴────┴────┴────┘

Tile (i, j), n × n, is thus seen by M neighbouring columns of each arm, just as a scene of its own would be
seen by a whole sensor, and Eq. (1) holds for it unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Self

from acquire.errors import UsageError
from acquire.flags import ARMS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

LARGEST = 2**16
"""Upper limit on the sides of a scene, in fine pixels."""


@dataclass(frozen=True, slots=True, order=True)
class Tile:
    """One n × n part of the scene: rows of tiles count from 0 downwards, columns from 0 to the right."""

    row: int
    column: int

    def __str__(self) -> str:
        return f"{self.row},{self.column}"


@dataclass(frozen=True, slots=True)
class Fibre:
    """Which columns of which sensor see which part of the scene.

    Parameters
    ----------
    stages, substeps : M and S
    rows, columns : R and C of the scene in fine pixels, multiples of n = M·S
    sensor_pixels : pixels per line of each camera
    bands_a : first column on sensor A of each band of rows, the topmost first
    bands_b : first column on sensor B of each band of columns, the leftmost first

    Raises
    ------
    UsageError
        The scene is not a whole number of tiles, or is a single one; bands overlap or leave the sensor.
    """

    stages: int
    substeps: int
    rows: int
    columns: int
    sensor_pixels: int
    bands_a: tuple[int, ...]
    bands_b: tuple[int, ...]

    def __post_init__(self) -> None:
        _check_sizes(self.stages, self.substeps, self.rows, self.columns)
        for arm in ARMS:
            firsts, width = self.bands(arm), self.band_pixels(arm)
            needed = self.tile_rows if arm == "a" else self.tile_columns
            if len(firsts) != needed:
                raise UsageError(
                    f"fibre: {len(firsts)} bands on sensor {arm.upper()} cannot show a scene of "
                    f"{self.rows} x {self.columns}",
                    possible=f"{needed} bands of {self.size} {'rows' if arm == 'a' else 'columns'} each",
                )
            edges = sorted(firsts)
            overlap = any(after < before + width for before, after in pairwise(edges))
            if overlap or edges[0] < 0 or edges[-1] + width > self.sensor_pixels:
                raise UsageError(
                    f"fibre: bands of {width} columns that begin at {', '.join(map(str, firsts))} overlap or "
                    f"do not fit on the {self.sensor_pixels} columns of sensor {arm.upper()}",
                    possible=f"first columns from 0 to {self.sensor_pixels - width}, at least {width} apart",
                )

    @classmethod
    def side_by_side(
        cls, stages: int, substeps: int, rows: int, columns: int, sensor_pixels: int, **bands: Sequence[int]
    ) -> Self:
        """Return a fibre with the given ``bands`` (``a``, ``b``).

        The bands of an arm that is not given lie next to one another in the middle of its sensor, in order.
        """
        _check_sizes(stages, substeps, rows, columns)
        size = stages * substeps
        placed = {
            arm: tuple(bands.get(arm) or ())
            or _centred_bands(arm, across // size, along // substeps, sensor_pixels)
            for arm, across, along in (("a", rows, columns), ("b", columns, rows))
        }
        return cls(
            stages=stages,
            substeps=substeps,
            rows=rows,
            columns=columns,
            sensor_pixels=sensor_pixels,
            bands_a=placed["a"],
            bands_b=placed["b"],
        )

    @property
    def size(self) -> int:
        """n = M·S, side of a tile and breadth of a band in fine pixels."""
        return self.stages * self.substeps

    @property
    def side(self) -> int:
        """Side of the smallest square that the scene fits in, in fine pixels."""
        return max(self.rows, self.columns)

    @property
    def tile_rows(self) -> int:
        return self.rows // self.size

    @property
    def tile_columns(self) -> int:
        return self.columns // self.size

    @property
    def tiles(self) -> tuple[Tile, ...]:
        """All tiles, row by row."""
        return tuple(Tile(i, j) for i in range(self.tile_rows) for j in range(self.tile_columns))

    def bands(self, arm: str) -> tuple[int, ...]:
        """Return the first column of each band on an arm's sensor."""
        return self.bands_a if arm == "a" else self.bands_b

    def band_pixels(self, arm: str) -> int:
        """Return the number of columns that a band of an arm occupies."""
        return (self.columns if arm == "a" else self.rows) // self.substeps

    def first_pixel(self, arm: str, tile: Tile) -> int:
        """Return the first of the M columns of an arm's sensor that see a tile."""
        self.check_tile(tile)
        band, position = (tile.row, tile.column) if arm == "a" else (tile.column, tile.row)
        return self.bands(arm)[band] + position * self.stages

    def pixels(self, tile: Tile) -> tuple[slice, slice]:
        """Return the columns of sensors A and B that see a tile."""
        a, b = (slice(first := self.first_pixel(arm, tile), first + self.stages) for arm in ARMS)
        return a, b

    def table(self, arm: str) -> NDArray[np.int64]:
        """Return each sensor column's band and its pixel along that band (column, 2); −1 without a band."""
        import numpy as np

        table = np.full((self.sensor_pixels, 2), -1, np.int64)
        along = np.arange(self.band_pixels(arm))
        for number, first in enumerate(self.bands(arm)):
            table[first : first + len(along)] = np.stack([np.full_like(along, number), along], axis=1)
        return table

    def folded(self, profile: NDArray[Any], arm: str) -> NDArray[Any]:
        """Return the sum over the tiles (M,) of a profile over a sensor's columns (pixel,)."""
        import numpy as np

        firsts = [self.first_pixel(arm, tile) for tile in self.tiles]
        total: NDArray[Any] = np.sum([profile[first : first + self.stages] for first in firsts], axis=0)
        return total

    def field(self) -> tuple[slice, slice]:
        """Return the rows and columns of the scene in the middle of a square of `side`."""
        row, column = (self.side - self.rows) // 2, (self.side - self.columns) // 2
        return slice(row, row + self.rows), slice(column, column + self.columns)

    def lay_out(self, frames: NDArray[Any], arm: str) -> NDArray[Any]:
        """Lay frames (t, R, C) on an arm's sensor: (t, n, fine columns), dark between the bands."""
        import numpy as np

        n, S = self.size, self.substeps
        laid = np.zeros((len(frames), n, S * self.sensor_pixels), frames.dtype)
        for number, first in enumerate(self.bands(arm)):
            part = slice(number * n, (number + 1) * n)
            band = frames[:, part] if arm == "a" else np.rot90(frames[:, :, part], axes=(1, 2))
            laid[:, :, S * first : S * first + band.shape[2]] = band
        return laid

    def check_tile(self, tile: Tile) -> None:
        """Raise UsageError unless there is such a tile."""
        if not (0 <= tile.row < self.tile_rows and 0 <= tile.column < self.tile_columns):
            raise UsageError(
                f"the fibre has no tile {tile}",
                possible=f"ROW,COLUMN from 0,0 to {self.tile_rows - 1},{self.tile_columns - 1}",
            )

    def to_attrs(self) -> dict[str, Any]:
        """Return its entry in a recording's geometry, next to stages, substeps and pixels (JSON)."""
        bands = {"a": list(self.bands_a), "b": list(self.bands_b)}
        return {"rows": self.rows, "columns": self.columns, "bands": bands}

    @classmethod
    def of(cls, geometry: Mapping[str, Any]) -> Self | None:
        """Return the fibre of a recording's ``geometry``, or None. Raises UsageError if it is impossible."""
        if (attrs := geometry.get("fibre")) is None:
            return None
        stages, substeps, pixels = (int(geometry[key]) for key in ("stages", "substeps", "pixels"))
        bands_a, bands_b = (tuple(int(first) for first in attrs["bands"][arm]) for arm in ARMS)
        return cls(
            stages=stages,
            substeps=substeps,
            rows=int(attrs["rows"]),
            columns=int(attrs["columns"]),
            sensor_pixels=pixels,
            bands_a=bands_a,
            bands_b=bands_b,
        )


def _check_sizes(stages: int, substeps: int, rows: int, columns: int) -> None:
    size = stages * substeps
    for name, length in (("rows", rows), ("columns", columns)):
        if length < size or length % size or length > LARGEST:
            raise UsageError(
                f"fibre: a scene of {length} {name} is not a whole number of bands of n = {size}",
                possible=f"a multiple of {stages} stages x {substeps} sub-steps, up to {LARGEST}",
            )
    if rows == columns == size:
        raise UsageError(
            f"fibre: a scene of {rows} x {columns} is a single band",
            possible="more rows or columns, or no fibre",
        )


def _centred_bands(arm: str, count: int, width: int, sensor_pixels: int) -> tuple[int, ...]:
    if count * width > sensor_pixels:
        raise UsageError(
            f"fibre: sensor {arm.upper()} with {sensor_pixels} columns is too narrow for {count} bands of "
            f"{width}",
            possible=f"{count * width} columns or more, or a smaller scene",
        )
    first = (sensor_pixels - count * width) // 2
    return tuple(range(first, first + count * width, width))
