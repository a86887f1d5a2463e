"""The user's files as scenes: pictures, videos and arrays of any size and frame rate.

Frames are decoded one at a time and only a few are kept, at the scene's size, so that an hour of video fits::

    file ─▶ frame i, as light (h, w) ─▶ square (fit) ─▶ (n, n), mean over each pixel's area ─▶ cache
    sub-step t ─▶ position t·frame_rate ─▶ the frame before (hold), or that and the next one (blend)

Pillow reads pictures and animations (PNG, TIFF, GIF, WebP …), numpy reads ``.npy``, and PyAV, if it is
installed, reads every container that FFmpeg supports.
"""

from __future__ import annotations

from collections import OrderedDict
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Literal, Protocol, Self

import numpy as np
from numpy.lib import format as npy
from pydantic import Field

from acquire.config.base import FilePath
from acquire.errors import DataError, UsageError
from acquire.sim.functions import checked_light
from acquire.sim.scene import MaskScene, SceneModel

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.sim.scene import Scene

    Light = NDArray[np.floating[Any]]

_KEPT_FRAMES = 16
_CHECKED_VALUES = 1 << 22
"""Elements of an array that are checked at a time."""
MAX_PIXELS = 1 << 26
"""Largest size of one frame, before it is resampled."""


class FrameSource(Protocol):
    """Frames of a file, in order or by number; grey values 0 to 1."""

    @property
    def frame_rate_hz(self) -> float | None: ...

    @property
    def count(self) -> int:
        """Number of frames in the file."""
        ...

    def frame(self, index: int) -> Light:
        """Return one frame: (row, column) float32."""
        ...


class VideoSceneConfig(SceneModel):
    """A user's file: a picture, a video, or an array (time, row, column) of 0 to 1 as .npy."""

    kind: Literal["video"]
    path: FilePath = Field(description="relative to the scene file")
    frame_rate_hz: float | None = Field(default=None, gt=0, description="absent: the file's own")
    fit: Literal["fill", "pad", "stretch"] = Field(
        default="fill", description="how a picture is made square: cropped, padded with black or stretched"
    )
    between: Literal["hold", "blend"] = Field(
        default="blend", description="light between two frames: the earlier one, or a mixture of both"
    )
    end: Literal["loop", "last"] = "loop"
    gamma: float = Field(default=1.0, gt=0, le=5, description="light = (pixel / white)^gamma")

    def build(self, size: int, substep_s: float) -> Scene:
        scene = VideoScene(self, size, substep_s)
        return StillScene(scene.frames(0, 1)) if scene.is_still else scene

    def anchored(self, directory: Path) -> Self:
        return self.model_copy(update={"path": (directory / self.path).resolve()})


class StillScene(MaskScene):
    """A single picture, whose optics are simulated once instead of at every sub-step."""

    def __init__(self, masks: NDArray[np.float32]) -> None:
        self.masks = masks

    def intensity(self, first: int, count: int, substep_s: float | None = None) -> NDArray[np.float64]:  # noqa: ARG002
        """Return the intensity of the picture: (1, count)."""
        return np.ones((1, count))


class VideoScene:
    """A file shown to the cameras; see the module. Raises UsageError for files that cannot be read."""

    def __init__(self, config: VideoSceneConfig, size: int, substep_s: float) -> None:
        self.size = size
        self._config = config
        self._source = open_media(config.path)
        rate_hz = config.frame_rate_hz or self._source.frame_rate_hz
        if rate_hz is None and self._source.count > 1:
            raise UsageError(
                f"{config.path} does not state its frame rate", hint="set frame_rate_hz in the scene file"
            )
        self._frames_per_substep = (rate_hz or 0.0) * substep_s
        self._kept: OrderedDict[int, Light] = OrderedDict()
        # a file that cannot be shown is refused when the scene is made, not in a camera's process
        self.frames(0, 1)

    @property
    def is_still(self) -> bool:
        """Whether the file has a single frame."""
        return self._source.count == 1

    def frames(self, first: int, count: int) -> NDArray[np.float32]:
        """(count, row, column) float32."""
        return self.frames_at(np.arange(first, first + count))

    def frames_at(self, substeps: NDArray[np.int64]) -> NDArray[np.float32]:
        """(count, row, column) float32."""
        # The middle of a sub-step stands for its mean light.
        position = (substeps + 0.5) * self._frames_per_substep
        before = np.floor(position).astype(np.int64)
        part = (position - before).astype(np.float32)
        out = np.empty((len(substeps), self.size, self.size), np.float32)
        for i, (index, after) in enumerate(zip(before.tolist(), part.tolist(), strict=True)):
            out[i] = self._resampled(index)
            if after and self._config.between == "blend":
                out[i] += after * (self._resampled(index + 1) - out[i])
        return out

    def _resampled(self, index: int) -> Light:
        """Return the file's frame for an index of any size, at the scene's size; recent ones are cached."""
        last = self._source.count - 1
        index = index % (last + 1) if self._config.end == "loop" else min(max(index, 0), last)
        if index in self._kept:
            self._kept.move_to_end(index)
            return self._kept[index]
        # before it is resampled: means are taken of light, not of grey levels
        light = np.clip(self._source.frame(index), 0, None) ** np.float32(self._config.gamma)
        self._kept[index] = resample(_square(light, self._config.fit), self.size)
        if len(self._kept) > _KEPT_FRAMES:
            self._kept.popitem(last=False)
        return self._kept[index]


