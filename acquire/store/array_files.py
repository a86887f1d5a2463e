"""The files of a recording's arrays, as described by metadata and indices: no sample is read here."""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.store.layout import line_columns, parse_line_array
from acquire.store.shape import ABSENT, index_bytes, most_stored_bytes, shard_key, unpack_index

if TYPE_CHECKING:
    from collections.abc import Mapping

    from acquire.store.layout import Document
    from acquire.store.source import Source

# The type of the samples changes no name.
COLUMNS = tuple(column.name for column in line_columns("any"))
"""Names of an arm's arrays."""


class ArrayFiles:
    """The files of one array of an arm; ``document`` is its metadata. Raises `layout.PARSE_ERRORS`."""

    def __init__(self, source: Source, key: str, document: Document) -> None:
        self.key = key
        self.shape, self.rows = parse_line_array(document)
        self._source = source

    def __str__(self) -> str:
        return f"{self._source}/{self.key}"

    @property
    def most_bytes(self) -> int:
        """Largest possible size of a chunk in its file, however badly it was packed."""
        return most_stored_bytes(self.shape.chunk_bytes)

    @property
    def chunks(self) -> int:
        """Number of chunks that hold the rows."""
        return -(-self.rows // self.shape.chunk_rows)

    def file_bytes(self, shard: int) -> int:
        """Return the size of a shard's file; 0 if there is none. Raises OSError."""
        try:
            return self._source.size(self.shard_file(shard))
        except FileNotFoundError:
            return 0

    def index(self, shard: int) -> tuple[list[tuple[int, int]], bool]:
        """Return offset and size of a shard's chunks (ABSENT if missing), and whether the index is intact."""
        chunks = self.shape.shard_chunks
        try:
            data = self._source.read_range(self.shard_file(shard), 0, index_bytes(chunks))
        except FileNotFoundError:
            # Intact: without a file every chunk is absent for certain, which a torn index does not tell.
            return [(ABSENT, ABSENT)] * chunks, True
        return unpack_index(data, chunks)

    def file(self, chunk: int) -> str:
        """Return the key of the file that holds a chunk."""
        return self.shard_file(chunk // self.shape.shard_chunks)

    def shard_file(self, shard: int) -> str:
        """Return the key of a shard's file."""
        return f"{self.key}/{shard_key(shard, len(self.shape.chunk_shape))}"


class ArmFiles:
    """The files of one arm's arrays, by the arrays' names."""

    def __init__(self, source: Source, arm: str, files: Mapping[str, ArrayFiles], first_line: int) -> None:
        self.arm = arm
        self.first_line = first_line
        self._source = source
        self._files = files

    def __len__(self) -> int:
        return self.files("lines").rows

    def __str__(self) -> str:
        return f"{self._source}/{self.arm}"

    @property
    def data_type(self) -> str:
        """Zarr data type of a sample."""
        return self.files("lines").shape.data_type

    @property
    def pixels(self) -> int:
        """Number of samples in a line."""
        return self.files("lines").shape.row_shape[0]

    def files(self, name: str) -> ArrayFiles:
        """Return the files of the array ``name``."""
        return self._files[name]
