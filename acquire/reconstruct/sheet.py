"""Output of a video's frames: one after the other, or behind a fibre tile by tile onto a large sheet."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from acquire.recon.error import REGIONS
from acquire.reconstruct.times import Times
from acquire.store import MosaicWriter, VideoGrid, VideoWriter

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.fibre import Tile
    from acquire.reconstruct.select import VideoRequest
    from acquire.store import Recording


class Sheet(Protocol):
    """Takes finished frames, tile after tile and in the order of time for each."""

    shape: tuple[int, int]

    @property
    def frames(self) -> int:
        """Frames written so far; of a mosaic, all of them."""
        ...

    def take(
        self,
        tile: Tile | None,
        first: int,
        video: NDArray[np.float32],
        quality: NDArray[np.float32],
        error: NDArray[np.float32],
    ) -> None:
        """Take frames (t, y, x) of a tile from ``first`` on, with their quality (t,) and error (t, 8, 8)."""
        ...

    def finish(self, provenance: Mapping[str, Any]) -> None:
        """Publish the video under its name."""
        ...


@contextmanager
def open_sheet(out: Path | str, request: VideoRequest, recording: Recording) -> Iterator[Sheet]:
    """Open the sheet of a video of a recording; without `Sheet.finish` nothing remains."""
    grid, stream, times = request.grid, request.stream, Times.of(recording)
    row = stream.first_line - recording.first_line
    # From the line's own time stamp: a clock that has drifted since the first line does not shift the video.
    read_out_ns = int(recording.arms["a"].read("time", row, row + 1)[0])
    anchor = (stream.substeps * stream.first_line + stream.geometry(1).readout_substep, read_out_ns)

    def utc_ns(first: int, stop: int) -> NDArray[np.int64]:
        # A frame's time is its beginning.
        return times.utc_ns(grid.edges(slice(first, stop))[:-1], anchor)

    if not request.tiles:
        with VideoWriter(
            out,
            (grid.side, grid.side),
            np.dtype(np.float32),
            _video_grid(request, times),
            quality=True,
            regions=(REGIONS, REGIONS),
        ) as writer:
            yield _Strip(writer, (grid.side, grid.side), utc_ns)
        return
    # These are the corners of a rectangle, since tiles are listed row by row.
    first, last = request.tiles[0], request.tiles[-1]
    tiles = (last.row - first.row + 1, last.column - first.column + 1)
    with MosaicWriter(
        out, tiles, grid.side, _video_grid(request, times), utc_ns(0, grid.frames), regions=REGIONS
    ) as mosaic:
        yield _Mosaic(mosaic, grid.side, first, tiles)


class _Strip:
    """Without a fibre: frames of one scene."""

    def __init__(self, writer: VideoWriter, shape: tuple[int, int], utc_ns: Any) -> None:
        self.shape, self._writer, self._utc_ns = shape, writer, utc_ns
        self.finish = writer.finish

    @property
    def frames(self) -> int:
        return self._writer.frames

    def take(
        self,
        tile: Tile | None,  # noqa: ARG002  # the signature of Sheet
        first: int,
        video: NDArray[np.float32],
        quality: NDArray[np.float32],
        error: NDArray[np.float32],
    ) -> None:
        self._writer.append(video, self._utc_ns(first, first + len(video)), quality, error)


class _Mosaic:
    """Frames of several tiles; ``corner`` is the topmost and leftmost of them."""

    def __init__(self, writer: MosaicWriter, side: int, corner: Tile, tiles: tuple[int, int]) -> None:
        self.shape = (tiles[0] * side, tiles[1] * side)
        self._writer, self._side, self._corner = writer, side, corner
        self.finish = writer.finish

    @property
    def frames(self) -> int:
        return self._writer.frames

    def take(
        self,
        tile: Tile | None,
        first: int,
        video: NDArray[np.float32],
        quality: NDArray[np.float32],
        error: NDArray[np.float32],
    ) -> None:
        assert tile is not None
        row, column = tile.row - self._corner.row, tile.column - self._corner.column
        self._writer.put(first, (row, column), video, quality, error)


def _video_grid(request: VideoRequest, times: Times) -> VideoGrid:
    """Return the voxels' positions in pixels at full resolution, and in seconds after the first line."""
    grid = request.grid
    side, begin_s = grid.voxels.spatial_merge, (grid.begin - times.first_substep) * times.substep_ns * 1e-9
    step = (times.substep_ns * grid.voxels.temporal_merge * 1e-9, float(side), float(side))
    row, column = (request.tiles[0].row, request.tiles[0].column) if request.tiles else (0, 0)
    # Positions are those of the voxels' centres.
    middle = (side - 1) / 2
    return VideoGrid(step, (begin_s, row * grid.size + middle, column * grid.size + middle), None)
