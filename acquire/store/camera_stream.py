"""One arm of a recording, read by slices; rows that are not intact on disk raise and never read as zeros."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.showing import in_words
from acquire.store.array_files import COLUMNS, ArmFiles
from acquire.store.chunks import ChunkReader
from acquire.store.stored_rows import StoredRows

if TYPE_CHECKING:
    from collections.abc import Callable

    import zarr
    from numpy.typing import NDArray

    from acquire.store.layout import Document
    from acquire.store.source import Source


class CameraStream(ArmFiles):
    """One arm: arrays that are read when they are sliced; row i of each is line ``first_line + i``.

    ``documents``: metadata of its arrays by name; ``group`` opens the recording in zarr-python.
    """

    def __init__(
        self,
        source: Source,
        arm: str,
        documents: dict[str, Document],
        first_line: int,
        group: Callable[[], zarr.Group],
    ) -> None:
        self._group = group
        self._readers = {name: ChunkReader(source, f"{arm}/{name}", documents[name]) for name in COLUMNS}
        super().__init__(source, arm, self._readers, first_line)

    def __repr__(self) -> str:
        count = f"{len(self)} from {self.first_line} on"
        return in_words("CameraStream", str(self), lines=count, samples=f"{self.pixels} {self.dtype.name}")

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of a sample."""
        return self._readers["lines"].shape.dtype

    @property
    def lines(self) -> zarr.Array[Any]:
        """(line, pixel) uint8 or uint16, DN."""
        return self.array("lines")

    @property
    def line_number(self) -> NDArray[np.uint64]:
        """(line) the trigger's number of each row."""
        # Not stored: a row's number follows from its place, whatever is missing before it.
        return np.arange(self.first_line, self.first_line + len(self), dtype=np.uint64)

    @property
    def code_index(self) -> zarr.Array[Any]:
        """(line) uint64, index of the code bit of the line's first sub-step."""
        return self.array("code_index")

    @property
    def code(self) -> zarr.Array[Any]:
        """(line) uint8, the line's S code bits, first sub-step in bit 0."""
        return self.array("code")

    @property
    def tick(self) -> zarr.Array[Any]:
        """(line) uint64, the trigger's clock at which read-out begins."""
        return self.array("tick")

    @property
    def time_ns(self) -> zarr.Array[Any]:
        """(line) int64, UTC in ns since 1970 at which read-out begins."""
        return self.array("time")

    @property
    def flags(self) -> zarr.Array[Any]:
        """(line) uint16 of LineFlag."""
        return self.array("flags")

    def array(self, name: str) -> zarr.Array[Any]:
        """Return the Zarr array ``name`` of this arm."""
        # zarr reads what is not on disk as the fill value, which `read` refuses.
        return child_array(self._group(), f"{self.arm}/{name}")

    def reader(self, name: str) -> ChunkReader:
        """Return the reader of the chunks of the array ``name``."""
        return self._readers[name]

    def stretch(self, name: str, start: int, stop: int) -> StoredRows:
        """Return rows ``start .. stop - 1`` of one array, to be read."""
        return StoredRows(self._readers[name], start, stop, self.first_line)

    def read(self, name: str, start: int, stop: int) -> NDArray[Any]:
        """Read rows ``start .. stop - 1`` of one array. Raises DataError if they are not intact on disk."""
        return self.stretch(name, start, stop).read()


def child_array(group: zarr.Group, name: str) -> zarr.Array[Any]:
    """Return the array ``name`` inside ``group``. Raises TypeError if it is something else."""
    import zarr

    node = group[name]
    if not isinstance(node, zarr.Array):
        raise TypeError(f"{name} is not an array")
    return node
