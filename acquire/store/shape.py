"""Division of an array into chunks and files, its codec, and the index of a file.

Nothing here needs a library of arrays or codecs, which take half a second to load, so that
`acquire.store.outline` does not wait for them.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any, Literal

from fastcrc import crc32

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from typing_extensions import Buffer

Codec = Literal["none", "lz4", "zstd"]
CODECS: tuple[Codec, ...] = ("none", "lz4", "zstd")
CRC_BYTES = 4

ITEM_BYTES = {"uint8": 1, "uint16": 2, "uint64": 8, "int64": 8}
"""Zarr data type → bytes per sample."""

ABSENT = 2**64 - 1
"""Offset and size of a missing chunk."""


@dataclass(frozen=True, slots=True)
class ArrayShape:
    """Division of an array: rows of ``row_shape`` samples, rows per chunk, chunks per file."""

    data_type: str
    row_shape: tuple[int, ...]
    chunk_rows: int
    shard_chunks: int
    codec: Codec

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of a sample on disk."""
        import numpy as np

        return np.dtype(self.data_type).newbyteorder("<")

    @property
    def chunk_shape(self) -> tuple[int, ...]:
        return (self.chunk_rows, *self.row_shape)

    @property
    def chunk_bytes(self) -> int:
        """Bytes of a chunk's samples."""
        return math.prod(self.chunk_shape) * ITEM_BYTES[self.data_type]

    @property
    def shard_rows(self) -> int:
        """Rows per file."""
        return self.chunk_rows * self.shard_chunks

    @property
    def shard_shape(self) -> tuple[int, ...]:
        return (self.shard_rows, *self.row_shape)


def shard_key(shard: int, dimensions: int) -> str:
    """Return the key of shard number ``shard`` of an array with ``dimensions`` axes, cut along the first."""
    return "/".join(["c", str(shard), *["0"] * (dimensions - 1)])


def index_bytes(chunks: int) -> int:
    """Return the size of the index of ``chunks`` chunks."""
    return 16 * chunks + CRC_BYTES


def crc32c(data: Buffer) -> bytes:
    """Return the checksum as Zarr stores it: 4 bytes, little-endian."""
    # Of the library that copies no buffer, releases the interpreter's lock, and loads within 2 ms.
    return crc32.iscsi(data).to_bytes(CRC_BYTES, "little")


def pack_index(entries: Sequence[tuple[int, int]]) -> bytes:
    """Return an index, offset and size of every chunk, as stored in the file."""
    data = struct.pack(f"<{2 * len(entries)}Q", *chain.from_iterable(entries))
    return data + crc32c(data)


def unpack_index(data: bytes, chunks: int) -> tuple[list[tuple[int, int]], bool]:
    """Return offset and size of every chunk (ABSENT if missing), and whether the checksum agrees."""
    # One that is cut short is filled up with absent chunks, and its checksum is wrong.
    page = data[: index_bytes(chunks)].ljust(index_bytes(chunks), b"\xff")
    entries, checksum = page[:-CRC_BYTES], page[-CRC_BYTES:]
    return list(struct.iter_unpack("<QQ", entries)), crc32c(entries) == checksum


def codec_of(codecs: Sequence[dict[str, Any]]) -> Codec:
    """Return the codec of a chain `bytes`, optionally `blosc`, `crc32c`. Raises ValueError for others."""
    names = [codec["name"] for codec in codecs]
    if names == ["bytes", "crc32c"]:
        return "none"
    # Level and shuffle are in the header of every chunk: for reading, the name is enough.
    if names == ["bytes", "blosc", "crc32c"]:
        for codec in CODECS:
            if codec == codecs[1]["configuration"]["cname"]:
                return codec
    raise ValueError(f"the codecs {', '.join(names)} are not known")
