"""Division of an array into chunks and files, its codec, and the index of a file.

Nothing here needs a library of arrays or codecs, which take half a second to load, so that
`acquire.store.outline` does not wait for them.
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any, Literal

from fastcrc import crc32

from acquire.store.pages import PAGE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np
    from typing_extensions import Buffer

OwnCodec = Literal["none", "lz4", "zstd"]
CODECS: tuple[OwnCodec, ...] = ("none", "lz4", "zstd")
CRC_BYTES = 4

ITEM_BYTES = {"uint8": 1, "uint16": 2, "uint64": 8, "int64": 8}
"""Zarr data type → bytes per sample."""

ABSENT = 2**64 - 1
"""Offset and size of a missing chunk."""


@dataclass(frozen=True, slots=True)
class PluginCodec:
    """A codec of another distribution, as the metadata of an array state it; ``str()`` is its name.

    It need not be installed here: `acquire.store.codecs` looks for it when a chunk is packed or unpacked.

    Attributes
    ----------
    name : name of the plug-in, as a rig file has it
    zarr_name, configuration : its name in Zarr, and its parameters there as JSON text
    distribution, version : where the plug-in came from when the array was created
    """

    name: str
    zarr_name: str
    configuration: str
    distribution: str
    version: str

    def __str__(self) -> str:
        return self.name

    @property
    def origin(self) -> dict[str, str]:
        """The attribute ``codec`` of an array, without which only its name in Zarr would be known."""
        return {"name": self.name, "distribution": self.distribution, "version": self.version}


Codec = OwnCodec | PluginCodec


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
        """(rows, …) of a chunk, the unit that is packed and has a checksum."""
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
        """(rows, …) of a file, the shape of a chunk in Zarr's own metadata."""
        return (self.shard_rows, *self.row_shape)


def most_stored_bytes(chunk_bytes: int) -> int:
    """Return the size, with checksum, that a chunk of ``chunk_bytes`` bytes may have in its file."""
    # blosc adds 16 bytes to what it cannot pack; twice the size leaves other codecs some room.
    return 2 * chunk_bytes + PAGE


def shard_key(shard: int, dimensions: int) -> str:
    """Return the key of shard number ``shard`` of an array with ``dimensions`` axes, cut along the first."""
    return "/".join(["c", str(shard), *["0"] * (dimensions - 1)])


def index_bytes(chunks: int) -> int:
    """Return the size of the index of ``chunks`` chunks."""
    return 16 * chunks + CRC_BYTES


def crc32c(data: Buffer, before: bytes = bytes(CRC_BYTES)) -> bytes:
    """Return the checksum as Zarr stores it: 4 bytes, little-endian.

    ``before`` is that of bytes which precede ``data``, if it is to be the checksum of both.
    """
    # Of the library that copies no buffer, releases the interpreter's lock, and loads within 2 ms.
    return crc32.iscsi(data, int.from_bytes(before, "little")).to_bytes(CRC_BYTES, "little")


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


def codec_of(codecs: Sequence[dict[str, Any]], attributes: Mapping[str, Any] | None = None) -> Codec:
    """Return the codec of a chain `bytes`, optionally `blosc` or a plug-in's codec, `crc32c`.

    ``attributes`` of the array name the plug-in. Raises ValueError for other chains.
    """
    names = [codec["name"] for codec in codecs]
    if names == ["bytes", "crc32c"]:
        return "none"
    # Level and shuffle are in the header of every chunk: for reading, the name is enough.
    if names == ["bytes", "blosc", "crc32c"]:
        for codec in CODECS:
            if codec == codecs[1]["configuration"]["cname"]:
                return codec
    origin = (attributes or {}).get("codec")
    if origin is not None and len(names) == 3 and names[::2] == ["bytes", "crc32c"]:
        name, distribution, version = (str(origin[key]) for key in ("name", "distribution", "version"))
        configuration = json.dumps(codecs[1].get("configuration", {}), sort_keys=True)
        return PluginCodec(name, str(names[1]), configuration, distribution, version)
    raise ValueError(f"the codecs {', '.join(names)} are not known")
