"""A reconstructed video as the content of an export."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire import __version__
from acquire.errors import UsageError
from acquire.exchange.content import Array, Axis, Block, Content, block, little
from acquire.showing import error_in_words
from acquire.store.video_layout import ERROR_ATTRIBUTES
from acquire.text import visible

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import zarr
    from numpy.typing import NDArray

    from acquire.store import VideoFile

UNITS = {"micrometer": "um", "millimeter": "mm", "meter": "m", "nanometer": "nm"}
"""UDUNITS-2 names → the abbreviations used by other programs."""


def video_content(
    video: VideoFile, title: str, frames: range | None = None, *, whole: bool = False
) -> Content:
    """Return frames of a video (None for all), of which only the trusted ones are kept unless ``whole``.

    A video that does not record which frames are trusted is exported as it is. Raises UsageError if no frame
    is left.
    """
    count = int(video.video.shape[0])
    frames = range(count) if frames is None else frames
    if not 0 <= frames.start < frames.stop <= count:
        # From a first frame beyond the end, "to the end" would run backwards.
        asked = f"frames {frames.start} to {frames.stop - 1}" if frames else f"frame {frames.start}"
        raise UsageError(
            f"{title} does not have {asked}",
            possible=f"0 to {count - 1}",
        )
    trusted = video.trusted
    kept = frames if whole or trusted is None else _common(frames, trusted)
    if not kept:
        raise UsageError(
            f"none of the frames {frames.start} to {frames.stop - 1} of {title} is trusted: its lines sample "
            "them only in part",
            possible=f"frames {trusted.start} to {trusted.stop - 1}" if trusted else "",
            hint="--all-frames, which writes and marks them",
        )
    image = Array(
        name="video",
        dims=("time", "y", "x"),
        shape=(len(kept), *video.video.shape[1:]),
        dtype=little(video.video.dtype),
        blocks=partial(_frames, video.video, kept, video.frames),
        attributes={"long_name": "reconstructed light"},
    )
    inside = kept if trusted is None else _common(kept, trusted)
    return Content(
        kind="video",
        title=visible(title),
        axes=_axes(video, kept),
        image=image,
        columns=tuple(_columns(video, kept)),
        facts=_facts(video, title, kept, None if trusted is None else inside),
        beside=_errors(video, kept),
        untrusted=len(kept) - len(inside),
    )


def _common(one: range, other: range) -> range:
    start = max(one.start, other.start)
    return range(start, max(start, min(one.stop, other.stop)))


def _unit(video: VideoFile) -> str:
    unit = video.pixel_unit
    return "pixel" if unit is None else UNITS.get(unit, unit)


def _axes(video: VideoFile, kept: range) -> tuple[Axis, ...]:
    (interval_s, height, width), (t, y, x) = video.scale, video.origin
    first_s = t + (int(video.time_ns[kept.start]) - int(video.time_ns[0])) * 1e-9
    unit = _unit(video)
    return (
        Axis("time", interval_s, first_s, "s"),
        Axis("y", height, y, unit),
        Axis("x", width, x, unit),
    )


def _facts(video: VideoFile, title: str, kept: range, inside: range | None) -> dict[str, Any]:
    """Return the facts of an export of a video.

    ``frames`` are numbers in the source, ``trusted_frames`` numbers in the file: the first, and after the
    last. ``estimated_error`` describes the error of all trusted frames of the source.
    """
    interval_s, *pixel = video.scale
    error = (video.attrs.get("provenance") or {}).get("error")
    return {
        "source": title,
        "frames": [kept.start, kept.stop],
        "frames_of_source": len(video.time_ns),
        "trusted_frames": None
        if inside is None
        else [edge - kept.start for edge in (inside.start, inside.stop)],
        "first_frame_utc_ns": int(video.time_ns[kept.start]),
        "frame_interval_s": interval_s,
        "pixel_size": pixel,
        "pixel_unit": _unit(video),
        **({"estimated_error": error_in_words(error)} if error else {}),
        "provenance": video.attrs.get("provenance"),
        "exported_by": f"acquire {__version__}",
    }


def _columns(video: VideoFile, kept: range) -> Iterator[Array]:
    yield _column("time_ns", video.time_ns[kept.start : kept.stop], "UTC, ns since 1970")
    if video.trusted is not None:
        inside = np.isin(np.arange(kept.start, kept.stop), video.trusted)
        # Not booleans, which h5py writes as an enumeration and not as numbers.
        yield _column("trusted", inside.astype(np.uint8), "1: the frame is sampled in full")
    if video.quality is not None:
        quality = video.quality[kept.start : kept.stop]
        yield _column("quality", quality, "relative RMS residual of the lines that see the frame")


def _errors(video: VideoFile, kept: range) -> tuple[Array, ...]:
    """Return the estimated error of the regions, if the video has it."""
    if video.error is None:
        return ()
    return (
        Array(
            name="error",
            dims=("time", "region_y", "region_x"),
            shape=(len(kept), *video.error.shape[1:]),
            dtype=little(video.error.dtype),
            blocks=partial(_frames, video.error, kept, video.errors),
            attributes=dict(ERROR_ATTRIBUTES),
        ),
    )


def _column(name: str, values: NDArray[Any], long_name: str) -> Array:
    """Make a column that holds one value per frame in memory."""
    piece = block((slice(0, len(values)),), values)
    return Array(
        name=name,
        dims=("time",),
        shape=values.shape,
        dtype=piece[1].dtype,
        blocks=lambda: iter([piece]),
        attributes={"long_name": long_name},
    )


def _frames(
    array: zarr.Array[Any], kept: range, read: Callable[[int, int], NDArray[Any] | None]
) -> Iterator[Block]:
    """Yield what ``read`` returns of ``array``, by whole chunks, so that none is decompressed twice."""
    size, start = int(array.chunks[0]), kept.start
    while start < kept.stop:
        stop = min(kept.stop, (start // size + 1) * size)
        values = read(start, stop)
        assert values is not None
        yield block((slice(start - kept.start, stop - kept.start),), values)
        start = stop
