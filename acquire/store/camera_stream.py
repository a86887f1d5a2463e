"""One arm of a recording, read by slices; what is not intact on disk raises instead of giving zeros."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import zarr

from acquire.errors import DataError
from acquire.store.shard import ABSENT, read_index, shard_path

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

DAMAGE = (OSError, ValueError, RuntimeError, LookupError, TypeError, AttributeError, ArithmeticError)
"""What zarr and arithmetic raise for metadata or chunks that are not what they should be."""

READ_ATTEMPTS = 3
"""A chunk's index may be met in the instant of its replacement; its checksum tells, and it is read again."""


class CameraStream:
    """One arm: arrays that are read when they are sliced; row i of each is line ``first_line + i``."""

    def __init__(self, path: Path, group: zarr.Group, first_line: int) -> None:
        self.path = path
        self.first_line = first_line
        self._group = group

    def __len__(self) -> int:
        return int(self.lines.shape[0])

    @property
    def lines(self) -> zarr.Array[Any]:
        """(line, pixel) uint8 or uint16, DN."""
        return self.array("lines")

    @property
    def line_number(self) -> NDArray[np.uint64]:
        """(line) the trigger's number of each row."""
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
        """The Zarr array ``name`` of this arm."""
        return child_array(self._group, name)

    def read(self, name: str, start: int, stop: int) -> NDArray[Any]:
        """Rows ``start .. stop - 1`` of one array; DataError when they are not intact on disk."""
        array = self.array(name)
        absent = _first_absent_row(self.path / name, array, range(start, stop))
        if absent is not None:
            raise DataError(
                f"{self.path / name}: line {self.first_line + absent} is recorded, but not on disk",
                hint="a copy of the recording: one of its files was lost or cut short",
            )
        return self._read_intact(array, name, slice(start, stop))

    def _read_intact(self, array: zarr.Array[Any], name: str, rows: slice) -> NDArray[Any]:
        for attempt in range(1, READ_ATTEMPTS + 1):
            try:
                return np.asarray(array[rows])
            except DAMAGE as error:
                if attempt == READ_ATTEMPTS:
                    lines = f"lines {self.first_line + rows.start} to {self.first_line + rows.stop - 1}"
                    raise DataError(
                        f"{self.path / name}: {lines} cannot be read: {error}",
                        hint="other lines, or a copy of the recording",
                    ) from error
        raise AssertionError


def child_group(group: zarr.Group, name: str) -> zarr.Group:
    """The group ``name`` inside ``group``; TypeError when it is something else."""
    node = group[name]
    if not isinstance(node, zarr.Group):
        raise TypeError(f"{name} is not a group")
    return node


def child_array(group: zarr.Group, name: str) -> zarr.Array[Any]:
    """The array ``name`` inside ``group``; TypeError when it is something else."""
    node = group[name]
    if not isinstance(node, zarr.Array):
        raise TypeError(f"{name} is not an array")
    return node


def _first_absent_row(directory: Path, array: zarr.Array[Any], rows: range) -> int | None:
    """The first of ``rows`` whose chunk is not in its shard: zarr itself would give zeros without a word."""
    assert array.shards is not None
    chunk_rows, shard_chunks = array.chunks[0], array.shards[0] // array.chunks[0]
    chunks = range(rows.start // chunk_rows, -(-rows.stop // chunk_rows))
    for shard in range(chunks.start // shard_chunks, -(-chunks.stop // shard_chunks)):
        index = read_index(shard_path(directory, shard, array.ndim), shard_chunks)
        here = range(max(chunks.start, shard * shard_chunks), min(chunks.stop, (shard + 1) * shard_chunks))
        for chunk in here:
            if index[chunk % shard_chunks, 0] == ABSENT:
                return max(rows.start, chunk * chunk_rows)
    return None
