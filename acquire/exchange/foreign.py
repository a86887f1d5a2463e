"""Files of lines from other programs, read in blocks: NumPy, HDF5, TIFF and raw binary.

::

    FILE ─▶ LineFile: (line, pixel), or (arm, line, pixel)    .rows(arm, start, stop) ─▶ (line, pixel)

Any problem with a file's shape or type is found when it is opened; lines are read later.
"""

from __future__ import annotations

import lzma
import math
import zlib
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib import format as npy

from acquire.errors import DataError, PlaceError, UsageError
from acquire.exchange.libraries import library
from acquire.reading import kind_of
from acquire.store.layout import DAMAGE
from acquire.store.refusals import refused
from acquire.text import shortened

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

KINDS = {
    ".npy": "NumPy",
    ".h5": "HDF5",
    ".hdf5": "HDF5",
    ".nxs": "HDF5",
    ".tif": "TIFF",
    ".tiff": "TIFF",
    ".raw": "raw",
    ".bin": "raw",
    ".dat": "raw",
}
"""Suffix → kind of file."""
TYPES = ("uint8", "uint16")
MOST_PAGE_BYTES = 2**28
"""Largest page of a compressed or scattered TIFF file; one page per arm is decompressed at a time."""
MALFORMED = (*DAMAGE, zlib.error, lzma.LZMAError)
"""Exceptions that libraries raise for damaged files; tifffile passes on those of its decompressors."""
ARCHIVE = b"PK\x03\x04"
"""First bytes of an ``.npz`` file."""


@dataclass(frozen=True, slots=True)
class Layout:
    """The layout of a file, as far as the file itself does not define it.

    Attributes
    ----------
    dtype, pixels, skip_bytes : for raw binary: sample type (``uint8``, ``<u2``, ``>u2``), pixels per line,
        and bytes before the first line
    dataset : path of the array inside an HDF5 file; None for the only one that can be lines
    columns : pixels of each line that belong to the arm, first and after the last; None for all
    """

    dtype: str | None = None
    pixels: int | None = None
    skip_bytes: int = 0
    dataset: str | None = None
    columns: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class LineFile:
    """An open file of lines. ``shape`` is (line, pixel) or (arm, line, pixel).

    ``read`` takes the arm (None for the first form), start and stop.
    """

    path: Path
    kind: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    read: Callable[[int | None, int, int], NDArray[Any]]
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def arms(self) -> int:
        """Number of arms in the file, 1 or 2."""
        return self.shape[0] if len(self.shape) == 3 else 1

    @property
    def lines(self) -> int:
        return self.shape[-2]

    @property
    def pixels(self) -> int:
        return self.shape[-1]

    def rows(self, arm: int | None, start: int, stop: int) -> NDArray[Any]:
        """Read lines ``start`` to ``stop - 1`` (line, pixel) in native byte order. Raises DataError."""
        try:
            found = np.asarray(self.read(arm, start, stop))
        except MALFORMED as error:
            raise DataError(
                f"{self.path}: lines {start} to {stop - 1} cannot be read: {error}",
                hint="a complete copy of the file, or lines before these",
            ) from error
        if found.shape != (stop - start, self.pixels):
            raise DataError(
                f"{self.path} ends before line {stop}: it was cut short",
                hint="a complete copy of the file, or fewer --lines",
            )
        return found.astype(self.dtype.newbyteorder("="), copy=False)


