"""A video as OME-Zarr 0.5 metadata: pure functions that return JSON documents and numbers.

The root's consolidated metadata, which viewers use, lists the image only: some viewers take every array of a
group for part of the picture, and would stumble over the columns next to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

FORMAT = "acquire-video/1"
EVERY_CHUNK = "every_chunk_is_written"
"""Attribute of videos of which a chunk that is not there is lost; of earlier ones it may be all 0."""
LARGE = 1024
"""A level with more rows or columns than this gets another level of half the size."""
LOW, HIGH = 0.001, 0.999
"""Quantiles of the voxels that a viewer shows as black and white."""
KEPT = 2**16
"""Number of voxels of all frames that are kept to estimate the quantiles."""

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

ERROR_ATTRIBUTES: dict[str, Any] = {
    "long_name": "estimated RMS error of the voxels of a region of the frame",
    "comment": "in the unit of the video; NaN if no estimate is possible; the regions divide rows and "
    "columns equally; its uncertainty is in provenance.error; untrusted frames have a larger error",
}

TRUSTED_ATTRIBUTES: dict[str, Any] = {
    "long_name": "the lines sample the frame in full, and it was solved to its end",
}


@dataclass(frozen=True, slots=True)
class VideoGrid:
    """Grid of a video's voxels: steps along t (seconds), y and x, and the position of the first one.

    ``origin`` is the start of the first frame, and the centre of the first pixel. ``pixel_unit`` is a
    UDUNITS-2 name of a length, or None if only ratios are known.
    """

    step: tuple[float, float, float]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pixel_unit: str | None = "micrometer"

    def level(self, number: int) -> VideoGrid:
        """Return the grid of a level whose pixels are 2^number wide."""
        factor = 2**number
        (t, height, width), (begin, y, x) = self.step, self.origin
        # The centre of a larger pixel is in the middle of those that it stands for.
        origin = (begin, y + (factor - 1) * height / 2, x + (factor - 1) * width / 2)
        return VideoGrid((t, factor * height, factor * width), origin, self.pixel_unit)


def level_shapes(shape: tuple[int, int]) -> list[tuple[int, int]]:
    """Return the rows and columns of the image and of its smaller copies."""
    found = [shape]
    while max(found[-1]) > LARGE:
        rows, columns = found[-1]
        found.append((-(-rows // 2), -(-columns // 2)))
    return found


def halved(frames: NDArray[Any]) -> NDArray[Any]:
    """Return frames (t, y, x) of half the size, means of 2 x 2 pixels; an odd edge counts twice."""
    even = np.pad(frames, [(0, 0), *((0, size % 2) for size in frames.shape[1:])], mode="edge")
    count, rows, columns = even.shape
    mean = even.reshape(count, rows // 2, 2, columns // 2, 2).mean(axis=(2, 4), dtype=np.float64)
    small: NDArray[Any] = (np.rint(mean) if frames.dtype.kind == "u" else mean).astype(frames.dtype)
    return small


@dataclass(slots=True)
class DisplayRange:
    """Black and white levels for viewers, from some voxels of every range of frames."""

    low: float = math.inf
    high: float = -math.inf
    _kept: list[NDArray[Any]] = field(default_factory=list)
    _every: int = 1
    # At random, but the same for the same video: even steps would take the same columns of every row.
    _random: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def add(self, frames: NDArray[Any]) -> None:
        """Take frames into account; memory stays bounded, however many come."""
        # Voxels of tiles that were not written are NaN (`mosaic_writer`).
        finite = frames[np.isfinite(frames)] if frames.dtype.kind == "f" else frames.reshape(-1)
        if not finite.size:
            return
        self.low, self.high = min(self.low, float(finite.min())), max(self.high, float(finite.max()))
        self._kept.append(self._thinned(finite, max(self._every, finite.size // KEPT)))
        while sum(map(len, self._kept)) > 2 * KEPT:
            # Of later frames as few are taken, so that all count alike.
            self._every *= 2
            self._kept = [self._thinned(np.concatenate(self._kept), 2)]

    def _thinned(self, values: NDArray[Any], every: int) -> NDArray[Any]:
        """Return a copy of one of ``every`` values, at least one of all."""
        every = min(every, len(values))
        count = len(values) // every
        kept: NDArray[Any] = values[np.arange(count) * every + self._random.integers(0, every, count)]
        return kept

    def to_omero(self, name: str, first_frame: int) -> dict[str, Any]:
        """Return the attribute ``omero``; ``first_frame`` is shown first."""
        # A video without any finite voxel gets some window: viewers expect one.
        values = np.concatenate(self._kept) if self._kept else np.zeros(1)
        start, end = (float(each) for each in np.quantile(values, (LOW, HIGH)))
        low, high = (self.low, self.high) if self._kept else (0.0, 1.0)
        window = {
            "min": low,
            "max": high if high > low else low + 1.0,
            "start": start,
            "end": end if end > start else start + 1.0,
        }
        channel = {"label": name, "color": "FFFFFF", "active": True, "window": window}
        return {
            "channels": [channel],
            "rdefs": {"model": "greyscale", "defaultT": first_frame, "defaultZ": 0},
        }


def ome_attributes(
    name: str, grid: VideoGrid, levels: int, window: DisplayRange, first_frame: int
) -> dict[str, Any]:
    """Return the attribute ``ome``."""
    space = {"type": "space"} | ({"unit": grid.pixel_unit} if grid.pixel_unit else {})
    axes = [{"name": "t", "type": "time", "unit": "second"}, {"name": "y", **space}, {"name": "x", **space}]
    datasets = []
    for number in range(levels):
        level = grid.level(number)
        transformations = [
            {"type": "scale", "scale": list(level.step)},
            {"type": "translation", "translation": list(level.origin)},
        ]
        datasets.append({"path": str(number), "coordinateTransformations": transformations})
    multiscale = {"name": name, "axes": axes, "datasets": datasets} | ({"type": "mean"} if levels > 1 else {})
    return {"version": "0.5", "multiscales": [multiscale], "omero": window.to_omero(name, first_frame)}


def coordinate_attributes(axis: str, grid: VideoGrid) -> dict[str, Any]:
    """Return the attributes of the coordinates of an axis t, y or x."""
    if axis == "t":
        return {"long_name": "begin of the frame, since the recording's first line", "units": "s"}
    unit = {"units": grid.pixel_unit} if grid.pixel_unit else {}
    return {"long_name": "centre of the pixel", "axis": axis.upper(), **unit}


def along(axis: str, grid: VideoGrid, count: int) -> NDArray[np.float64]:
    """Return the coordinates of pixels along y or x."""
    number = "tyx".index(axis)
    return np.float64(grid.origin[number]) + grid.step[number] * np.arange(count, dtype=np.float64)


def coordinates_of(columns: Sequence[str]) -> str:
    """Return the names that xarray takes as coordinates of the image, in addition to its axes."""
    # `error` has axes of its own.
    return " ".join(name for name in columns if name not in {"t", "y", "x", "error"})
