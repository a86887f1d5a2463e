"""Writer of one Zarr v3 array that grows along its first axis, in sharded chunks written whole.

::

    append ─▶ buffer of one chunk ─full─▶ encode (in a thread of the pool) ─in order─▶ shard ─▶ disk
       └───── whole chunks ───────────▲─────────────────────────────────────────────▲
"""

from __future__ import annotations

from collections import deque
from concurrent.futures import wait
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.store.codecs import EncodeOnce, encode
from acquire.store.files import DISK
from acquire.store.pages import aligned_bytes
from acquire.store.shape import shard_key
from acquire.store.shard import DIRECT_BYTES, Pages, ShardWriter, small_piece

if TYPE_CHECKING:
    from collections.abc import Sequence
    from concurrent.futures import Future, ThreadPoolExecutor
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.store.files import Disk
    from acquire.store.shape import ArrayShape
    from acquire.store.shard import Piece

# Each costs a chunk of memory, and its lines if the process is killed (`spec.durability`).
ENCODED_AHEAD = 4
"""Number of chunks of an array that may be encoded while others are filled and written."""


class ArrayWriter:
    """Appends rows to one array; whole chunks go to disk at once, the rest waits in one buffer.

    Buffers are allocated once. Rows that form whole chunks are written without a copy, in one piece. With a
    ``pool`` they are encoded there while others are written, always in order: in place if they are lent,
    otherwise copied into up to ``ahead`` buffers. ``once`` is shared by arrays of equal rows. ``durable``
    forces each file to the medium before the next one is begun. The last chunk is filled up with ``padding``.
    """

    def __init__(
        self,
        directory: Path,
        shape: ArrayShape,
        *,
        durable: bool,
        padding: int = 0,
        disk: Disk = DISK,
        pool: ThreadPoolExecutor | None = None,
        ahead: int = ENCODED_AHEAD,
        once: EncodeOnce | None = None,
    ) -> None:
        self.directory = directory
        self.shape = shape
        self.rows = 0
        """Rows appended."""
        self.bytes_written = 0
        self._durable = durable
        self._padding = padding
        self._disk = disk
        self._pool = pool
        self._is_large = shape.chunk_bytes >= DIRECT_BYTES
        self._behind: ThreadPoolExecutor | None = None
        self._once = once
        # One is filled, and the others wait for an encoder or for their turn.
        self._free: deque[NDArray[Any]] = deque(_buffer(shape) for _ in range(1 + ahead if pool else 1))
        self._buffer = self._free.popleft()
        self._filled = 0
        self._encoding: deque[tuple[Future[NDArray[np.uint8]], NDArray[Any] | None]] = deque()
        """Chunks being encoded, in order, each with its buffer, or None if its rows are lent."""
        self._writing: tuple[Future[None], Piece] | None = None
        self._chunks = 0
        self._published = 0
        self._shard: ShardWriter | None = None
        self._pages = Pages()
        self._unsynced = False

    @property
    def written_rows(self) -> int:
        """Rows in chunks that are on disk, without padding."""
        return min(self._chunks * self.shape.chunk_rows, self.rows)

    @property
    def whole_rows(self) -> int:
        """Rows in chunks that are on disk and in their shard's index, without padding."""
        return min(self._published * self.shape.chunk_rows, self.rows)

    @property
    def direct(self) -> bool:
        """Whether chunks are written past the page cache."""
        return self._shard is not None and self._shard.direct

    def append(self, rows: NDArray[Any], behind: ThreadPoolExecutor | None = None) -> None:
        """Append rows of this array's dtype and row shape, any number of them.

        With ``behind``, a thread, they are lent until `give_back`: large chunks may still be on their way to
        disk, or being encoded.
        """
        # Small chunks are copied into a piece of their own (`small_piece`), and need not be lent.
        self._behind = behind if self._is_large else None
        start = 0
        while start < len(rows):
            taken = self._take(rows[start:])
            start += taken
            self.rows += taken

    def give_back(self) -> None:
        """Wait until the rows of the last `append` are written or encoded, and may be reused."""
        # Without a pool the piece on its way may be the lent rows themselves; with one it is a packed copy,
        # and the rows are needed only until they are packed.
        if self._pool is None:
            self.finish()
        wait([payload for payload, buffer in self._encoding if buffer is None])

    def finish(self) -> None:
        """Wait for the piece that is on its way to the disk. Raises the disk's OSError."""
        if self._writing is not None:
            (written, piece), self._writing = self._writing, None
            written.result()
            self._count(piece)  # not before the result: a piece that failed must not count as written

    def pad(self) -> None:
        """Write the rows that wait as one more chunk, filled up with ``padding``."""
        if self._filled:
            self._buffer[self._filled :] = self._padding
            self._flush()
        self.settle()

    def settle(self) -> None:
        """Wait for the chunks that are being encoded, write them, and publish all of them."""
        self._write_encoded()
        self.publish()

    def publish(self) -> None:
        """Put the written chunks into the index of their shard."""
        self.finish()
        if self._shard is not None:
            self._shard.publish()
            self._published = self._chunks

    def sync(self) -> None:
        """Force everything written since the last call to the medium."""
        if self._shard is not None and self._unsynced:
            self._shard.sync()
            self._unsynced = False

    def close(self) -> None:
        """Close the file; rows that wait are dropped. No piece may be on its way. Idempotent."""
        if self._shard is not None:
            self._shard.close()

    def _take(self, rows: NDArray[Any]) -> int:
        size = self.shape.chunk_rows
        if self._pool is None and self._filled == 0:
            self.finish()  # the piece on its way may be in the buffer
        # Codecs and disk read memory as it lies: rows that are not contiguous go through the buffer.
        if self._filled == 0 and len(rows) >= size and rows.flags.c_contiguous:
            whole = len(rows) // size
            if self._pool is None:
                # A piece is one write to one file, and ends with it.
                whole = min(whole, self._with_room().room)
                self._write(
                    [self._encode(rows[k * size : (k + 1) * size], self._chunks + k) for k in range(whole)]
                )
                return whole * size
            if self._behind is not None:  # then the rows are lent, and can be encoded in place
                self._write_encoded()
                for k in range(whole):
                    chunk = rows[k * size : (k + 1) * size]
                    self._encoding.append((self._pool.submit(encode, chunk, self.shape.codec), None))
                return whole * size
        count = min(size - self._filled, len(rows))
        self._buffer[self._filled : self._filled + count] = rows[:count]
        self._filled += count
        if self._filled == size:
            self._flush()
        return count

    def _flush(self) -> None:
        self._filled = 0
        if self._pool is None:
            self._write([self._encode(self._buffer, self._chunks)])
            return
        self._encoding.append((self._pool.submit(encode, self._buffer, self.shape.codec), self._buffer))
        # All buffers wait for the encoders: lines come faster than they are packed, and memory is bounded.
        while not self._free:
            self._write([self._encoded()])
        self._buffer = self._free.popleft()

    def _encode(self, rows: NDArray[Any], chunk: int) -> NDArray[np.uint8]:
        if self._once is None:
            return encode(rows, self.shape.codec)
        return self._once(chunk, rows, self.shape.codec)

    def _write_encoded(self) -> None:
        """Wait for all chunks being encoded, and write them in as few pieces as possible."""
        while self._encoding:
            self.finish()  # a shard that the disk's thread still writes to has not counted its chunks yet
            count = min(self._with_room().room, len(self._encoding))
            self._write([self._encoded() for _ in range(count)])

    def _encoded(self) -> NDArray[np.uint8]:
        """Wait for the oldest chunk being encoded, and return it."""
        payload, buffer = self._encoding.popleft()
        if buffer is not None:
            self._free.append(buffer)  # only this thread takes it again, after the result below
        return payload.result()

    def _write(self, payloads: Sequence[NDArray[np.uint8]]) -> None:
        self.finish()  # `_pages` holds parts of the piece on its way, and is about to be reused
        shard = self._with_room()
        piece = self._pages.piece(payloads) if self._is_large else small_piece(payloads)
        self._unsynced = True
        if self._behind is not None:
            self._writing = self._behind.submit(shard.append, piece), piece
        else:
            shard.append(piece)
            self._count(piece)

    def _count(self, piece: Piece) -> None:
        self._chunks += len(piece.sizes)
        self.bytes_written += sum(piece.sizes)

    def _with_room(self) -> ShardWriter:
        """Return the shard being written, or the next one if it is full."""
        if self._shard is not None and self._shard.room:
            return self._shard
        # A full file is settled before it is left: `publish` and `sync` reach only the current one.
        self.publish()
        if self._durable:
            self.sync()
        self.close()
        self._shard = None  # the next one may fail to be created, and this one must not be used again
        key = shard_key(self._chunks // self.shape.shard_chunks, len(self.shape.chunk_shape))
        path = self.directory / key
        self.directory.stat()  # raises if the directory was removed: it must not be created again
        self._disk.make_directory(path.parent, parents=True)
        self._shard = ShardWriter(self._disk, path, self.shape.shard_chunks, direct=self._is_large)
        # A file whose bytes are on the medium may still have no name there: force each directory above it.
        directory = path.parent
        while self._durable and directory != self.directory.parent:
            self._disk.sync_directory(directory)
            directory = directory.parent
        return self._shard


def _buffer(shape: ArrayShape) -> NDArray[Any]:
    """Return a chunk in page-aligned memory."""
    samples = aligned_bytes(shape.chunk_bytes)[: shape.chunk_bytes]
    return samples.view(shape.dtype).reshape(shape.chunk_shape)