@contextmanager
def open_lines(path: Path, layout: Layout) -> Iterator[LineFile]:
    """Open a file of lines. Raises UsageError if it does not hold lines, PlaceError if there is no file."""
    kind = KINDS.get(path.suffix.lower())
    if layout.dtype is not None or layout.pixels is not None:
        kind = "raw"
    elif kind == "raw":
        raise UsageError(
            f"{path} is raw binary, which does not define its layout", hint="--dtype and --pixels"
        )
    elif kind is None and path.is_dir():
        recording = (path / "zarr.json").exists()
        raise UsageError(
            f"{path} is a directory, and not a file of lines",
            possible=", ".join(KINDS),
            hint="acquire info and acquire export, if it is a recording already" if recording else "",
        )
    elif kind is None:
        raise UsageError(
            f"the format of {path} cannot be taken from its name",
            possible=", ".join(KINDS),
            hint="--dtype and --pixels for raw binary",
        )
    openers = {"NumPy": _numpy, "HDF5": _hdf5, "TIFF": _tiff, "raw": _raw}
    with ExitStack() as held:
        check_file(path)
        try:
            file = openers[kind](path, layout, held)
        except MALFORMED as error:
            raise UsageError(f"{path} cannot be read as {kind}: {error}") from error
        shape = " x ".join(map(str, file.shape)) or "of a single value"
        if len(file.shape) not in {2, 3} or 0 in file.shape or file.arms not in {1, 2}:
            raise UsageError(
                f"{file.path} has the shape {shape}",
                possible="(line, pixel), or (arm, line, pixel) with two arms",
            )
        if file.dtype.newbyteorder("=").name not in TYPES:
            raise UsageError(
                f"{file.path} holds {file.dtype.name}",
                possible=", ".join(TYPES),
                hint="the camera's raw values",
            )
        yield file if layout.columns is None else _cropped(file, layout.columns)


def check_file(path: Path) -> None:
    """Raise PlaceError unless there is a regular file; a pipe would block a reader."""
    with refused(path, "read"):
        if (kind := kind_of(path.stat().st_mode)) is not None:
            raise PlaceError(f"{path} cannot be read: it is {kind}", possible="a file")


def mapped(path: Path) -> np.memmap[Any, np.dtype[Any]]:
    """Map the array of a ``.npy`` file. Raises UsageError for an archive, ValueError for other contents."""
    # np.load would open an archive, and leave the file open if that fails (for a truncated one).
    with path.open("rb") as file:
        if file.read(len(ARCHIVE)) == ARCHIVE:
            raise UsageError(f"{path} is an archive of several arrays", possible="one array in a .npy file")
    return npy.open_memmap(path, mode="r")


def _cropped(file: LineFile, columns: tuple[int, int]) -> LineFile:
    first, end = columns
    if not 0 <= first < end <= file.pixels:
        raise UsageError(
            f"{file.path} has no columns {first}:{end}", possible=f"0:{file.pixels} or a part of it"
        )

    def read(arm: int | None, start: int, stop: int) -> NDArray[Any]:
        return file.read(arm, start, stop)[:, first:end]

    shape = (*file.shape[:-1], end - first)
    return LineFile(
        path=file.path,
        kind=file.kind,
        shape=shape,
        dtype=file.dtype,
        read=read,
        facts=file.facts | {"columns": [first, end]},
    )


def _sliced(array: Any) -> Callable[[int | None, int, int], NDArray[Any]]:
    """Return a reader for the lines of an array that is read when it is sliced."""

    def read(arm: int | None, start: int, stop: int) -> NDArray[Any]:
        found: NDArray[Any] = array[start:stop] if array.ndim == 2 else array[arm or 0, start:stop]
        return found

    return read


