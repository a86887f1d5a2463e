"""Reader of a recording's small tables: events and lost lines."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from acquire.errors import DataError
from acquire.store.layout import PARSE_ERRORS
from acquire.store.refusals import refusal, shows_damage
from acquire.store.shape import CRC_BYTES, crc32c
from acquire.text import cause_in_words

if TYPE_CHECKING:
    from acquire.store.layout import Document
    from acquire.store.source import Source


NUMBERS = {"uint8": "B", "uint64": "Q"}
"""Data type of cells → format character of `struct`."""
MOST_ROWS = 2**20
"""Limit on what a root may claim: far above the capacity of a table."""


TEXT_LOST = "(its text is lost)"
"""Text of an event that was recovered from a table without its column of texts."""


@dataclass(frozen=True, slots=True)
class Gap:
    """Lines of one arm that were lost."""

    arm: str
    first_line: int
    count: int
    cause: str


@dataclass(frozen=True, slots=True)
class Event:
    """An event, and when it happened on the trigger's clock."""

    kind: str
    tick: int
    line: int
    text: str


def read_gaps(source: Source, nodes: dict[str, Document]) -> tuple[Gap, ...]:
    """Return lost lines in the order of their detection; ``nodes`` are the root's. Raises DataError."""
    table = _Table(source, "gaps", nodes)
    first, count = table.numbers("first_line"), table.numbers("count")
    return tuple(map(Gap, table.words("arm"), first, count, table.words("cause")))


def read_events(source: Source, nodes: dict[str, Document]) -> tuple[Event, ...]:
    """Return events in the order in which they were noted; ``nodes`` are the root's. Raises DataError."""
    table = _Table(source, "events", nodes)
    texts = table.cells("text", text=True)
    return tuple(map(Event, table.words("kind"), table.numbers("tick"), table.numbers("line"), texts))


def salvage_events(source: Source, nodes: dict[str, Document]) -> tuple[tuple[Event, ...], list[str]]:
    """Return the events of a damaged table as far as its columns can be read, and what is wrong with others.

    An event needs its line. Its kind is ``other`` if that is lost, its tick 0, its text `TEXT_LOST`.
    """
    table, found, wrong = _Table(source, "events", nodes), {}, []
    for column in ("line", "kind", "tick", "text"):
        try:
            words = table.words(column) if column == "kind" else table.cells(column, text=column == "text")
            found[column] = words
        except DataError as error:
            wrong.append(error.message.removeprefix(f"{source}: "))
    lines = found.get("line", [])
    instead = {"kind": "other", "tick": 0, "text": TEXT_LOST}
    columns = [found.get(name, [value] * len(lines)) for name, value in instead.items()]
    # Columns of different lengths are damaged as well: only the rows that all of them have are events.
    rows = zip(*columns, lines, strict=False)
    return tuple(Event(kind, tick, line, text) for kind, tick, text, line in rows), wrong


@dataclass(frozen=True, slots=True)
class _Table:
    source: Source
    name: str
    nodes: dict[str, Document]

    def cells(self, column: str, *, text: bool = False) -> list[Any]:
        """Return the cells of one column, numbers or texts."""
        try:
            document = self.nodes[f"{self.name}/{column}"]
            (rows,), data_type = document["shape"], document["data_type"]
            if data_type not in (("string",) if text else NUMBERS) or not 0 <= rows <= MOST_ROWS:
                raise ValueError(f"it has {rows} cells of type {data_type}")
            if rows == 0:
                return []
            # The column's only chunk, which may have more rows than the root states.
            chunk = self.source.read(f"{self.name}/{column}/c/0")
            data, checksum = chunk[:-CRC_BYTES], chunk[-CRC_BYTES:]
            if crc32c(data) != checksum:
                raise ValueError("the checksum is wrong")
            if data_type == "string":
                return _texts(data, rows)
            # With struct, since listing recordings should not wait for numpy to load.
            return list(struct.unpack_from(f"<{rows}{NUMBERS[data_type]}", data))
        except OSError as error:
            if not shows_damage(error):
                raise refusal(f"{self.source}/{self.name}/{column}", error, "read") from error
            raise self._damaged(column, error) from error
        except (*PARSE_ERRORS, struct.error) as error:
            raise self._damaged(column, error) from error

    def _damaged(self, column: str, error: Exception) -> DataError:
        # The file's name alone, "0", says nothing.
        why = "its file c/0 is missing" if isinstance(error, FileNotFoundError) else cause_in_words(error)
        return DataError(
            f"{self.source}: table {self.name}/{column} cannot be read: {why}",
            hint="acquire verify, which names all that is damaged",
        )

    def numbers(self, column: str) -> list[int]:
        return self.cells(column)

    def words(self, column: str) -> list[str]:
        """Return a column of CF flag values as their meanings."""
        values = self.numbers(column)
        try:
            attributes = self.nodes[f"{self.name}/{column}"]["attributes"]
            meanings = str(attributes["flag_meanings"]).split()
            by_value = dict(zip(attributes["flag_values"], meanings, strict=True))
            return [by_value[value] for value in values]
        except PARSE_ERRORS as error:
            raise self._damaged(column, error) from error


def _texts(data: bytes, rows: int) -> list[str]:
    """Return the first texts of a ``vlen-utf8`` chunk: a count, then each text after its length."""
    (there,) = struct.unpack_from("<I", data)
    if there < rows:
        raise ValueError(f"it has {there} texts, not {rows}")
    texts, at = [], 4
    for _ in range(rows):
        (size,) = struct.unpack_from("<I", data, at)
        at += 4 + size
        if at > len(data):
            raise ValueError("a text goes beyond the end")
        texts.append(data[at - size : at].decode())
    return texts
