"""Reconstructed videos as OME-Zarr 0.5 images, which viewers open without us.

::

    NAME.zarr/   attributes: ome (axes t, y, x with units, scale), provenance
      0          (t, y, x)
      time       (t) int64, UTC of each frame
"""

from __future__ import annotations

import json
import math
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec

from acquire.errors import DataError, UsageError
from acquire.store.camera_stream import DAMAGE, child_array
from acquire.store.files import DISK, check_new_path
from acquire.store.layout import group_document, to_json

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

FORMAT = "acquire-video/1"
CHUNK_BYTES = 4 * 2**20
DTYPES = ("uint8", "uint16", "float32")

TIME_ATTRIBUTES: dict[str, Any] = {
    "standard_name": "time",
    "long_name": "UTC at which the frame begins",
    "units": "nanoseconds since 1970-01-01T00:00:00",
    "calendar": "proleptic_gregorian",
}


@dataclass(frozen=True, slots=True, eq=False)
class VideoFile:
    """A video on disk: ``video`` (t, y, x) is read when it is sliced, ``time_ns`` (t,) int64 UTC."""

    video: zarr.Array[Any]
    time_ns: NDArray[np.int64]
    attrs: dict[str, Any]


def write_video(
    path: Path,
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
    anything is touched; DataError when the disk refuses.
    """
    check_new_path(path)
    _check(video, time_ns, pixel_size, frame_interval_ns, provenance)
    attributes = {
        "format": FORMAT,
        "ome": _ome(path.stem, (frame_interval_ns * 1e-9, pixel_size, pixel_size), pixel_unit),
        "provenance": dict(provenance),
    }
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        _write(partial, video, time_ns, attributes)
        check_new_path(path)
        partial.rename(path)
        DISK.sync_directory(path.parent)
    except OSError as error:
        raise DataError(f"{path} cannot be written: {error.strerror}", hint="another disk") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def open_video(path: Path | str) -> VideoFile:
    """Open a video that `write_video` wrote. Raises DataError when ``path`` is not one, or is damaged."""
    path = Path(path)
    if not path.exists():
        raise DataError(f"{path} does not exist", hint="the path of a video (a directory NAME.zarr)")
    try:
        group = zarr.open_group(path, mode="r", zarr_format=3)
        attributes = dict(group.attrs)
        if attributes.get("format") != FORMAT:
            raise DataError(f"{path} is not a video of ours: format {attributes.get('format')!r}")
        time_ns = np.asarray(child_array(group, "time")[:], np.int64)
        return VideoFile(child_array(group, "0"), time_ns, attributes)
    except DAMAGE as error:
        raise DataError(f"{path} is not a video, or is damaged: {error}") from error


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


def _write(path: Path, video: NDArray[Any], time_ns: NDArray[np.int64], attributes: dict[str, Any]) -> None:
    group = zarr.create_group(path, zarr_format=3)
    frames = max(1, CHUNK_BYTES // video[0].nbytes)
    image = group.create_array(
        "0",
        shape=video.shape,
        dtype=video.dtype,
        chunks=(min(frames, len(video)), *video.shape[1:]),
        compressors=[BloscCodec(cname="zstd", clevel=3, shuffle="bitshuffle"), Crc32cCodec()],
        dimension_names=("t", "y", "x"),
    )
    image[:] = video
    time = group.create_array(
        "time",
        shape=time_ns.shape,
        dtype="int64",
        chunks=time_ns.shape,
        compressors=[Crc32cCodec()],
        dimension_names=("t",),
        attributes=TIME_ATTRIBUTES,
    )
    time[:] = time_ns
    # Consolidated by hand: zarr-python warns of its own, and xarray warns where there is none.
    nodes = {name: json.loads((path / name / "zarr.json").read_bytes()) for name in ("0", "time")}
    (path / "zarr.json").write_bytes(to_json(group_document(attributes, nodes)))
    DISK.sync_tree(path)