def _plain(
    path: Path, dtype: np.dtype[Any], shape: tuple[int, ...], offset: int
) -> Callable[[int | None, int, int], NDArray[Any]]:
    """Return a reader for contiguous lines, which are not mapped, so that a shrinking file is an error."""
    line_bytes = shape[-1] * dtype.itemsize

    def read(arm: int | None, start: int, stop: int) -> NDArray[Any]:
        begin = offset + ((arm or 0) * shape[-2] + start) * line_bytes
        found = np.fromfile(path, dtype, (stop - start) * shape[-1], offset=begin)
        # Only whole lines of a file that was cut short: `LineFile.rows` then misses the others.
        return found[: len(found) // shape[-1] * shape[-1]].reshape(-1, shape[-1])

    return read


def _by_pixel(
    path: Path, dtype: np.dtype[Any], shape: tuple[int, ...], offset: int
) -> Callable[[int | None, int, int], NDArray[Any]]:
    """Return a reader as `_plain` does, for an array in Fortran order, whose first axis varies fastest."""
    *arms, lines, pixels = shape
    step = math.prod(arms)

    def read(arm: int | None, start: int, stop: int) -> NDArray[Any]:
        begins = (offset + (pixel * lines + start) * step * dtype.itemsize for pixel in range(pixels))
        count = (stop - start) * step
        columns = [np.fromfile(path, dtype, count, offset=begin)[arm or 0 :: step] for begin in begins]
        # Only the lines of which a file that was cut short has every pixel.
        whole = min(map(len, columns))
        return np.stack([column[:whole] for column in columns], axis=1)

    return read


def _numpy(path: Path, _: Layout, __: ExitStack) -> LineFile:
    array = mapped(path)
    # In Fortran order a line's pixels are scattered over the file.
    reader = _plain if array.flags.c_contiguous else _by_pixel
    read = reader(path, array.dtype, array.shape, array.offset) if array.ndim in {2, 3} else _sliced(array)
    return LineFile(path, "NumPy", array.shape, array.dtype, read)


def _hdf5(path: Path, layout: Layout, held: ExitStack) -> LineFile:
    h5py = library("h5py", "export", "an HDF5 file")
    file = held.enter_context(h5py.File(path, "r"))
    there: list[str] = []

    def visit(name: str, node: Any) -> None:
        # h5py ends the visit as soon as this returns anything.
        if isinstance(node, h5py.Dataset) and node.ndim in {2, 3} and node.dtype.name in TYPES:
            there.append(f"/{name}")

    file.visititems(visit)
    if layout.dataset is None:
        # In our own exports the flags, which are also uint16 with two axes, are next to the lines.
        found = [name for name in there if not name.endswith("/flags")]
        if len(found) != 1:
            raise UsageError(
                f"{path} has {len(found)} arrays that could be lines",
                possible=", ".join(found) or "arrays of uint8 or uint16, (line, pixel) or (arm, line, pixel)",
                hint="--dataset PATH" if found else "",
            )
    name = found[0] if layout.dataset is None else layout.dataset
    dataset = file.get(name)
    if not isinstance(dataset, h5py.Dataset):
        raise UsageError(f"{path} has no dataset {name!r}", possible=", ".join(there))
    return LineFile(
        path=path,
        kind="HDF5",
        shape=dataset.shape,
        dtype=dataset.dtype,
        read=_sliced(dataset),
        facts={"dataset": name},
    )


def _raw(path: Path, layout: Layout, _: ExitStack) -> LineFile:
    if layout.dtype is None or layout.pixels is None:
        raise UsageError(
            f"{path} is raw binary, which needs a sample type and the pixels per line",
            hint="--dtype and --pixels",
        )
    dtype, pixels, there = np.dtype(layout.dtype), layout.pixels, path.stat().st_size
    if not 0 <= layout.skip_bytes <= there:
        raise UsageError(
            f"{layout.skip_bytes} bytes cannot be skipped: {path} has {there} bytes",
            possible="0 or more, and fewer than the file has",
        )
    size, line_bytes = there - layout.skip_bytes, dtype.itemsize * pixels
    if pixels < 1 or size < line_bytes:
        raise UsageError(f"{path} has {size} bytes of pixels", possible=f"{line_bytes} bytes for every line")
    # Refused, and not cut off: with a wrong width every line is displaced against the one before.
    if size % line_bytes:
        raise UsageError(
            f"{path}: {size} bytes are not a whole number of lines of {pixels} pixels of {dtype.name}",
            possible=f"{size // line_bytes} lines, with {size % line_bytes} bytes left over",
            hint="--skip-bytes for the bytes before the first line, or another --pixels or --dtype",
        )
    shape = (size // line_bytes, pixels)
    # `str` includes the byte order, which a recording's own dtype no longer tells.
    facts = {"dtype": dtype.str, "skip_bytes": layout.skip_bytes}
    return LineFile(
        path=path,
        kind="raw",
        shape=shape,
        dtype=dtype,
        read=_plain(path, dtype, shape, layout.skip_bytes),
        facts=facts,
    )


def _tiff(path: Path, _: Layout, held: ExitStack) -> LineFile:
    """Open a TIFF file: its pages are consecutive ranges of lines, and two channels are the arms."""
    tifffile = library("tifffile", "export", "a TIFF file")
    file = held.enter_context(tifffile.TiffFile(path))
    # A file that was never completed has a header, and no image or one without pixels.
    if not file.series or not file.series[0].shape:
        raise UsageError(f"{path} is a TIFF file without an image", possible="one image of lines")
    series, *others = file.series
    # Samples of a pixel: the library calls an axis S for colours, and for what it takes for colours.
    if "S" in series.axes:
        found = " x ".join(map(str, series.shape))
        raise UsageError(
            f"{path} holds pixels of several colours ({found}, {series.axes})",
            possible="grey pixels: (line, pixel), or (arm, line, pixel) with two arms",
            hint="the camera's raw values, saved as grey or in a .npy file",
        )
    # Blocks that a program wrote one by one are several images to the library; thumbnails are no lines.
    alike = [each for each in others if (each.shape[-1], each.dtype) == (series.shape[-1], series.dtype)]
    if alike:
        shapes = ", ".join(" x ".join(map(str, each.shape)) for each in (series, *alike))
        raise UsageError(
            f"{path} holds {1 + len(alike)} images of lines, of which only the first would be read: "
            f"{shortened(shapes)}",
            possible="one image, whose pages have the same size",
            hint="the lines as one array, in a .npy file or a TIFF file of one image",
        )
    # tifffile states the type in native byte order, and the pixels are read as they are in the file.
    shape, dtype = tuple(map(int, series.shape)), np.dtype(file.byteorder + series.dtype.str[1:])
    # As channels, which is how our own export writes the arms for ImageJ and OME.
    arms = len(shape) == 3 and series.axes.startswith("C") and shape[0] == 2
    lines = shape if arms else (math.prod(shape[:-1]), shape[-1])
    if series.dataoffset is not None:  # all pixels lie in one piece, without compression
        return LineFile(path, "TIFF", lines, dtype, _plain(path, dtype, lines, series.dataoffset))
    return LineFile(path, "TIFF", lines, dtype, _pages(path, series, lines))


def _pages(path: Path, series: Any, lines: tuple[int, ...]) -> Callable[[int | None, int, int], NDArray[Any]]:
    """Return a reader for lines in pages that are compressed, or scattered over the file."""
    rows, pixels = (int(size) for size in series.pages[0].shape)
    if rows * pixels * series.dtype.itemsize > MOST_PAGE_BYTES:
        raise UsageError(
            f"{path} has compressed pages of {rows} x {pixels} pixels, which are too large",
            possible=f"up to {MOST_PAGE_BYTES} bytes in a page",
            hint="the file without compression",
        )
    # An import reads blocks of the arms in turn, so one page is kept for each arm: with a single one, every
    # block would be decompressed again.
    last: dict[int, tuple[int, NDArray[Any]]] = {}

    def page(arm: int, number: int) -> NDArray[Any]:
        if arm not in last or last[arm][0] != number:
            last.pop(arm, None)  # before the next is decompressed, to never hold two pages of an arm
            last[arm] = number, series.pages[number].asarray().reshape(rows, pixels)
        return last[arm][1]

    def read(arm: int | None, start: int, stop: int) -> NDArray[Any]:
        offset = (arm or 0) * lines[-2]
        first, end = start + offset, stop + offset
        parts = [
            page(arm or 0, number)[max(0, first - number * rows) : end - number * rows]
            for number in range(first // rows, -(-end // rows))
        ]
        return np.concatenate(parts)

    return read
