"""Reader of one sharded array: a chunk is returned whole and intact, or an error states what is wrong."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from acquire.store.array_files import ArrayFiles
from acquire.store.codecs import BLOSC_HEADER, check_size, checked_size, decode, stored_size
from acquire.store.refusals import shows_damage
from acquire.store.shape import ABSENT, CRC_BYTES, PluginCodec, crc32c, index_bytes

if TYPE_CHECKING:
    from numpy.typing import NDArray

READ_ATTEMPTS = 3
"""An index may be read in the instant of its replacement; its checksum reveals that, and it is read again."""


class AbsentChunkError(LookupError):
    """The chunk is not on disk."""


class DamagedChunkError(ValueError):
    """The chunk is on disk, but its length or checksum is wrong, or it cannot be unpacked."""


class ChunkReader(ArrayFiles):
    """The chunks of one array of an arm."""

    def expect_index(self, shard: int) -> None:
        """Start fetching the index of a shard, which will be read soon. Raises OSError."""
        self._source.expect(self.shard_file(shard), 0, index_bytes(self.shape.shard_chunks))

    def expect(self, number: int, offset: int, size: int) -> None:
        """Start fetching a chunk: a disk is fastest if it knows all requests at once. Raises OSError."""
        self._source.expect(self.file(number), offset, size)

    def places(self, numbers: range) -> dict[int, tuple[int, int]]:
        """Return offset and size of those chunks that are on disk, and whose indices are intact.

        Each index is read once. Raises OSError.
        """
        found, per_shard = {}, self.shape.shard_chunks
        for shard in range(numbers.start // per_shard, -(-numbers.stop // per_shard)):
            entries, intact = self.index(shard)
            # A torn index may only be in the instant of its replacement: `entry` reads it again when it is
            # needed.
            for number in numbers if intact else ():
                offset, size = entries[number % per_shard]
                if number // per_shard == shard and size <= self.most_bytes and offset < 2**62:
                    found[number] = offset, size  # both are larger for an absent chunk
        return found

    def chunk(self, number: int, place: tuple[int, int] | None = None) -> NDArray[Any]:
        """Return all rows of one chunk, with padding; ``place`` is its offset and size, if known.

        Raises `AbsentChunkError`, `DamagedChunkError`, OSError, and UsageError if its codec is not installed.
        """
        payload = self.payload(number, *(place or self.entry(number)))
        try:
            samples = decode(payload, self.shape.codec, self.shape.chunk_bytes)
        except (ValueError, RuntimeError) as error:
            raise DamagedChunkError(str(error)) from error
        return samples.view(self.shape.dtype).reshape(self.shape.chunk_shape)

    def payload(self, number: int, offset: int, size: int) -> memoryview:
        """Return the bytes of chunk ``number`` at ``offset`` of its file, with length and checksum verified.

        Raises DamagedChunkError and OSError.
        """
        data = self._source.read_range(self.file(number), offset, size)
        if len(data) < size or size <= CRC_BYTES:
            raise DamagedChunkError(f"{size - len(data)} of {size} bytes are not there")
        payload = memoryview(data)[:-CRC_BYTES]
        # The checksum first: `check_size` believes the header.
        if crc32c(payload) != data[-CRC_BYTES:]:
            raise DamagedChunkError("the checksum is wrong")
        try:
            check_size(payload, self.shape.chunk_bytes, self.shape.codec)
        except ValueError as error:
            raise DamagedChunkError(str(error)) from error
        return payload

    def size_at(self, number: int, offset: int) -> int:
        """Return the size that a chunk at ``offset`` has by its header or checksum; 0 if there is none.

        Raises OSError if that cannot be found out now.
        """
        codec = self.shape.codec
        # What a plug-in packs has no header that is known here, but a checksum at its end.
        wanted = self.most_bytes if isinstance(codec, PluginCodec) else BLOSC_HEADER
        try:
            data = self._source.read_range(self.file(number), offset, wanted)
        except OSError as error:
            if not shows_damage(error):
                raise
            return 0
        if isinstance(codec, PluginCodec):
            return checked_size(data)
        return stored_size(data, self.shape.chunk_bytes, codec)

    def trouble(self, number: int) -> str | None:
        """Return what is wrong with a chunk, in words; None if it has the right length and checksum.

        Raises OSError if that cannot be found out now.
        """
        try:
            # Not unpacked: the checksum is of the packed bytes.
            self.payload(number, *self.entry(number))
        except (AbsentChunkError, DamagedChunkError) as error:
            return str(error)
        except OSError as error:
            if not shows_damage(error):
                raise
            return f"it cannot be read: {error.strerror or error}"
        return None

    def entry(self, number: int) -> tuple[int, int]:
        """Return offset and size of a chunk. Raises `AbsentChunkError`, or `DamagedChunkError` (index)."""
        for _ in range(READ_ATTEMPTS):
            entries, intact = self.index(number // self.shape.shard_chunks)
            if intact:
                break
        else:
            raise DamagedChunkError("the index of its file is damaged")
        offset, size = entries[number % self.shape.shard_chunks]
        if ABSENT in (offset, size):
            raise AbsentChunkError("it is not on disk")
        # Larger ones would exhaust the memory, or raise an OverflowError that no reader expects.
        if size > self.most_bytes or offset >= 2**62:
            raise DamagedChunkError("the index of its file is damaged: the chunk would be too large")
        return offset, size
