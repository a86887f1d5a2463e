"""Writes an export as one file in the format of its suffix, completely or not at all."""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.errors import UsageError
from acquire.exchange.arrays import write_npy, write_npz
from acquire.exchange.hdf5 import write_hdf5
from acquire.exchange.libraries import library
from acquire.exchange.movie import check_movie, write_movie
from acquire.exchange.tiff import check_tiff, write_tiff
from acquire.store.delivery import whole_file
from acquire.store.files import check_new_path
from acquire.store.refusals import refused

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from acquire.exchange.content import Content

SUFFIXES = {
    ".ome.tif": "ome",
    ".ome.tiff": "ome",
    ".tif": "imagej",
    ".tiff": "imagej",
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".nxs": "hdf5",
    ".npy": "npy",
    ".npz": "npz",
    ".mp4": "movie",
}
"""Suffix → format; the longest suffix that matches counts."""


def format_for(path: Path) -> str:
    """Return the format of a file name, a value of `SUFFIXES`. Raises UsageError if it has none."""
    for suffix, name in SUFFIXES.items():
        # in the order of the table: .ome.tif comes before .tif, with which it ends, too
        if path.name.lower().endswith(suffix):
            return name
    raise UsageError(
        f"the format of {path} cannot be taken from its name",
        possible=".tif (ImageJ), .ome.tif, .h5 or .nxs (NeXus), .npy, .npz, .mp4",
        # pathlib has no suffix for a name that is only a dot
        hint=f"{path.with_suffix('.h5')}" if path.name.strip(".") else "",
    )


def check_export(content: Content, path: Path) -> None:
    """Raise UsageError if the content cannot be written in this format, before anything is written."""
    kind = format_for(path)
    check_new_path(path)
    if kind in {"imagej", "ome"}:
        check_tiff(content, ome=kind == "ome")
    elif kind == "hdf5":
        library("h5py", "export", "an HDF5 file")
    elif kind == "movie":
        check_movie(content)


def left_out(content: Content, path: Path) -> tuple[str, ...]:
    """Return the names of the accompanying arrays that a file of this format cannot hold."""
    return (
        tuple(each.name for each in content.beside) if format_for(path) in {"imagej", "npy", "movie"} else ()
    )


def export(
    content: Content,
    path: Path,
    progress: Callable[[float, float], object] | None = None,
    *,
    fps: float = 25.0,
    peak: float | None = None,
) -> int:
    """Write ``content`` in the format of ``path``'s name; return the size of the file in bytes.

    ``fps`` and ``peak`` (white) apply to movies. ``progress`` takes (bytes done, total). Raises UsageError as
    `check_export`, DataError for data that cannot be read, and StoreError for errors of the disk; no file is
    left then.
    """
    check_export(content, path)
    kind, done = format_for(path), 0
    # Otherwise the progress of formats without these arrays would never be complete.
    written = () if left_out(content, path) else content.beside
    total = sum(array.bytes for array in (content.image, *written))

    def advance(count: int) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress(min(done, total), total)

    with whole_file(path) as part, refused(path, "written"):
        if kind in {"imagej", "ome"}:
            write_tiff(part, content, advance, ome=kind == "ome")
        elif kind == "hdf5":
            write_hdf5(part, content, advance)
        elif kind == "movie":
            write_movie(part, content, advance, fps, peak)
        elif kind == "npy":
            write_npy(part, content, advance)
        else:
            write_npz(part, content, advance)
    return path.stat().st_size
