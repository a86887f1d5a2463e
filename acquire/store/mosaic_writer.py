"""Writer of a video that comes in tiles, each in the order of its frames: one tile at a time is in memory."""

from __future__ import annotations

from contextlib import ExitStack
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import UsageError
from acquire.store import video_layout as layout
from acquire.store.refusals import refused
from acquire.store.video_writer import VideoWriter, check_provenance

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

NOT_THERE = float("nan")
"""Value of voxels in tiles that were not written."""


class MosaicWriter(VideoWriter):
    """A video of ``tiles`` (rows, columns of them) of ``side`` × ``side`` voxels and as many frames as times.

    Chunks are of one tile. Voxels that are never put are `NOT_THERE`, which `finish` writes. One thread at a
    time.
    """

    def __init__(
        self,
        place: Path | str,
        tiles: tuple[int, int],
        side: int,
        grid: layout.VideoGrid,
        time_ns: NDArray[np.int64],
        *,
        regions: int = 1,
    ) -> None:
        """``regions``: number of regions with an error, along rows and columns of a tile."""
        shape = (tiles[0] * side, tiles[1] * side)
        super().__init__(
            place,
            shape,
            np.dtype(np.float32),
            grid,
            quality=True,
            regions=(tiles[0] * regions, tiles[1] * regions),
            tile_side=side,
            fill_value=NOT_THERE,
        )
        with ExitStack() as undo, refused(place, "written"):
            undo.callback(self._delivery.clear)
            self._time_ns, self.frames, self._side = time_ns, len(time_ns), side
            shape_of_errors = (self.frames, tiles[0] * regions, tiles[1] * regions)
            self._error = np.full(shape_of_errors, NOT_THERE, np.float32)
            # Sum and number: the mean of a frame is known once its last tile is, and tiles are not kept.
            self._squares = np.zeros((2, self.frames))
            # Of its full length from the beginning: a tile may be put whole before the next one has a frame.
            self._levels[0].resize((self.frames, *shape))
            undo.pop_all()

    def put(
        self,
        first: int,
        tile: tuple[int, int],
        video: NDArray[np.float32],
        quality: NDArray[np.float32],
        error: NDArray[np.float32],
    ) -> None:
        """Write frames (t, side, side) of one tile from frame ``first`` on.

        ``tile``: its row and column; ``quality`` (t,) and ``error`` (t, regions, regions) of these frames.
        Raises StoreError if the disk refuses.
        """
        row, column = (each * self._side for each in tile)
        end = first + len(video)
        high, wide = (each * count for each, count in zip(tile, error.shape[1:], strict=True))
        self._error[first:end, high : high + error.shape[1], wide : wide + error.shape[2]] = error
        with refused(self._place, "written"):
            image: Any = self._levels[0]
            image[first:end, row : row + video.shape[1], column : column + video.shape[2]] = video
        self._window.add(video)
        known = np.isfinite(quality)
        self._squares[:, first:end] += np.where(known, np.square(quality, dtype=np.float64), 0), known

    def finish(self, provenance: Mapping[str, Any]) -> None:
        """Make the video appear under its name; a frame's quality is the RMS of its tiles'."""
        if not self.frames:
            raise UsageError(f"{self._place}: a video without a frame cannot be written")
        check_provenance(provenance)
        squares, count = self._squares
        self._begin_ns = int(self._time_ns[0])
        since_s = self._grid.origin[0] + (self._time_ns - self._begin_ns) * 1e-9
        with np.errstate(invalid="ignore", divide="ignore"):
            quality = np.sqrt(squares / count).astype(np.float32)
        with refused(self._place, "written"):
            values: Any
            columns = (self._time_ns, since_s, quality, self._error)
            for array, values in zip(self._columns.values(), columns, strict=True):
                array.resize((self.frames, *array.shape[1:]))
                array[:] = values
            self._complete()
            # In whole chunks of time, each of which is read and written once.
            step = self._levels[0].chunks[0]
            for larger, smaller in zip(self._levels, self._levels[1:], strict=False):
                smaller.resize((self.frames, *smaller.shape[1:]))
                for first in range(0, self.frames, step):
                    frames = np.asarray(larger[first : first + step])
                    smaller[first : first + step] = layout.halved(frames)
        self._end(provenance)

    def _complete(self) -> None:
        """Write the chunks of which no voxel was put, so that one that is lost later differs from them."""
        image: Any = self._levels[0]
        step = image.chunks[0]
        for first, row, column in product(
            range(0, self.frames, step), *(range(0, size, self._side) for size in image.shape[1:])
        ):
            key = f"{first // step}/{row // self._side}/{column // self._side}"
            if not (self._delivery.partial / "0" / "c" / key).exists():
                place = slice(row, row + self._side), slice(column, column + self._side)
                image[first : first + step, *place] = NOT_THERE
