"""Reconstructed videos as OME-Zarr 0.5 images, which viewers open without us.

::

    NAME.zarr/   attributes: ome (axes t, y, x with units, scale), provenance
      0          (t, y, x)
      time       (t) int64, UTC of each frame
      quality    (t) float32, where it is known: relative residual of each frame's lines

`VideoWriter` takes the frames as they come, for videos longer than memory; `write_video` writes one at once.
A place is a path, or a URL as recordings have.
"""

from __future__ import annotations

import json
import math
from contextlib import suppress
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec
from zarr.errors import GroupNotFoundError

from acquire.errors import DataError, PlaceError, UsageError
from acquire.store.camera_stream import DAMAGE, child_array
from acquire.store.delivery import delivery_to
from acquire.store.layout import group_document, to_json
from acquire.store.opening import read_root
from acquire.store.refusals import refused
from acquire.store.source import source_of

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path
    from types import TracebackType

    from numpy.typing import NDArray

FORMAT = "acquire-video/1"
_VIDEO = "the path of a video (a directory NAME.zarr), as `acquire reconstruct --out` writes one"
CHUNK_BYTES = 4 * 2**20
DTYPES = ("uint8", "uint16", "float32")

COLUMN_CHUNK = 65536
"""Time stamps in a chunk."""

TIME_ATTRIBUTES: dict[str, Any] = {
    "standard_name": "time",
    "long_name": "UTC at which the frame begins",
    "units": "nanoseconds since 1970-01-01T00:00:00",
    "calendar": "proleptic_gregorian",
}

QUALITY_ATTRIBUTES: dict[str, Any] = {
    "long_name": "relative RMS residual of the lines that see the frame",
    "comment": "how well the lines are explained; the error of the frame itself may be many times larger",
    "units": "1",
}


@dataclass(frozen=True, slots=True, eq=False)
class VideoFile:
    """A video on disk: ``video`` (t, y, x) is read when it is sliced, ``time_ns`` (t,) int64 UTC.

    ``quality`` (t,) float32 where it was written; 0 is best.
    """

    video: zarr.Array[Any]
    time_ns: NDArray[np.int64]
    attrs: dict[str, Any]
    quality: NDArray[np.float32] | None = None

    @property
    def interval_ns(self) -> float:
        """Duration of a frame."""
        return self.scale[0] * 1e9

    @property
    def scale(self) -> tuple[float, float, float]:
        """Seconds of a frame, height and width of a pixel in `pixel_unit`."""
        return self._transformed("scale", 1.0)

    @property
    def origin(self) -> tuple[float, float, float]:
        """Where the first frame begins, in seconds, and where the centre of the first pixel lies."""
        return self._transformed("translation", 0.0)

    @property
    def pixel_unit(self) -> str | None:
        """UDUNITS-2 name of a length; None where only ratios are known."""
        unit = self.attrs["ome"]["multiscales"][0]["axes"][-1].get("unit")
        return None if unit is None else str(unit)

    @property
    def trusted(self) -> range | None:
        """Frames that are sampled in full; None for a video that does not say."""
        found = (self.attrs.get("provenance") or {}).get("trusted")
        if found is None:
            return None
        first, end = (min(max(int(edge), 0), len(self.time_ns)) for edge in found)
        return range(first, max(first, end))

    def _transformed(self, kind: str, default: float) -> tuple[float, float, float]:
        steps = self.attrs["ome"]["multiscales"][0]["datasets"][0]["coordinateTransformations"]
        found = next((step[kind] for step in steps if step["type"] == kind), [default] * 3)
        t, y, x = map(float, found)
        return t, y, x


