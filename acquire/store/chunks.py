"""Reader of one sharded array: a chunk is given whole and intact, or it is said what is wrong with it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.store.codecs import BLOSC_HEADER, CRC_BYTES, check_size, crc32c, decode, stored_size
from acquire.store.layout import parse_line_array
from acquire.store.pages import PAGE
from acquire.store.shard import ABSENT, index_bytes, shard_key, unpack_index

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.store.layout import Document
    from acquire.store.source import Source

READ_ATTEMPTS = 3
"""An index may be met in the instant of its replacement; its checksum tells, and it is read again."""


class AbsentChunkError(LookupError):
    """The chunk is not on disk."""


class DamagedChunkError(ValueError):
    """The chunk is on disk, but its length or checksum is wrong, or it cannot be unpacked."""


class ChunkReader:
    """The chunks of one array of an arm; ``document`` is its metadata. Raises `layout.PARSE_ERRORS`."""

    def __init__(self, source: Source, key: str, document: Document) -> None:
        self.key = key
        self.shape, self.rows = parse_line_array(document)
        self._source = source

    def __str__(self) -> str:
        return f"{self._source}/{self.key}"

    def expect_index(self, shard: int) -> None:
        """The index of a shard will be read soon: it is fetched meanwhile. Raises OSError."""
        self._source.expect(self.shard_file(shard), 0, index_bytes(self.shape.shard_chunks))

    def expect(self, number: int, offset: int, size: int) -> None:
        """The same of a chunk itself: a disk does best when it knows all that is wanted at once."""
        self._source.expect(self.file(number), offset, size)

    def places(self, numbers: range) -> dict[int, tuple[int, int]]:
        """Offset and size of these chunks, as far as they are on disk and their indices intact.

        Each index is read once. Raises OSError.
        """
        found, per_shard = {}, self.shape.shard_chunks
        for shard in range(numbers.start // per_shard, -(-numbers.stop // per_shard)):
            entries, intact = self.index(shard)
            for number in numbers if intact else ():
                offset, size = entries[number % per_shard].tolist()
                if number // per_shard == shard and size <= self.most_bytes and offset < 2**62:
                    found[number] = offset, size  # of what is absent, both are larger
        return found

    @property
    def most_bytes(self) -> int:
        """Of a chunk as it lies in its file, however badly it was packed."""
        return 2 * self.shape.chunk_bytes + PAGE

    @property
    def chunks(self) -> int:
        """Chunks that the rows are in."""
        return -(-self.rows // self.shape.chunk_rows)

    def chunk(self, number: int, place: tuple[int, int] | None = None) -> NDArray[Any]:
        """All rows of one chunk, with what pads it; ``place`` is its offset and size, if known.

        Raises `AbsentChunkError`, `DamagedChunkError`, OSError.
        """
        payload = self.payload(number, *(place or self.entry(number)))
        try:
            samples = decode(payload, self.shape.codec)
        except (ValueError, RuntimeError) as error:
            raise DamagedChunkError(str(error)) from error
        return samples.view(self.shape.dtype).reshape(self.shape.chunk_shape)

    def payload(self, number: int, offset: int, size: int) -> memoryview:
        """Bytes of chunk ``number`` at ``offset`` of its file; their length and checksum are right."""
        data = self._source.read_range(self.file(number), offset, size)
        if len(data) < size or size <= CRC_BYTES:
            raise DamagedChunkError(f"{size - len(data)} of {size} bytes are not there")
        payload = memoryview(data)[:-CRC_BYTES]
        if crc32c(payload) != data[-CRC_BYTES:]:
            raise DamagedChunkError("the checksum is wrong")
        try:
            check_size(payload, self.shape.chunk_bytes, self.shape.codec)
        except ValueError as error:
            raise DamagedChunkError(str(error)) from error
        return payload

    def size_at(self, number: int, offset: int) -> int:
        """Size that a chunk at ``offset`` would have by its own account; 0 where there cannot be one."""
        try:
            header = self._source.read_range(self.file(number), offset, BLOSC_HEADER)
        except OSError:
            return 0
        return stored_size(header, self.shape.chunk_bytes, self.shape.codec)

    def trouble(self, number: int) -> str | None:
        """What is wrong with a chunk, in words; None: it is there, of the right length and checksum."""
        try:
            self.payload(number, *self.entry(number))
        except (AbsentChunkError, DamagedChunkError) as error:
            return str(error)
        except OSError as error:
            return f"it cannot be read: {error.strerror or error}"
        return None

    def entry(self, number: int) -> tuple[int, int]:
        """Offset and size of a chunk. Raises `AbsentChunkError`; `DamagedChunkError` for a broken index."""
        for _ in range(READ_ATTEMPTS):
            entries, intact = self.index(number // self.shape.shard_chunks)
            if intact:
                break
        else:
            raise DamagedChunkError("the index of its file is damaged")
        offset, size = entries[number % self.shape.shard_chunks]
        if ABSENT in (offset, size):
            raise AbsentChunkError("it is not on disk")
        if int(size) > self.most_bytes or int(offset) >= 2**62:
            raise DamagedChunkError("the index of its file is damaged: the chunk would be too large")
        return int(offset), int(size)

    def file_bytes(self, shard: int) -> int:
        """Size of a shard's file; 0 where there is none. Raises OSError."""
        try:
            return self._source.size(self.shard_file(shard))
        except FileNotFoundError:
            return 0

    def index(self, shard: int) -> tuple[NDArray[np.uint64], bool]:
        """(chunk, 2) offsets and sizes of a shard, ABSENT where there is none; whether they are intact."""
        chunks = self.shape.shard_chunks
        try:
            data = self._source.read_range(self.shard_file(shard), 0, index_bytes(chunks))
        except FileNotFoundError:
            return np.full((chunks, 2), ABSENT, np.uint64), True
        return unpack_index(data, chunks)

    def file(self, chunk: int) -> str:
        """Key of the file that has a chunk."""
        return self.shard_file(chunk // self.shape.shard_chunks)

    def shard_file(self, shard: int) -> str:
        """Key of a shard."""
        return f"{self.key}/{shard_key(shard, len(self.shape.chunk_shape))}"
