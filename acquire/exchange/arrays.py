"""NumPy files: ``.npy`` holds only the image, ``.npz`` all arrays and the facts (JSON)."""

from __future__ import annotations

import json
import zipfile
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.lib import format as npy

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from acquire.exchange.content import Array, Content


def write_npy(path: Path, content: Content, advance: Callable[[int], object]) -> None:
    """Write the image. Raises OSError from the disk."""
    with path.open("wb") as file:
        _write(file, content.image, advance)


def write_npz(path: Path, content: Content, advance: Callable[[int], object]) -> None:
    """Write all arrays by name, and ``facts`` as JSON in a text. Raises OSError from the disk."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        for array in (content.image, *content.columns, *content.beside):
            # zipfile must know of arrays beyond 2 GiB before the first byte, and does not know their sizes.
            with archive.open(f"{array.name}.npy", "w", force_zip64=True) as file:
                _write(file, array, advance)
        with archive.open("facts.npy", "w") as file:
            # A text, and not an object: NumPy reads no pickles unless it is told to.
            npy.write_array(file, np.array(json.dumps(content.facts)), allow_pickle=False)


def _write(file: IO[bytes], array: Array, advance: Callable[[int], object]) -> None:
    header: dict[str, Any] = {
        "descr": npy.dtype_to_descr(array.dtype),
        "fortran_order": False,
        "shape": array.shape,
    }
    # the oldest version, which suffices for plain types
    npy.write_array_header_1_0(file, header)
    for _, block in array.blocks():
        file.write(np.ascontiguousarray(block).data)
        advance(block.nbytes)
