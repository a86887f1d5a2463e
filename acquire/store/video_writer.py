"""Writer of a video whose frames come one after the other, for videos longer than memory."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from acquire.errors import UsageError
from acquire.store import video_layout as layout
from acquire.store.delivery import delivery_to
from acquire.store.layout import group_document, to_json
from acquire.store.refusals import refused

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path
    from types import TracebackType

    import zarr
    from numpy.typing import NDArray

CHUNK_BYTES = 4 * 2**20

EVERY_CHUNK: Any = {"write_empty_chunks": True}
"""Also chunks that hold nothing but the fill value are written: one that is not there is lost."""
COLUMN_CHUNK = 65536
"""Number of values in a column's chunk."""


class VideoWriter:
    """A growing video: under a temporary name until `finish`, then whole under its own.

    Leaving the ``with`` block without `finish` leaves nothing behind. One thread at a time.
    """

    def __init__(
        self,
        place: Path | str,
        shape: tuple[int, int],
        dtype: np.dtype[Any],
        grid: layout.VideoGrid,
        *,
        quality: bool = False,
        regions: tuple[int, int] | None = None,
        tile_side: int | None = None,
        fill_value: float | None = None,
    ) -> None:
        """Create the video.

        ``regions``: number of regions with an estimated error along rows and columns; requires ``quality``.
        ``tile_side``: rows and columns of a chunk; None: those of a frame. ``fill_value``: value of voxels
        that are not there; None: NaN, or 0 where the type has none.
        """
        import zarr

        if fill_value is None:
            # A chunk that is lost later reads as NaN in every program, and not as darkness.
            fill_value = float("nan") if dtype.kind == "f" else 0
        self._place, self._delivery, self._grid = place, delivery_to(place), grid
        self._name = PurePosixPath(str(place)).stem
        self._window, self._begin_ns = layout.DisplayRange(), 0
        # Until this has returned there is no ``with`` block that would remove what a full disk leaves.
        with ExitStack() as undo, refused(place, "written"):
            undo.callback(self._delivery.clear)
            self._group = zarr.create_group(self._delivery.partial, zarr_format=3)
            chunk = shape if tile_side is None else (tile_side, tile_side)
            frames = max(1, CHUNK_BYTES // (chunk[0] * chunk[1] * dtype.itemsize))
            self._levels = [
                self._group.create_array(
                    str(number),
                    shape=(0, *each),
                    dtype=dtype,
                    # as many frames at every level
                    chunks=(frames, min(chunk[0], each[0]), min(chunk[1], each[1])),
                    fill_value=fill_value,
                    compressors=_packed(),
                    dimension_names=("t", "y", "x"),
                    config=EVERY_CHUNK,
                )
                for number, each in enumerate(layout.level_shapes(shape))
            ]
            self._columns = {
                "time": _column(self._group, "time", "int64", layout.TIME_ATTRIBUTES),
                "t": _column(self._group, "t", "float64", layout.coordinate_attributes("t", grid)),
            }
            if quality:
                self._columns["quality"] = _column(
                    self._group, "quality", "float32", layout.QUALITY_ATTRIBUTES
                )
            if regions is not None:
                self._columns["error"] = _of_regions(self._group, regions)
            for axis, count in zip("yx", shape, strict=True):
                _whole(self._group, axis, layout.along(axis, grid, count), axis, grid)
            undo.pop_all()
        self._chunk: list[tuple[NDArray[Any], ...]] = []
        self.frames = 0

    def append(
        self,
        video: NDArray[Any],
        time_ns: NDArray[np.int64],
        quality: NDArray[np.float32] | None = None,
        error: NDArray[np.float32] | None = None,
    ) -> None:
        """Append frames (t, y, x), with quality (t,) and error (t, region_y, region_x) if the video has them.

        Whole chunks go to the disk. Raises StoreError if it refuses.
        """
        if not self.frames and len(time_ns):
            self._begin_ns = int(time_ns[0])
        since_s = self._grid.origin[0] + (time_ns - self._begin_ns) * 1e-9
        columns = (time_ns, since_s, *(each for each in (quality, error) if each is not None))
        self._chunk.append((video, *columns))
        self._window.add(video)
        self.frames += len(video)
        # Part of a chunk waits: with the next frames, zarr would have to read it again and pack it once more.
        if sum(len(part[0]) for part in self._chunk) >= self._levels[0].chunks[0]:
            self._flush(whole_chunks=True)

    def finish(self, provenance: Mapping[str, Any]) -> None:
        """Make the video appear under its name. Raises UsageError if it has no frame.

        ``provenance["trusted"]``, first frame and the one after the last, marks the trusted frames.
        """
        if not self.frames:
            raise UsageError(f"{self._place}: the video has no frame")
        check_provenance(provenance)
        self._flush(whole_chunks=False)
        self._end(provenance)

    def _end(self, provenance: Mapping[str, Any]) -> None:
        """Mark the trusted frames, write the metadata, and deliver the video."""
        first, end = provenance.get("trusted") or (0, 0)
        with refused(self._place, "written"):
            # Only now: the trusted frames of the last range are known after it was solved.
            if "trusted" in provenance:
                frame = np.arange(self.frames)
                column = _column(self._group, "trusted", "bool", layout.TRUSTED_ATTRIBUTES)
                column.resize((self.frames,))
                column[:] = (int(first) <= frame) & (frame < int(end))
                self._columns["trusted"] = column
            # Consolidated by hand, since the columns are not to be listed, and zarr-python would warn.
            self._levels[0].update_attributes({"coordinates": layout.coordinates_of(tuple(self._columns))})
            count, shown = len(self._levels), min(int(first), self.frames - 1)
            ome = layout.ome_attributes(self._name, self._grid, count, self._window, shown)
            attributes = {
                "format": layout.FORMAT,
                layout.EVERY_CHUNK: True,
                "ome": ome,
                "provenance": dict(provenance),
            }
            partial = self._delivery.partial
            nodes = {str(n): json.loads((partial / str(n) / "zarr.json").read_bytes()) for n in range(count)}
            (partial / "zarr.json").write_bytes(to_json(group_document(attributes, nodes)))
        self._delivery.deliver()

    def _flush(self, *, whole_chunks: bool) -> None:
        video, *columns = (np.concatenate(parts) for parts in zip(*self._chunk, strict=True))
        chunk, waiting = self._levels[0].chunks[0], len(video)
        count = waiting // chunk * chunk if whole_chunks else waiting
        self._chunk = [(video[count:], *(values[count:] for values in columns))]
        with refused(self._place, "written"):
            for array, values in zip(self._columns.values(), columns, strict=True):
                _append(array, values[:count])
            frames = video[:count]
            for level in self._levels:
                _append(level, frames)
                frames = layout.halved(frames) if level is not self._levels[-1] else frames

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._delivery.clear()


def check_provenance(provenance: Mapping[str, Any]) -> None:
    """Raise UsageError unless the provenance is JSON."""
    try:
        json.dumps(dict(provenance), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise UsageError(
            f"provenance is not JSON: {error}", possible="text, finite numbers, lists"
        ) from error


def _checked() -> list[Any]:
    from zarr.codecs import Crc32cCodec

    return [Crc32cCodec()]


def _packed() -> list[Any]:
    from zarr.codecs import BloscCodec

    return [BloscCodec(cname="zstd", clevel=3, shuffle="bitshuffle"), *_checked()]


def _append(array: zarr.Array[Any], values: NDArray[Any]) -> None:
    first = array.shape[0]
    array.resize((first + len(values), *array.shape[1:]))
    array[first:] = values


def _column(group: zarr.Group, name: str, dtype: str, attributes: dict[str, Any]) -> zarr.Array[Any]:
    return group.create_array(
        name,
        shape=(0,),
        dtype=dtype,
        chunks=(COLUMN_CHUNK,),
        compressors=_checked(),
        dimension_names=("t",),
        attributes=attributes,
        config=EVERY_CHUNK,
    )


def _of_regions(group: zarr.Group, regions: tuple[int, int]) -> zarr.Array[Any]:
    return group.create_array(
        "error",
        shape=(0, *regions),
        dtype="float32",
        chunks=(max(1, COLUMN_CHUNK // (regions[0] * regions[1])), *regions),
        fill_value=float("nan"),
        compressors=_packed(),
        dimension_names=("t", "region_y", "region_x"),
        attributes=layout.ERROR_ATTRIBUTES,
        config=EVERY_CHUNK,
    )


def _whole(group: zarr.Group, name: str, values: NDArray[Any], axis: str, grid: layout.VideoGrid) -> None:
    """Create the coordinates of an axis, all at once."""
    array = group.create_array(
        name,
        shape=values.shape,
        dtype=values.dtype,
        chunks=values.shape,
        compressors=_checked(),
        dimension_names=(axis,),
        attributes=layout.coordinate_attributes(axis, grid),
        config=EVERY_CHUNK,
    )
    array[:] = values
