"""The growing arrays of one arm; row i of each is the same line."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from acquire.errors import DataError
from acquire.store import layout
from acquire.store.array_writer import ArrayWriter

if TYPE_CHECKING:
    from collections.abc import Mapping
    from concurrent.futures import ThreadPoolExecutor
    from pathlib import Path

    from acquire.lines import TaggedBlock
    from acquire.store.codecs import EncodeOnce
    from acquire.store.files import Disk, Publisher
    from acquire.store.spec import RecordingSpec


class ArmWriter:
    """The arrays of one arm; all of them get the same rows."""

    def __init__(
        self,
        directory: Path,
        spec: RecordingSpec,
        disk: Disk,
        pool: ThreadPoolExecutor | None,
        once: Mapping[str, EncodeOnce],
    ) -> None:
        self.directory = directory
        self._first_line = spec.first_line
        self._disk = disk
        self._arrays = {
            column: ArrayWriter(
                directory / column.name,
                layout.column_shape(column, spec),
                durable=spec.fsync == "commit",
                padding=column.fill,
                disk=disk,
                # Tags are packed in the caller's thread: `EncodeOnce`, which both arms share, is for one.
                pool=pool if column.name == "lines" else None,
                once=once.get(column.name),
            )
            for column in layout.line_columns(spec.dtype)
        }
        self.pixels = next(iter(self._arrays.values()))
        """The array whose rows can be lent: tags are always packed, and so copied, in the caller's thread."""

    @property
    def next_line(self) -> int:
        """The trigger's number of the line that the next block has to begin with."""
        return self._first_line + self.pixels.rows  # the last array to be appended to: see `append`

    @property
    def written_rows(self) -> int:
        """Rows on disk in every array, in whole chunks."""
        return min(array.written_rows for array in self._arrays.values())

    @property
    def whole_rows(self) -> int:
        """Rows that are also in the indices of all their shards."""
        return min(array.whole_rows for array in self._arrays.values())

    @property
    def bytes_written(self) -> int:
        """Bytes of chunks and checksums of all arrays, without indices and metadata."""
        return sum(array.bytes_written for array in self._arrays.values())

    @property
    def direct(self) -> bool:
        """Whether lines are written past the page cache."""
        return any(array.direct for array in self._arrays.values())

    def create(self) -> None:
        """Create the arrays' directories, which appending never does: a removed one must be noticed."""
        for array in self._arrays.values():
            self._disk.make_directory(array.directory, parents=True)

    def begin(self, first_line: int) -> None:
        """Set the line of row 0; before the first `append`."""
        self._first_line = first_line

    def append(self, block: TaggedBlock, behind: ThreadPoolExecutor | None) -> None:
        """Append the block. With ``behind``, a thread that writes, it is lent until `pixels` give it back."""
        # All is checked before any array takes a row: the arrays of an arm have the same rows.
        if block.first_line != self.next_line:
            raise DataError(
                f"arm {block.arm}: the next block cannot begin at line {block.first_line}",
                possible=f"line {self.next_line}, the next; a lost line keeps its row, flagged as missing",
            )
        for column, array in self._arrays.items():
            rows = column.of(block)
            expected = (len(block), *array.shape.row_shape)
            if rows.shape != expected or rows.dtype != array.shape.dtype:
                raise DataError(
                    f"arm {block.arm}: {column.source} of a block is {rows.dtype} {rows.shape}",
                    possible=f"{array.shape.dtype} {expected}",
                )
        for column, array in reversed(self._arrays.items()):  # pixels last: rows that they have, all have
            array.append(column.of(block), behind)

    def pad(self) -> None:
        """Write the last, incomplete chunk of every array, filled up with its padding."""
        for array in self._arrays.values():
            array.pad()

    def settle(self) -> None:
        """Wait for the chunks being encoded, write them, and put all written chunks into the indices."""
        for array in self._arrays.values():
            array.settle()

    def publish_chunks(self) -> None:
        """Put the written chunks into the indices, as far as the disk allows."""
        # Each on its own: an array that the disk refuses must not keep the chunks of the others from being
        # found.
        for array in self._arrays.values():
            with contextlib.suppress(OSError):
                array.finish()  # a write that has failed leaves nothing to wait for in `publish`
            with contextlib.suppress(OSError):
                array.publish()

    def sync(self) -> None:
        """Force all chunks written since the last call to the medium."""
        for array in self._arrays.values():
            array.sync()

    def close(self) -> None:
        """Close the files of all arrays, even if closing one fails. Idempotent."""
        with contextlib.ExitStack() as closing:  # one that fails does not keep the others open
            for array in self._arrays.values():
                closing.callback(array.close)

    def publish(self, publisher: Publisher, rows: int, *, own: bool) -> dict[str, layout.Document]:
        """Return the metadata of ``rows`` rows, by path below the recording.

        ``own``: also replace the metadata files in the arm's directory.
        """
        documents = {
            column.name: layout.line_array(column, array.shape, rows)
            for column, array in self._arrays.items()
        }
        arm = self.directory.name
        group = layout.group_document({"arm": arm, "first_line": self._first_line}, documents)
        # The arrays' own files before the group's, in the order of the whole recording (`writer`).
        for name, document in (documents | {"": group}).items() if own else ():
            publisher.replace(self.directory / name / "zarr.json", layout.to_json(document))
        return {arm: group} | {f"{arm}/{name}": document for name, document in documents.items()}
