"""HDF5 in NeXus layout: an NXentry with one NXdata, whose default plot is the image, and its NXprocess.

::

    /entry            NXentry    default = "data"
      data            NXdata     signal = "video" | "lines"; axes and columns along them
      error           NXdata     estimated error of a video over frames and regions, if it is known
      process         NXprocess  program, version, and the facts as JSON in note/data
"""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire import __version__
from acquire.exchange.libraries import library
from acquire.store.files import write_all

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from typing_extensions import Buffer

    from acquire.exchange.content import Array, Content

CHUNK_BYTES = 2**20


def write_hdf5(path: Path, content: Content, advance: Callable[[int], object]) -> None:
    """Write a NeXus file. Raises OSError from the disk."""
    h5py = library("h5py", "export", "an HDF5 file")
    with path.open("r+b") as opened:
        disk = _Disk(opened.fileno())

        # the disk's error ends the export here and not when HDF5 closes the file, which would crash
        def advance_if_written(count: int) -> None:
            disk.check()
            advance(count)

        with h5py.File(disk, "w") as file:
            _write_entry(file, content, advance_if_written)
        # Closing has written, too.
        disk.check()


class _Disk:
    """The file under HDF5, which crashes the process when it closes a file that cannot be written.

    It keeps the first error for `check`, and from then on takes everything without writing it.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._at = 0
        self._error: OSError | None = None

    def check(self) -> None:
        """Raise the error of the disk, if there was one."""
        if self._error is not None:
            raise self._error

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._at}
        self._at = offset + start.get(whence, os.fstat(self._descriptor).st_size)
        return self._at

    def tell(self) -> int:
        return self._at

    def read(self, size: int) -> bytes:
        found = os.pread(self._descriptor, size, self._at)
        self._at += size
        return found.ljust(size, b"\0")  # as HDF5's own driver reads behind the end

    def write(self, data: Buffer) -> int:
        size = memoryview(data).nbytes
        self._try(lambda: write_all(self._descriptor, [data], self._at))
        self._at += size
        return size

    def truncate(self, size: int) -> int:
        self._try(lambda: os.ftruncate(self._descriptor, size))
        return size

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def _try(self, change: Callable[[], object]) -> None:
        if self._error is None:
            try:
                change()
            except OSError as error:
                self._error = error


def _write_entry(file: Any, content: Content, advance: Callable[[int], object]) -> None:
    # In NeXus a viewer finds what to plot by following these defaults from the root.
    file.attrs.update({"default": "entry", "creator": f"acquire {__version__}"})
    entry = _group(file, "entry", "NXentry", default="data")
    entry["title"] = content.title
    data = _group(entry, "data", "NXdata", signal=content.image.name)
    # In NeXus "." stands for an axis without coordinates.
    data.attrs["axes"] = [axis.name if axis.step else "." for axis in content.axes]
    for number, axis in enumerate(content.axes):
        if axis.step:
            # line numbers are integers
            whole = axis.step == int(axis.step) and axis.first == int(axis.first)
            count = content.image.shape[number]
            dataset = data.create_dataset(axis.name, (count,), "<i8" if whole else "<f8")
            dataset.attrs["units"] = axis.unit
            # Chunk by chunk, since there can be very many lines.
            for start in range(0, count, CHUNK_BYTES // 8):
                stop = min(count, start + CHUNK_BYTES // 8)
                dataset[start:stop] = axis.first + axis.step * np.arange(start, stop)
            data.attrs[f"{axis.name}_indices"] = number
    names = [axis.name for axis in content.axes]
    _write(data, content.image, advance)
    for array in content.columns:
        _write(data, array, advance)
        data.attrs[f"{array.name}_indices"] = [names.index(dim) for dim in array.dims]
    for array in content.beside:
        group = _group(entry, array.name, "NXdata", signal=array.name)
        first, *others = array.dims
        group.attrs["axes"], group.attrs[f"{first}_indices"] = [first, *("." for _ in others)], 0
        group[first] = data[first]  # the same dataset, linked
        _write(group, array, advance)
    process = _group(entry, "process", "NXprocess")
    process["program"], process["version"] = "acquire", __version__
    note = _group(process, "note", "NXnote")
    note["type"], note["data"] = "application/json", json.dumps(content.facts)


def _group(parent: Any, name: str, kind: str, **attributes: str) -> Any:
    group = parent.create_group(name)
    group.attrs.update({"NX_class": kind, **attributes})
    return group


def _write(data: Any, array: Array, advance: Callable[[int], object]) -> None:
    """Write an array in chunks of about `CHUNK_BYTES`: frames, or lines of one arm, like its blocks."""
    ahead = 1 if array.dims[0] == "arm" else 0
    row_bytes = array.dtype.itemsize * int(np.prod(array.shape[ahead + 1 :]))
    rows = min(array.shape[ahead], max(1, CHUNK_BYTES // row_bytes))
    # never both arms in a chunk: they are written one after the other
    chunks = (*(1,) * ahead, rows, *array.shape[ahead + 1 :])
    dataset = data.create_dataset(array.name, array.shape, array.dtype, chunks=chunks)
    dataset.attrs.update(array.attributes)
    for index, block in array.blocks():
        dataset[index] = block
        advance(block.nbytes)
