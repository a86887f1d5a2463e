"""One shard: a file of chunks of a Zarr v3 array, each written whole, one after the other.

The index has one page, so chunks are published by one small write in place::

    0          4096        next multiple of 4096 after chunk 0
    ├ index ┤  ├ chunk 0 │ crc ┤  ├ chunk 1 │ crc ┤ ...
      offset and size of every chunk (uint64, all ones: absent), crc32c of these

A chunk's bytes are written first, then its entry (at a commit, the entries of all new chunks at once): an
index never points at bytes that are not there, and chunks that are not in it do not exist for a reader.
Offsets are multiples of the page, for direct I/O; the gaps are legal Zarr. zarr-python's own sharding codec
would rewrite the shard for each chunk.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
from typing import TYPE_CHECKING

import numpy as np

from acquire.store.pages import PAGE, aligned_bytes, is_aligned, page_up
from acquire.store.shape import ABSENT, CRC_BYTES, crc32c, pack_index

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray
    from typing_extensions import Buffer

    from acquire.store.files import Disk

MAX_SHARD_CHUNKS = 255
"""Number of chunks whose index (16 bytes each, and a checksum) fits one page."""
MAX_CHUNK_BYTES = 2**26
"""Limit because each array holds one chunk in memory while it fills, lost if the process is killed. blosc
could take 2 GiB."""
DIRECT_BYTES = 2**16
"""Chunks of at least this size are written past the page cache; smaller ones are faster through it."""


@dataclass(frozen=True, slots=True)
class Piece:
    """Consecutive chunks of a shard: their bytes and checksums as they will be in the file.

    ``parts`` are whole pages; ``sizes`` are the bytes of each chunk, with its checksum.
    """

    parts: list[Buffer]
    sizes: list[int]


class ShardWriter:
    """One shard being written, piece after piece. Raises the disk's OSError."""

    def __init__(self, disk: Disk, path: Path, chunks: int, *, direct: bool) -> None:
        self._file = disk.create(path, direct=direct)
        self._in_pages = direct
        self._index = [(ABSENT, ABSENT)] * chunks
        try:
            # An empty index first, so that readers find a shard without chunks, and not a broken one, until
            # the first chunk is there.
            self._file.write([pack_index(self._index)], 0)
        except OSError:
            self._file.close()  # a full disk still creates the file
            raise
        self._end = PAGE
        self.chunks = 0
        """Chunks written."""
        self.published = 0
        """Chunks in the index, and so visible to readers."""

    @property
    def room(self) -> int:
        """Number of chunks that it can still take."""
        return len(self._index) - self.chunks

    @property
    def direct(self) -> bool:
        """Whether chunks bypass the page cache."""
        return self._file.direct

    def append(self, piece: Piece) -> None:
        """Write chunks, to be published later; all at once, since one large write is faster than many."""
        write = self._file.write_pages if self._in_pages else self._file.write
        write(piece.parts, self._end)
        # Only now: a piece that could not be written has no entry, and the next one takes its place.
        ends = list(accumulate(map(page_up, piece.sizes), initial=self._end))
        new = slice(self.chunks, self.chunks + len(piece.sizes))
        self._index[new] = zip(ends, piece.sizes, strict=False)  # the last end is where the next one begins
        self.chunks += len(piece.sizes)
        self._end = ends[-1]

    def publish(self) -> None:
        """Put the written chunks into the index; several at once cost as much as one."""
        # After the chunks, never before: the index must only name chunks that are in the file.
        if self.published < self.chunks:
            self._file.write([pack_index(self._index)], 0)
            self.published = self.chunks

    def sync(self) -> None:
        """Force the file's bytes to the medium."""
        self._file.sync()

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._file.close()


class Pages:
    """Memory in which unaligned data are laid out in pages; allocated once, and grown as necessary."""

    def __init__(self) -> None:
        self._memory = aligned_bytes(2 * PAGE)

    def piece(self, payloads: Sequence[NDArray[np.uint8]]) -> Piece:
        """Return encoded chunks with their checksums, each padded with 0; valid until the next call.

        Page-aligned chunks are not copied, except for their last page.
        """
        wholes = [len(payload) // PAGE * PAGE if is_aligned(payload) else 0 for payload in payloads]
        rests = [payload[whole:] for payload, whole in zip(payloads, wholes, strict=True)]
        # A quarter more, so that slightly larger pieces do not cause an allocation each time.
        size = sum(page_up(len(rest) + CRC_BYTES) for rest in rests)
        if size > len(self._memory):
            self._memory = aligned_bytes(size + size // 4)
        free = self._memory
        parts: list[Buffer] = []
        for payload, whole, rest in zip(payloads, wholes, rests, strict=True):
            end = len(rest) + CRC_BYTES
            last, free = free[: page_up(end)], free[page_up(end) :]
            last[: len(rest)] = rest
            last[len(rest) : end] = np.frombuffer(crc32c(payload.data), np.uint8)
            last[end:] = 0
            parts += [payload[:whole].data, last.data]
        return Piece(parts, [len(payload) + CRC_BYTES for payload in payloads])


def small_piece(payloads: Sequence[NDArray[np.uint8]]) -> Piece:
    """Return small encoded chunks with their checksums, each padded with 0, at the cost of a copy."""
    chunks = [payload.tobytes() + crc32c(payload.data) for payload in payloads]
    whole = b"".join(chunk.ljust(page_up(len(chunk)), b"\0") for chunk in chunks)
    return Piece([whole], [len(chunk) for chunk in chunks])
