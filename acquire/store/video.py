"""Reconstructed videos as OME-Zarr 0.5 images, which viewers open without this package.

::

    NAME.zarr/   attributes: ome (axes t, y, x with units, scale, translation; omero), provenance
      0          (t, y, x)
      1, 2, …    the same with half the rows and columns, of large videos
      t, y, x    their coordinates: seconds after the recording's first line, centres of pixels
      time       (t) int64, UTC of each frame
      quality    (t) float32, if known: relative residual of each frame's lines
      error      (t, region_y, region_x) float32, if known: estimated RMS error of parts of the frame
      trusted    (t) bool, if known: sampled in full, and solved to its end

The consolidated metadata, which viewers use, lists the image only: ``xarray.open_zarr(…,
consolidated=False)`` finds the coordinates. `VideoWriter` takes frames as they come, for videos longer than
memory; `write_video` writes a whole one. A place is a path or a URL, as for recordings.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import DataError, PlaceError, UsageError
from acquire.showing import as_picture, as_table, in_words
from acquire.store.camera_stream import child_array
from acquire.store.layout import DAMAGE
from acquire.store.opening import format_in_words, read_root
from acquire.store.refusals import refusal, refused
from acquire.store.source import source_of
from acquire.store.video_layout import EVERY_CHUNK, FORMAT, VideoGrid
from acquire.store.video_writer import VideoWriter, check_provenance
from acquire.text import cause_in_words, shortened, unexpanded

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    import zarr
    from numpy.typing import NDArray

_VIDEO = "the path of a video (a directory NAME.zarr), as `acquire reconstruct --out` writes one"
DTYPES = ("uint8", "uint16", "float32")


@dataclass(frozen=True, slots=True, eq=False)
class VideoFile:
    """A video on disk: ``video`` (t, y, x) is read when it is sliced, ``time_ns`` (t,) int64 UTC.

    ``quality`` (t,) float32, if it was written; 0 is best. ``error`` (t, region_y, region_x) likewise is the
    estimated RMS error in the video's unit, read when it is sliced.
    """

    video: zarr.Array[Any]
    time_ns: NDArray[np.int64]
    attrs: dict[str, Any]
    quality: NDArray[np.float32] | None = None
    error: zarr.Array[Any] | None = None

    def __repr__(self) -> str:
        return in_words("VideoFile", **self._holds())

    def _repr_html_(self) -> str:
        """Return a table with the middle one of the trusted frames."""
        shown = self.trusted or range(len(self.time_ns))
        number = shown[len(shown) // 2]
        try:
            picture = as_picture(np.asarray(self.video[number]), f"frame {number}")
        except DAMAGE:  # reported when the frame is read
            picture = ""
        return as_table("Video", self._holds(), picture)

    def _holds(self) -> dict[str, str]:
        """Return a description in words."""
        count, rows, columns = self.video.shape
        trusted = self.trusted
        span = trusted and f"frames {trusted.start} to {trusted.stop - 1}"
        each = f"{self.interval_ns / 1000:.6g} us each"
        return {
            "frames": f"{count} of {rows} x {columns} {self.video.dtype.name}, {each}",
            "pixel": f"{self.scale[1]:.6g} x {self.scale[2]:.6g} {self.pixel_unit or 'fine pixels'}",
            "trusted": "not known" if trusted is None else span or "none",
        }

    @property
    def interval_ns(self) -> float:
        """Duration of a frame in ns."""
        return self.scale[0] * 1e9

    @property
    def scale(self) -> tuple[float, float, float]:
        """Seconds of a frame, height and width of a pixel in `pixel_unit`."""
        return self._transformed("scale", 1.0)

    @property
    def origin(self) -> tuple[float, float, float]:
        """Start of the first frame in seconds, and the centre of the first pixel (y, x)."""
        return self._transformed("translation", 0.0)

    @property
    def pixel_unit(self) -> str | None:
        """UDUNITS-2 name of a length; None if only ratios are known."""
        unit = self.attrs["ome"]["multiscales"][0]["axes"][-1].get("unit")
        return None if unit is None else str(unit)

    @property
    def trusted(self) -> range | None:
        """Frames that are sampled in full; None if the video does not state them."""
        found = (self.attrs.get("provenance") or {}).get("trusted")
        if found is None:
            return None
        # Within the frames there are, whatever another program has written.
        first, end = (min(max(int(edge), 0), len(self.time_ns)) for edge in found)
        return range(first, max(first, end))

    def frames(self, first: int, stop: int, step: int = 1) -> NDArray[Any]:
        """Read frames (t, y, x), as they are stored. Raises DataError if they are damaged."""
        return _read_frames(self.video, "frames", slice(first, stop, step), whole=self.every_chunk)

    def errors(self, first: int, stop: int, step: int = 1) -> NDArray[Any] | None:
        """Read ``error`` (t, region_y, region_x), if it was written. Raises DataError if it is damaged."""
        return (
            None
            if self.error is None
            else _read_frames(
                self.error, "errors of frames", slice(first, stop, step), whole=self.every_chunk
            )
        )

    @property
    def every_chunk(self) -> bool:
        """Whether each of its chunks was written, also of darkness: one that is not there is lost."""
        return self.attrs.get(EVERY_CHUNK) is True

    def missing(self) -> list[range]:
        """Return the frames of which a file is not there, as far as `every_chunk` allows to tell."""
        if not self.every_chunk:
            return []
        frames, size = self.video.shape[0], self.video.chunks[0]
        gone = sorted(
            {place[0] for place in np.ndindex(*self.video.cdata_shape) if not _is_there(self.video, place)}
        )
        return joined_ranges(range(at * size, min(frames, (at + 1) * size)) for at in gone)

    def readable(self, first: int, stop: int) -> tuple[NDArray[Any], list[range]]:
        """Read frames (t, y, x) as float32, NaN where they cannot be read, and return which these are.

        Raises DataError if none can.
        """
        size, parts, lost = self.video.chunks[0], [], []
        error = None
        for start in (first, *range((first // size + 1) * size, stop, size)):
            end = min(stop, (start // size + 1) * size)
            try:
                parts.append(self.frames(start, end).astype(np.float32))
            except DataError as found:
                error = error or found
                parts.append(np.full((end - start, *self.video.shape[1:]), np.nan, np.float32))
                lost.append(range(start, end))
        if error is not None and len(lost) == len(parts):
            raise error
        return np.concatenate(parts), joined_ranges(lost)

    def _transformed(self, kind: str, default: float) -> tuple[float, float, float]:
        steps = self.attrs["ome"]["multiscales"][0]["datasets"][0]["coordinateTransformations"]
        found = next((step[kind] for step in steps if step["type"] == kind), [default] * 3)
        t, y, x = map(float, found)
        return t, y, x


def _read_frames(array: zarr.Array[Any], what: str, some: slice, *, whole: bool) -> NDArray[Any]:
    """Read some frames. Raises DataError if they are damaged, or, of a ``whole`` video, are not there."""
    try:
        return _read(array, some, whole=whole)
    except DAMAGE as error:
        raise DataError(
            f"{what} {some.start} to {some.stop - 1} of {array.store_path} cannot be read: "
            f"{shortened(error, 200)}",
            hint="a copy of the video, or acquire reconstruct once more",
        ) from error


def _read(array: zarr.Array[Any], some: slice, *, whole: bool) -> NDArray[Any]:
    values = np.asarray(array[some])
    if whole:
        _check_there(array, values, some)
    return values


def _check_there(array: zarr.Array[Any], values: NDArray[Any], some: slice) -> None:
    """Raise FileNotFoundError if a chunk that was read is not there: zarr returns its fill value instead."""
    filled = np.isnan(values) if np.isnan(array.fill_value) else values == array.fill_value
    if not filled.any():
        return
    # Only chunks that look empty are looked for: each costs a remote store a request.
    numbers = np.arange(some.start, min(some.stop, array.shape[0]), some.step or 1) // array.chunks[0]
    for place in np.ndindex(*array.cdata_shape):
        inside = filled[numbers == place[0]][
            :,
            *(
                slice(at * size, (at + 1) * size)
                for at, size in zip(place[1:], array.chunks[1:], strict=True)
            ),
        ]
        if inside.size and inside.all() and not _is_there(array, place):
            key = array.metadata.encode_chunk_key(place)
            raise FileNotFoundError(f"its file {key} is missing")


def _is_there(array: zarr.Array[Any], place: tuple[int, ...]) -> bool:
    """Return whether the file of a chunk is there."""
    from zarr.core.sync import sync

    return bool(sync((array.store_path / array.metadata.encode_chunk_key(place)).exists()))


def joined_ranges(ranges: Iterable[range]) -> list[range]:
    """Return ascending ranges with those that touch joined."""
    found: list[range] = []
    for one in ranges:
        if found and found[-1].stop == one.start:
            found[-1] = range(found[-1].start, one.stop)
        else:
            found.append(one)
    return found


def write_video(
    place: Path | str,
    video: NDArray[Any],
    time_ns: NDArray[np.int64],
    *,
    pixel_size: float,
    frame_interval_ns: float,
    provenance: Mapping[str, Any],
    pixel_unit: str | None = "micrometer",
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    quality: NDArray[np.float32] | None = None,
    error: NDArray[np.float32] | None = None,
) -> None:
    """Write ``video`` (t, y, x) float32, uint16 or uint8 as a new OME-Zarr 0.5 image.

    ``pixel_size`` is the side of a pixel in ``pixel_unit``, a UDUNITS-2 name of a length, or None if only
    ratios are known. ``origin`` is the start of the first frame in seconds, and the centre of the first pixel
    (y, x). ``provenance["trusted"]``, first frame and the one after the last, marks the trusted frames.
    ``quality`` (t,) is the residual of each frame's lines, ``error`` (t, region_y, region_x) the estimated
    error of its regions, NaN where it is unknown. The image appears whole or not at all. Raises
    UsageError for an impossible video, before anything is changed, and StoreError if the disk refuses.
    """
    if video.ndim != 3 or video.size == 0 or video.dtype.name not in DTYPES:
        raise UsageError(
            f"a video cannot be {video.dtype} {video.shape}", possible=f"(t, y, x) of {', '.join(DTYPES)}"
        )
    if time_ns.shape != video.shape[:1] or time_ns.dtype != np.int64:
        raise UsageError(
            f"time stamps cannot be {time_ns.dtype} {time_ns.shape}", possible=f"int64 ({len(video)},)"
        )
    if quality is not None and quality.shape != time_ns.shape:
        raise UsageError(f"the quality of frames cannot be {quality.shape}", possible=f"({len(video)},)")
    if error is not None and (quality is None or error.ndim != 3 or len(error) != len(video)):
        raise UsageError(
            f"the errors of frames cannot be {error.shape}{' without a quality' if quality is None else ''}",
            possible=f"({len(video)}, region_y, region_x), with a quality",
        )
    for name, value in (("pixel size", pixel_size), ("frame interval", frame_interval_ns)):
        if not (math.isfinite(value) and value > 0):
            raise UsageError(f"a video cannot have a {name} of {value}", possible="a finite number above 0")
    check_provenance(provenance)  # `finish` checks it as well, but only once the frames are written
    rows, columns = video.shape[1:]
    grid = VideoGrid((frame_interval_ns * 1e-9, pixel_size, pixel_size), origin, pixel_unit)
    regions = None if error is None else (error.shape[1], error.shape[2])
    has_quality = quality is not None
    with VideoWriter(
        place, (rows, columns), video.dtype, grid, quality=has_quality, regions=regions
    ) as writer:
        writer.append(video, time_ns, quality, error)
        writer.finish(provenance)


def open_video(place: Path | str) -> VideoFile:
    """Open a video written by `write_video`.

    Raises PlaceError if there is none, DataError if it is damaged, and StoreError if that cannot be found
    out.
    """
    import zarr
    from zarr.errors import GroupNotFoundError

    source = source_of(place)
    try:
        with refused(source, "read"):
            there = source.exists()
        if not there:
            raise PlaceError(f"{source} does not exist", hint=unexpanded(source) or _VIDEO)
        # Refuses a pipe, for which zarr would wait, and a device, which it would read for ever. PlaceError is
        # raised below, with a text about videos.
        with suppress(PlaceError):
            read_root(source)
        group = zarr.open_group(source.zarr_store(), mode="r", zarr_format=3, use_consolidated=False)
        attributes = dict(group.attrs)
        if attributes.get("format") != FORMAT:
            raise PlaceError(
                f"{source} is not a video of acquire: {format_in_words(attributes.get('format'))}",
                possible=f"{FORMAT!r}",
                hint="acquire reconstruct, which makes videos of recordings",
            )
        whole = attributes.get(EVERY_CHUNK) is True
        all_of = slice(0, child_array(group, "time").shape[0])
        time_ns = np.asarray(_read(child_array(group, "time"), all_of, whole=whole), np.int64)
        quality = None
        if "quality" in group:
            quality = _read(child_array(group, "quality"), all_of, whole=whole)
        error = child_array(group, "error") if "error" in group else None
        found = VideoFile(child_array(group, "0"), time_ns, attributes, quality, error)
        _check(found)
    except (GroupNotFoundError, NotADirectoryError) as error:
        raise PlaceError(f"{source} is not a video: it is not a Zarr group", hint=_VIDEO) from error
    except PermissionError as error:
        raise refusal(source, error, "read") from error
    except DAMAGE as error:
        raise DataError(
            f"{source} is not a video, or is damaged: {cause_in_words(error)}",
            hint="a copy of the video, or acquire reconstruct once more",
        ) from error
    return found


def _check(found: VideoFile) -> None:
    """Check everything that is read from the attributes; raise one of `DAMAGE` if it is impossible."""
    # Once, here: whoever shows or exports a video relies on its attributes.
    frames = found.video.shape[0]
    if found.video.ndim != 3 or len(found.time_ns) != frames:
        raise ValueError(f"it has {len(found.time_ns)} times for a video of {found.video.shape}")
    if not all(math.isfinite(step) and step > 0 for step in found.scale):
        raise ValueError(f"its scale is {found.scale}")
    if not all(map(math.isfinite, found.origin)):
        raise ValueError(f"its origin is {found.origin}")
    found.pixel_unit  # noqa: B018 - reads the axes
    found.trusted  # noqa: B018 - reads the provenance
    provenance = found.attrs.get("provenance") or {}
    if not isinstance(provenance.get("error") or {}, dict):
        raise TypeError("its error is not a JSON object")
    segments = provenance.get("segments") or []
    if not (isinstance(segments, list) and all(isinstance(one, dict) for one in segments)):
        raise TypeError("its segments are not a list of JSON objects")