def write_video(
    place: Path | str,
    video: NDArray[Any],
    time_ns: NDArray[np.int64],
    pixel_size: float,
    frame_interval_ns: float,
    provenance: Mapping[str, Any],
    *,
    pixel_unit: str | None = "micrometer",
) -> None:
    """Write ``video`` (t, y, x) float32, uint16 or uint8 as a new OME-Zarr 0.5 image.

    ``pixel_size`` is the side of a pixel in ``pixel_unit``, a UDUNITS-2 name of a length, or None where only
    ratios are known. The image appears whole or not at all. UsageError for what cannot be written, before
    anything is touched; StoreError when the disk refuses.
    """
    _check(video, time_ns, pixel_size, frame_interval_ns, provenance)
    rows, columns = video.shape[1:]
    with VideoWriter(
        place, (rows, columns), video.dtype, pixel_size, frame_interval_ns, pixel_unit=pixel_unit
    ) as writer:
        writer.append(video, time_ns)
        writer.finish(provenance)


class VideoWriter:
    """A video that grows: beside its name until `finish`, and then whole at its name.

    Leaving the ``with`` block without `finish` leaves nothing. One thread at a time.
    """

    def __init__(
        self,
        place: Path | str,
        shape: tuple[int, int],
        dtype: np.dtype[Any],
        pixel_size: float,
        frame_interval_ns: float,
        *,
        pixel_unit: str | None = "micrometer",
        quality: bool = False,
    ) -> None:
        self._place, self._delivery = place, delivery_to(place)
        name = PurePosixPath(str(place)).stem
        self._ome = _ome(name, (frame_interval_ns * 1e-9, pixel_size, pixel_size), pixel_unit)
        with refused(place, "written"):
            self._group = zarr.create_group(self._delivery.partial, zarr_format=3)
            self._image = _image(self._group, shape, dtype)
            self._columns = {"time": _column(self._group, "time", "int64", TIME_ATTRIBUTES)}
            if quality:
                self._columns["quality"] = _column(self._group, "quality", "float32", QUALITY_ATTRIBUTES)
        self._chunk: list[tuple[NDArray[Any], ...]] = []
        self.frames = 0

    def append(
        self, video: NDArray[Any], time_ns: NDArray[np.int64], quality: NDArray[np.float32] | None = None
    ) -> None:
        """The next frames (t, y, x). Whole chunks go to the disk; StoreError when it refuses."""
        columns = (time_ns,) if quality is None else (time_ns, quality)
        self._chunk.append((video, *columns))
        self.frames += len(video)
        if sum(len(part[0]) for part in self._chunk) >= self._image.chunks[0]:
            self._flush(whole_chunks=True)

    def finish(self, provenance: Mapping[str, Any]) -> None:
        """The video appears under its name. UsageError for one without frames."""
        if not self.frames:
            raise UsageError(f"{self._place}: a video without a frame")
        _check_provenance(provenance)
        self._flush(whole_chunks=False)
        attributes = {"format": FORMAT, "ome": self._ome, "provenance": dict(provenance)}
        with refused(self._place, "written"):
            # Consolidated by hand: zarr-python warns of its own, and xarray warns where there is none.
            partial, names = self._delivery.partial, ("0", *self._columns)
            nodes = {n: json.loads((partial / n / "zarr.json").read_bytes()) for n in names}
            (partial / "zarr.json").write_bytes(to_json(group_document(attributes, nodes)))
        self._delivery.deliver()

    def _flush(self, *, whole_chunks: bool) -> None:
        arrays = [np.concatenate(parts) for parts in zip(*self._chunk, strict=True)]
        chunk, waiting = self._image.chunks[0], len(arrays[0])
        count = waiting // chunk * chunk if whole_chunks else waiting
        first = self._image.shape[0]
        with refused(self._place, "written"):
            for array, values in zip((self._image, *self._columns.values()), arrays, strict=True):
                array.resize((first + count, *array.shape[1:]))
                array[first:] = values[:count]
        self._chunk = [tuple(values[count:] for values in arrays)]

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._delivery.clear()


