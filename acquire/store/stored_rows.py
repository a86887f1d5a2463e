"""A range of rows of one array, read in steps, so that the same step of many arrays can be requested at once.

::

    expect_index ─▶ indices are being fetched ─▶ expect ─▶ chunks are being fetched ─▶ read

The first two are hints: `read` does everything that is left to do.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import DataError
from acquire.store.chunks import AbsentChunkError, DamagedChunkError
from acquire.store.refusals import refusal, shows_damage
from acquire.text import cause_in_words

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.store.chunks import ChunkReader


class StoredRows:
    """Rows ``start .. stop - 1`` of an array; row 0 is the trigger's line ``first_line``."""

    def __init__(self, reader: ChunkReader, start: int, stop: int, first_line: int) -> None:
        self._reader, self._start, self._stop, self._first_line = reader, start, stop, first_line
        size = reader.shape.chunk_rows
        self._chunks = range(start // size, -(-stop // size))
        self._places: dict[int, tuple[int, int]] = {}

    def expect_index(self) -> None:
        """Start fetching the indices of the files."""
        per_shard = self._reader.shape.shard_chunks
        for shard in range(self._chunks.start // per_shard, -(-self._chunks.stop // per_shard)):
            with suppress(OSError):  # `read` reports it
                self._reader.expect_index(shard)

    def expect(self) -> None:
        """Start fetching the chunks."""
        with suppress(OSError):  # `read` reports it
            self._places = self._reader.places(self._chunks)
            for chunk, place in self._places.items():
                self._reader.expect(chunk, *place)

    def read(self, out: NDArray[Any] | None = None, columns: slice | None = None) -> NDArray[Any]:
        """Return the rows, in ``out`` if given, and only their ``columns`` if given.

        Raises DataError if they are not intact on disk, StoreError or PlaceError if that cannot be found out.
        """
        shape = self._reader.shape
        rows = np.empty((self._stop - self._start, *shape.row_shape), shape.dtype) if out is None else out
        size = shape.chunk_rows
        for chunk in self._chunks:
            low, high = max(self._start, chunk * size), min(self._stop, (chunk + 1) * size)
            found = self._chunk(chunk)[low - chunk * size : high - chunk * size]
            rows[low - self._start : high - self._start] = found if columns is None else found[:, columns]
        return rows

    def _chunk(self, chunk: int) -> NDArray[Any]:
        try:
            return self._reader.chunk(chunk, self._places.get(chunk))
        except AbsentChunkError as error:
            absent = max(self._start, chunk * self._reader.shape.chunk_rows)
            raise DataError(
                f"{self._reader}: line {self._first_line + absent} is recorded, but not on disk",
                hint="`acquire verify` lists the lines that are left; a file was lost or cut short",
            ) from error
        except OSError as error:
            if not shows_damage(error):
                raise refusal(self._reader, error, "read") from error
            raise self._damaged(error) from error
        except DamagedChunkError as error:
            raise self._damaged(error) from error

    def _damaged(self, error: Exception) -> DataError:
        first, last = self._first_line + self._start, self._first_line + self._stop - 1
        return DataError(
            f"{self._reader}: lines {first} to {last} cannot be read: {cause_in_words(error)}",
            hint="`acquire verify` lists the intact lines, `acquire recover` masks the others",
        )
