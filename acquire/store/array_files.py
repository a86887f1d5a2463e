"""The files of a recording's arrays, as metadata and indices tell of them: no sample is read here."""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.store.layout import line_columns, parse_line_array
from acquire.store.pages import PAGE
from acquire.store.shape import ABSENT, index_bytes, shard_key, unpack_index

if TYPE_CHECKING:
    from collections.abc import Mapping

    from acquire.store.layout import Document
    from acquire.store.source import Source

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
        """Of a chunk as it lies in its file, however badly it was packed."""
        return 2 * self.shape.chunk_bytes + PAGE

    @property
    def chunks(self) -> int:
        """Chunks that the rows are in."""
        return -(-self.rows // self.shape.chunk_rows)

    def file_bytes(self, shard: int) -> int:
        """Size of a shard's file; 0 where there is none. Raises OSError."""
        try:
            return self._source.size(self.shard_file(shard))
        except FileNotFoundError:
            return 0

    def index(self, shard: int) -> tuple[list[tuple[int, int]], bool]:
        """Offset and size of a shard's chunks, ABSENT where there is none; whether they are intact."""
        chunks = self.shape.shard_chunks
        try:
            data = self._source.read_range(self.shard_file(shard), 0, index_bytes(chunks))
        except FileNotFoundError:
            return [(ABSENT, ABSENT)] * chunks, True
        return unpack_index(data, chunks)

    def file(self, chunk: int) -> str:
        """Key of the file that has a chunk."""
        return self.shard_file(chunk // self.shape.shard_chunks)

    def shard_file(self, shard: int) -> str:
        """Key of a shard."""
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
        """Of a sample."""
        return self.files("lines").shape.data_type

    @property
    def pixels(self) -> int:
        """Samples of a line."""
        return self.files("lines").shape.row_shape[0]

    def files(self, name: str) -> ArrayFiles:
        """Those of the array ``name``."""
        return self._files[name]