def open_video(place: Path | str) -> VideoFile:
    """Open a video that `write_video` wrote.

    Raises PlaceError where there is none, DataError for a damaged one, and StoreError where that cannot be
    found out.
    """
    source = source_of(place)
    try:
        with refused(source, "read"):
            there = source.exists()
        if not there:
            raise PlaceError(f"{source} does not exist", hint=_VIDEO)
        with suppress(PlaceError):  # said below, in a video's words
            read_root(source)  # zarr would wait for a pipe, and read a device for ever
        group = zarr.open_group(source.zarr_store(), mode="r", zarr_format=3)
        attributes = dict(group.attrs)
        if attributes.get("format") != FORMAT:
            raise PlaceError(
                f"{source} is not a video of ours: format {attributes.get('format')!r}",
                possible=f"{FORMAT!r}",
                hint="acquire reconstruct, which makes videos of recordings",
            )
        time_ns = np.asarray(child_array(group, "time")[:], np.int64)
        quality = np.asarray(child_array(group, "quality")[:]) if "quality" in group else None
        return VideoFile(child_array(group, "0"), time_ns, attributes, quality)
    except (GroupNotFoundError, NotADirectoryError) as error:
        raise PlaceError(f"{source} is not a video: it is no Zarr group", hint=_VIDEO) from error
    except DAMAGE as error:
        raise DataError(f"{source} is not a video, or is damaged: {error}") from error


def _check(
    video: NDArray[Any],
    time_ns: NDArray[np.int64],
    pixel_size: float,
    frame_interval_ns: float,
    provenance: Mapping[str, Any],
) -> None:
    if video.ndim != 3 or video.size == 0 or video.dtype.name not in DTYPES:
        raise UsageError(f"video {video.dtype} {video.shape}", possible=f"(t, y, x) of {', '.join(DTYPES)}")
    if time_ns.shape != video.shape[:1] or time_ns.dtype != np.int64:
        raise UsageError(f"time stamps {time_ns.dtype} {time_ns.shape}", possible=f"int64 ({len(video)},)")
    for name, value in (("pixel size", pixel_size), ("frame interval", frame_interval_ns)):
        if not (math.isfinite(value) and value > 0):
            raise UsageError(f"video with {name} {value}", possible="a finite number above 0")
    _check_provenance(provenance)


def _check_provenance(provenance: Mapping[str, Any]) -> None:
    try:
        json.dumps(dict(provenance), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise UsageError(
            f"provenance is not JSON: {error}", possible="text, finite numbers, lists"
        ) from error


def _ome(name: str, scale: tuple[float, float, float], pixel_unit: str | None) -> dict[str, Any]:
    space = {"type": "space"} | ({"unit": pixel_unit} if pixel_unit else {})
    axes = [{"name": "t", "type": "time", "unit": "second"}, {"name": "y", **space}, {"name": "x", **space}]
    transformation = {"type": "scale", "scale": list(scale)}
    datasets = [{"path": "0", "coordinateTransformations": [transformation]}]
    return {"version": "0.5", "multiscales": [{"name": name, "axes": axes, "datasets": datasets}]}


def _image(group: zarr.Group, shape: tuple[int, int], dtype: np.dtype[Any]) -> zarr.Array[Any]:
    frames = max(1, CHUNK_BYTES // (shape[0] * shape[1] * dtype.itemsize))
    return group.create_array(
        "0",
        shape=(0, *shape),
        dtype=dtype,
        chunks=(frames, *shape),
        compressors=[BloscCodec(cname="zstd", clevel=3, shuffle="bitshuffle"), Crc32cCodec()],
        dimension_names=("t", "y", "x"),
    )


def _column(group: zarr.Group, name: str, dtype: str, attributes: dict[str, Any]) -> zarr.Array[Any]:
    return group.create_array(
        name,
        shape=(0,),
        dtype=dtype,
        chunks=(COLUMN_CHUNK,),
        compressors=[Crc32cCodec()],
        dimension_names=("t",),
        attributes=attributes,
    )
