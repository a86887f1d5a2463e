"""Writer of one Zarr v3 array that grows along its first axis, in sharded chunks written whole.

A shard is one file; its index has one page, so a chunk is published by one small write in place::

    0          4096        next multiple of 4096 after chunk 0
    ├ index ┤  ├ chunk 0 │ crc ┤  ├ chunk 1 │ crc ┤ ...
      offset and size of every chunk (uint64, all ones: absent), crc32c of these

A chunk's bytes come first, then its index entry: an index never points at bytes that are not there, and
what is not in the index does not exist for a reader. Offsets are multiples of the page so that direct I/O
remains possible; the gaps are legal Zarr. zarr-python's own sharding codec rewrites the shard per chunk.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import google_crc32c
import numpy as np
from numcodecs import blosc

from acquire.store.files import sync_directory, write_all

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray
    from typing_extensions import Buffer

PAGE = 4096
MAX_SHARD_CHUNKS = 255
"""Chunks whose index (16 bytes each, and a checksum) fits one page."""
MAX_CHUNK_BYTES = 2**26
"""Each array holds one chunk in memory while it fills, lost if the process is killed; blosc takes 2 GiB."""

ABSENT = np.uint64(2**64 - 1)

Codec = Literal["none", "lz4", "zstd"]


@dataclass(frozen=True, slots=True)
class ArrayShape:
    """How an array is cut into pieces: rows of ``row_shape`` samples, rows per chunk, chunks per file."""

    dtype: np.dtype[Any]
    row_shape: tuple[int, ...]
    chunk_rows: int
    shard_chunks: int
    codec: Codec

    @property
    def chunk_shape(self) -> tuple[int, ...]:
        return (self.chunk_rows, *self.row_shape)

    @property
    def shard_shape(self) -> tuple[int, ...]:
        return (self.chunk_rows * self.shard_chunks, *self.row_shape)


def shard_path(directory: Path, shard: int, dimensions: int) -> Path:
    """File of shard number ``shard`` of an array with ``dimensions`` axes, cut along the first only."""
    return directory.joinpath("c", str(shard), *["0"] * (dimensions - 1))


def encode(rows: NDArray[Any], codec: Codec) -> Buffer:
    """Bytes of one chunk before its checksum; ``rows`` is C-contiguous and little-endian."""
    if codec == "none":
        return rows.data.cast("B")
    packed: bytes = blosc.compress(rows, codec.encode(), 1, blosc.BITSHUFFLE)
    return packed


def crc32c(data: Buffer) -> bytes:
    """Checksum as Zarr stores it: 4 bytes, little-endian."""
    # The library refuses memoryviews, but takes arrays.
    value: int = google_crc32c.value(np.frombuffer(memoryview(data), np.uint8))
    return value.to_bytes(4, "little")


def read_index(path: Path, chunks: int) -> NDArray[np.uint64]:
    """(chunk, 2) offsets and sizes of a shard as they stand in the file; all ABSENT when there is no file."""
    try:
        with path.open("rb") as file:
            data = file.read(16 * chunks)
    except FileNotFoundError:
        data = b""
    return np.frombuffer(data.ljust(16 * chunks, b"\xff"), "<u8").reshape(chunks, 2)


class ShardFile:
    """One shard being written, chunk after chunk. Raises OSError as the disk gives it."""

    def __init__(self, path: Path, chunks: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        self._page = bytearray(16 * chunks + 4)
        self._index = np.frombuffer(self._page, "<u8", 2 * chunks).reshape(chunks, 2)
        self._index[:] = ABSENT
        self._end = PAGE
        self.chunks = 0

    @property
    def full(self) -> bool:
        return self.chunks == len(self._index)

    def append(self, payload: Buffer) -> int:
        """Write one encoded chunk, then publish it in the index; returns its size on disk."""
        size = memoryview(payload).nbytes
        write_all(self._fd, payload, self._end)
        write_all(self._fd, crc32c(payload), self._end + size)
        self._index[self.chunks] = self._end, size + 4
        self._page[-4:] = crc32c(memoryview(self._page)[:-4])
        write_all(self._fd, self._page, 0)
        self.chunks += 1
        self._end += -(-(size + 4) // PAGE) * PAGE
        return size + 4

    def sync(self) -> None:
        """Force the file's bytes to the medium."""
        os.fdatasync(self._fd)

    def close(self) -> None:
        """Idempotent."""
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            os.close(fd)


class ArrayWriter:
    """Appends rows to one array; whole chunks go to disk at once, the rest waits in one buffer.

    The buffer is allocated once. Rows that make a whole chunk by themselves are written without a copy.
    ``durable`` forces each file to the medium before it is left for the next.
    """

    def __init__(self, directory: Path, shape: ArrayShape, *, durable: bool) -> None:
        self.directory = directory
        self.shape = shape
        self.rows = 0
        """Rows appended."""
        self.bytes_written = 0
        self._durable = durable
        self._buffer = np.empty(shape.chunk_shape, shape.dtype)
        self._buffer.fill(0)  # touch every page now, not while lines arrive
        self._filled = 0
        self._chunks = 0
        self._shard: ShardFile | None = None
        self._unsynced = False

    @property
    def whole_rows(self) -> int:
        """Rows in chunks that are on disk and in their shard's index, without what pads the last."""
        return min(self._chunks * self.shape.chunk_rows, self.rows)

    def append(self, rows: NDArray[Any]) -> None:
        """Append rows of this array's dtype and row shape, any number of them."""
        start = 0
        while start < len(rows):
            taken = self._take(rows[start:])
            start += taken
            self.rows += taken

    def pad(self) -> None:
        """Write the rows that wait as one more chunk, filled up with 0."""
        if self._filled:
            self._buffer[self._filled :] = 0
            self._flush()

    def sync(self) -> None:
        """Force what was written since the last call to the medium."""
        if self._shard is not None and self._unsynced:
            self._shard.sync()
            self._unsynced = False

    def close(self) -> None:
        """Let go of the file; rows that wait are dropped. Idempotent."""
        if self._shard is not None:
            self._shard.close()

    def _take(self, rows: NDArray[Any]) -> int:
        size = self.shape.chunk_rows
        if self._filled == 0 and len(rows) >= size and rows.flags.c_contiguous:
            self._write(rows[:size])
            return size
        count = min(size - self._filled, len(rows))
        self._buffer[self._filled : self._filled + count] = rows[:count]
        self._filled += count
        if self._filled == size:
            self._flush()
        return count

    def _flush(self) -> None:
        self._write(self._buffer)
        self._filled = 0

    def _write(self, rows: NDArray[Any]) -> None:
        shard = self._shard
        if shard is None or shard.full:
            shard = self._next_shard()
        self._unsynced = True
        self.bytes_written += shard.append(encode(rows, self.shape.codec))
        self._chunks += 1

    def _next_shard(self) -> ShardFile:
        if self._durable:
            self.sync()
        self.close()
        self._shard = None
        path = shard_path(
            self.directory, self._chunks // self.shape.shard_chunks, len(self.shape.chunk_shape)
        )
        self._shard = ShardFile(path, self.shape.shard_chunks)
        if self._durable:
            self._sync_directories(path.parent)
        return self._shard

    def _sync_directories(self, directory: Path) -> None:
        """Force the way to a new shard to the medium."""
        while directory != self.directory.parent:
            sync_directory(directory)
            directory = directory.parent
