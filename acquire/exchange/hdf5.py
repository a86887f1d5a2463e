"""HDF5 in NeXus layout: an NXentry with one NXdata, whose default plot is the image, and its NXprocess.

::

    /entry            NXentry    default = "data"
      data            NXdata     signal = "video" | "lines"; axes and columns along them
      error           NXdata     estimated error of a video over frames and regions, if it is known
      process         NXprocess  program, version, and the facts as JSON in note/data
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire import __version__
from acquire.exchange.libraries import library

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from acquire.exchange.content import Array, Axis, Content

CHUNK_BYTES = 2**20


def write_hdf5(path: Path, content: Content, advance: Callable[[int], object]) -> None:
    """Write a NeXus file. Raises OSError from HDF5."""
    h5py = library("h5py", "export", "an HDF5 file")
    with h5py.File(path, "w") as file:
        file.attrs.update({"default": "entry", "creator": f"acquire {__version__}"})
        entry = _group(file, "entry", "NXentry", default="data")
        entry["title"] = content.title
        data = _group(entry, "data", "NXdata", signal=content.image.name)
        data.attrs["axes"] = [axis.name if axis.step else "." for axis in content.axes]
        for number, axis in enumerate(content.axes):
            if axis.step:
                _write_axis(data, axis, content.image.shape[number])
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


def _write_axis(data: Any, axis: Axis, count: int) -> None:
    """Write coordinates chunk by chunk, since there can be very many lines."""
    assert axis.step is not None
    whole = axis.step == int(axis.step) and axis.first == int(axis.first)
    dataset = data.create_dataset(axis.name, (count,), "<i8" if whole else "<f8")
    dataset.attrs["units"] = axis.unit
    size = CHUNK_BYTES // 8
    for start in range(0, count, size):
        stop = min(count, start + size)
        dataset[start:stop] = axis.first + axis.step * np.arange(start, stop)


def _write(data: Any, array: Array, advance: Callable[[int], object]) -> None:
    """Write an array in chunks of about `CHUNK_BYTES`: frames, or lines of one arm, like its blocks."""
    ahead = 1 if array.dims[0] == "arm" else 0
    row_bytes = array.dtype.itemsize * int(np.prod(array.shape[ahead + 1 :]))
    rows = min(array.shape[ahead], max(1, CHUNK_BYTES // row_bytes))
    chunks = (*(1,) * ahead, rows, *array.shape[ahead + 1 :])
    dataset = data.create_dataset(array.name, array.shape, array.dtype, chunks=chunks)
    dataset.attrs.update(array.attributes)
    for index, block in array.blocks():
        dataset[index] = block
        advance(block.nbytes)