def open_media(path: Path) -> FrameSource:
    """Return the frames of a file, read by the first library that can."""
    # `is_file` is False for what is not there, and raises for what may not be looked at.
    try:
        there = path.is_file()
    except PermissionError as error:
        raise UsageError(f"scene file {path} cannot be accessed: {error.strerror}") from error
    if not there:
        raise UsageError(f"scene file {path} does not exist")
    if path.suffix == ".npy":
        return _ArrayFile(path)
    from PIL import Image

    try:
        return _PictureFile(path)
    # the warning as well, which is raised where warnings are errors
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise UsageError(f"{path} cannot be read: {error}") from error
    except (OSError, SyntaxError, ValueError):
        return _open_container(path)


def read_picture(path: Path, side: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return light (premultiplied by alpha) and alpha of a file's first frame, (side, side) each."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            channels = _grey(image.convert("LA"))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise UsageError(f"picture {path} cannot be read: {error}") from error
    alpha = resample(_square(channels[..., 1], "pad"), side)
    # multiplied before it is averaged, so that what is transparent does not colour the edges
    light = resample(_square(channels[..., 0] * channels[..., 1], "pad"), side)
    return light.astype(np.float64), alpha.astype(np.float64)


def resample(picture: Light, size: int) -> Light:
    """Return a picture (h, w) as (size, size): each pixel is the mean over its area of the picture.

    The pixels of a picture smaller than ``size`` become squares.
    """
    weights = []
    for length in picture.shape:
        # (size, length): the fraction of new pixel i that old pixel j covers
        new = np.arange(size + 1) * (length / size)
        low = np.maximum(new[:-1, None], np.arange(length))
        high = np.minimum(new[1:, None], np.arange(1, length + 1))
        covered = np.clip(high - low, 0, None)
        weights.append((covered / covered.sum(axis=1, keepdims=True)).astype(np.float32))
    # Rows and columns separately: a pixel's area is the product of its two sides.
    resampled: Light = weights[0] @ picture @ weights[1].T
    return resampled


def _square(picture: Light, fit: str) -> Light:
    """Return the picture cropped ("fill") or padded ("pad") to a square, or as it is for "stretch"."""
    height, width = picture.shape
    if fit == "stretch" or height == width:
        return picture
    if fit == "fill":
        side = min(height, width)
        top, left = (height - side) // 2, (width - side) // 2
        return picture[top : top + side, left : left + side]
    side = max(height, width)
    padded = np.zeros((side, side), np.float32)
    top, left = (side - height) // 2, (side - width) // 2
    padded[top : top + height, left : left + width] = picture
    return padded


class _ArrayFile:
    """``.npy``: (time, row, column) or (row, column); integers are scaled by their type's largest value.

    Frames are read one by one and not mapped: a mapped file that is cut short would end the process.
    """

    frame_rate_hz = None

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._version = _version(path)
            # mapped for its header only: no element is looked at
            video = npy.open_memmap(path, mode="r")
        except (OSError, ValueError, EOFError) as error:
            raise UsageError(f"{path} is not an array: {error}") from error
        shape: tuple[int, ...] = (1, *video.shape) if video.ndim == 2 else video.shape
        if len(shape) != 3 or 0 in shape:
            raise UsageError(
                f"{path} is an array of shape {video.shape}", possible="(time, row, column) or (row, column)"
            )
        if video.dtype.kind not in "buif":
            raise UsageError(f"{path} is an array of {video.dtype}", possible="numbers")
        self._shape, self._dtype, self._offset = shape, video.dtype, video.offset
        # Frames of an array in Fortran order are scattered over the whole file.
        self._whole: NDArray[Any] | None = (
            None if video.flags.c_contiguous else np.load(path, allow_pickle=False).reshape(shape)
        )
        self._white = float(np.iinfo(video.dtype).max) if video.dtype.kind in "ui" else 1.0
        step = max(1, _CHECKED_VALUES // (shape[1] * shape[2]))
        for first in range(0, shape[0], step):
            part = self._read(first, min(first + step, shape[0]))
            checked_light(part, part.shape, str(path), first=first)

    @property
    def count(self) -> int:
        return self._shape[0]

    def frame(self, index: int) -> Light:
        frame: Light = self._read(index, index + 1)[0].astype(np.float32) / np.float32(self._white)
        return frame

    def _read(self, first: int, stop: int) -> NDArray[Any]:
        """Return some frames. Raises DataError for a file that has changed: its lines would be of two."""
        if self._whole is not None:
            return self._whole[first:stop]
        values = self._shape[1] * self._shape[2]
        begin = self._offset + first * values * self._dtype.itemsize
        try:
            found = np.fromfile(self._path, self._dtype, (stop - first) * values, offset=begin)
            changed = _version(self._path) != self._version
        except OSError as error:
            raise DataError(
                f"{self._path}: frame {first} cannot be read: {error}",
                hint="a copy of the file, or its disk, if that was removed; then arm again",
            ) from error
        if changed or len(found) < (stop - first) * values:
            raise DataError(f"{self._path} has changed while it was shown", hint="arm again")
        frames: NDArray[Any] = found.reshape(stop - first, *self._shape[1:])
        return frames


def _version(path: Path) -> tuple[int, int, int]:
    """Return what tells a file from one that has replaced it or was written anew."""
    # The time alone may be that of the file that it has replaced.
    found = path.stat()
    return found.st_ino, found.st_size, found.st_mtime_ns


class _PictureFile:
    """A file that Pillow reads. Its last frame is decoded at once, to refuse damaged files early.

    An animation's rate is the mean over its frames, which may have different durations.
    """

    frame_rate_hz: float | None = None

    def __init__(self, path: Path) -> None:
        from PIL import Image

        self._path = path
        with Image.open(path) as image:
            _check_size(path, image.width, image.height)
            self.count = int(getattr(image, "n_frames", 1))
            image.seek(self.count - 1)
            image.load()
            if "duration" in image.info:
                total_ms = 0.0
                for index in range(self.count):
                    image.seek(index)
                    image.load()  # some formats state a frame's duration only once it is decoded
                    total_ms += float(image.info.get("duration") or 0)
                self.frame_rate_hz = 1000 * self.count / total_ms if total_ms > 0 else None

    def frame(self, index: int) -> Light:
        from PIL import Image

        try:
            with Image.open(self._path) as image:
                image.seek(index)
                # Pillow would clip these modes to 8 bits when it converts them to "L".
                if image.mode.startswith(("I", "F")):  # 16-bit or float
                    white = 1.0 if image.mode == "F" else 65535.0
                    light = np.asarray(image, np.float32) / white
                    return checked_light(light, light.shape, str(self._path))
                return _grey(image.convert("L"))
        except (OSError, SyntaxError, ValueError, EOFError) as error:
            raise DataError(
                f"{self._path}: frame {index} cannot be read: {error}", hint="a complete copy of the file"
            ) from error


def _grey(levels: Any) -> Light:
    """Return 8-bit grey levels as light, 0 to 1."""
    grey: Light = np.asarray(levels, np.float32) / np.float32(255)
    return grey


def _check_size(path: Path, width: int, height: int) -> None:
    if not 0 < width * height <= MAX_PIXELS:
        raise UsageError(
            f"{path} has frames of {width} × {height} pixels", possible=f"1 to {MAX_PIXELS} pixels"
        )


def _open_container(path: Path) -> FrameSource:
    try:
        import av
    except ImportError as error:
        raise UsageError(
            f"{path} is not a picture that Pillow can read",
            hint="pip install 'tdi-acquire[video]' for videos",
        ) from error
    try:
        return _Container(path)
    except (av.FFmpegError, ValueError) as error:
        raise UsageError(
            f"{path} is neither a picture nor a video that can be read: {error}",
            possible="a scene file (.toml), pictures, videos and arrays (.npy)",
        ) from error


class _Container:
    """A file that FFmpeg reads, decoded forwards; a request for an earlier frame starts over."""

    def __init__(self, path: Path) -> None:
        import av

        self._path = path
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise UsageError(f"{path} holds no video")
            stream = container.streams.video[0]
            _check_size(path, stream.width, stream.height)
            rate = stream.average_rate or stream.guessed_rate
            # The frame count in a container's header is not always right; the number of packets is.
            self.count = sum(1 for packet in container.demux(stream) if packet.size)
        if not self.count:
            raise UsageError(f"{path} holds no frames")
        self.frame_rate_hz = float(Fraction(rate)) if rate else None
        self._next = 0
        self._decoded: Iterator[Light] = self._decode()
        self._latest: Light | None = None

    def frame(self, index: int) -> Light:
        import av

        # the frame that was decoded last is still there; an earlier one needs a new start
        if index < self._next - 1 or self._latest is None:
            self._next, self._decoded = 0, self._decode()
        while self._next <= index:
            try:
                latest = next(self._decoded, None)
            except av.FFmpegError as error:
                raise DataError(
                    f"{self._path}: frame {self._next} cannot be decoded: {error}",
                    hint="a complete copy of the file, or the video in another format",
                ) from error
            if latest is None and self._latest is None:
                raise UsageError(f"{self._path}: no frame can be decoded")
            # A packet need not yield a frame: the last one is then held for the missing frames at the end.
            self._latest = self._latest if latest is None else latest
            self._next += 1
        assert self._latest is not None
        return self._latest

    def _decode(self) -> Iterator[Light]:
        import av

        with av.open(str(self._path)) as container:
            for frame in container.decode(video=0):
                yield _grey(frame.to_ndarray(format="gray"))
