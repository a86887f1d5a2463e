"""Small tables of a recording: one 1-D array per column, one chunk each, replaced whole at a commit.

Rows are only ever added, so a reader with an older length still reads the same rows. A table has a capacity,
in rows and in bytes of text; rows beyond it are counted in the group's attribute ``not_listed``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numcodecs.vlen import VLenUTF8

from acquire.lines import ARMS
from acquire.store import layout
from acquire.store.shape import crc32c

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from acquire.store.files import Disk, Publisher

# A table is one chunk of its whole capacity, which is written at every commit with a new row: larger ones
# would cost the disk more than the lines of a slow camera.
GAP_ROWS = 16384
EVENT_ROWS = 4096

EVENT_KINDS = ("armed", "started", "stopped", "loss", "tag_mismatch", "fault", "mark")
"""First kinds of every recording's vocabulary; others are added at their first use."""

MAX_TEXT = 500
"""Longest text of a cell; a longer one ends in an ellipsis."""

TEXT_BYTES = 2**20
"""Most bytes of all texts of a table: the end of a recording on a full disk has little more than that."""


class Vocabulary:
    """Growing list of names ↔ uint8 values; names beyond ``limit`` become the first, ``other``."""

    def __init__(self, *names: str, limit: int = 64) -> None:
        self._names = ["other", *names]
        self._limit = limit

    def value(self, name: str) -> int:
        """Return the value of ``name``, which is assigned at its first use."""
        word = "_".join(name.split()) or "other"  # CF separates the meanings by blanks
        if word not in self._names:
            if len(self._names) >= self._limit:
                return 0
            self._names.append(word)
        return self._names.index(word)

    def attributes(self) -> dict[str, Any]:
        return {"flag_values": list(range(len(self._names))), "flag_meanings": " ".join(self._names)}


@dataclass(frozen=True, slots=True)
class TableColumn:
    """One column: a Zarr data type, its attributes, and the vocabulary of a column of names."""

    name: str
    data_type: str
    attributes: dict[str, Any] = field(default_factory=dict)
    vocabulary: Vocabulary | None = None

    def describe(self) -> dict[str, Any]:
        return {**self.attributes, **(self.vocabulary.attributes() if self.vocabulary else {})}


class Table:
    """Rows in memory, and their copy on disk once published."""

    def __init__(
        self, directory: Path, dimension: str, columns: tuple[TableColumn, ...], capacity: int
    ) -> None:
        self.directory = directory
        self.capacity = capacity
        self.not_listed = 0
        self._text_bytes = 0
        self.dirty = True
        self._dimension = dimension
        self._columns = columns
        self._cells: dict[str, list[Any]] = {column.name: [] for column in columns}

    def __len__(self) -> int:
        return len(self._cells[self._columns[0].name])

    def add(self, row: Mapping[str, Any]) -> None:
        """Add one row (column name → value), or count it if it finds no room."""
        self.dirty = True
        texts = {
            column.name: _shortened(row[column.name])
            for column in self._columns
            if column.data_type == "string"
        }
        size = sum(len(text.encode()) for text in texts.values())
        if len(self) >= self.capacity or self._text_bytes + size > TEXT_BYTES:
            self.not_listed += 1
            return
        self._text_bytes += size
        for column in self._columns:
            value = texts.get(column.name, row[column.name])
            if column.vocabulary is not None:
                value = column.vocabulary.value(value)
            self._cells[column.name].append(value)

    def create(self, disk: Disk) -> None:
        for column in self._columns:
            disk.make_directory(self.directory / column.name / "c", parents=True)

    def publish(self, publisher: Publisher, *, durable: bool = False) -> None:
        """Replace chunks, then arrays' metadata, then the group's. Raises the disk's OSError.

        ``durable`` forces the chunks to the medium, but not the metadata: readers use the root's.
        """
        if not self.dirty:
            return
        for column in self._columns:
            place = self.directory / column.name
            # Without rows there is no chunk, and readers expect none.
            if len(self):
                # A Zarr chunk has one size: it is filled up to the capacity, and only the length grows.
                cells = self._cells[column.name]
                if column.data_type == "string":
                    padding = [""] * (self.capacity - len(self))
                    data = bytes(VLenUTF8().encode(np.array(cells + padding, object)))
                else:
                    whole = np.zeros(self.capacity, np.dtype(column.data_type).newbyteorder("<"))
                    whole[: len(self)] = cells
                    data = whole.tobytes()
                publisher.replace(place / "c" / "0", data + crc32c(data), durable=durable)
            publisher.replace(place / "zarr.json", layout.to_json(self._array(column)))
        publisher.replace(self.directory / "zarr.json", layout.to_json(self._group()))
        self.dirty = False

    def nodes(self) -> dict[str, layout.Document]:
        """Return the metadata of the group and its arrays, by path below the recording."""
        name = self.directory.name
        return {name: self._group()} | {f"{name}/{c.name}": self._array(c) for c in self._columns}

    def _group(self) -> layout.Document:
        attributes = {"capacity": self.capacity, "not_listed": self.not_listed}
        return layout.group_document(attributes, {c.name: self._array(c) for c in self._columns})

    def _array(self, column: TableColumn) -> layout.Document:
        serializer = layout.VLEN_UTF8 if column.data_type == "string" else layout.BYTES
        return layout.array_document(
            shape=(len(self),),
            data_type=column.data_type,
            dimensions=(self._dimension,),
            chunk_shape=(self.capacity,),
            codecs=[serializer, layout.CRC32C],
            attributes=column.describe(),
        )


def _shortened(text: str) -> str:
    return text if len(text) <= MAX_TEXT else text[: MAX_TEXT - 1] + "…"


def gap_table(path: Path) -> Table:
    """Return the table of lost lines: first line, count, cause, arm."""
    columns = (
        TableColumn("first_line", "uint64", {"long_name": "the trigger's number of the first lost line"}),
        TableColumn("count", "uint64", {"long_name": "lost lines", "units": "1"}),
        TableColumn("cause", "uint8", {"long_name": "why they were lost"}, Vocabulary()),
        TableColumn(
            "arm",
            "uint8",
            {"long_name": "arm", "flag_values": list(range(len(ARMS))), "flag_meanings": " ".join(ARMS)},
        ),
    )
    return Table(path / "gaps", "gap", columns, GAP_ROWS)


def event_table(path: Path) -> Table:
    """Return the table of events: tick, line, kind, text."""
    columns = (
        TableColumn("tick", "uint64", {"long_name": "trigger clock", "units": "1"}),
        TableColumn("line", "uint64", {"long_name": "the trigger's line number"}),
        TableColumn("kind", "uint8", {"long_name": "what happened"}, Vocabulary(*EVENT_KINDS)),
        TableColumn("text", "string", {"long_name": "details"}),
    )
    return Table(path / "events", "event", columns, EVENT_ROWS)
