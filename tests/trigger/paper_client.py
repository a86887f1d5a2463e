"""A client of the trigger, written from PROTOCOL.md and REGISTERS.md alone: it imports none of our modules.

Every number comes from the tables of the two documents; the code here implements their text.
"""

from __future__ import annotations

import os
import re
import select
import struct
import termios
import time
import tty
import zlib
from pathlib import Path
from typing import NamedTuple

LIMIT_S = 60.0


class Table(NamedTuple):
    section: str
    caption: str
    header: list[str]
    rows: list[list[str]]


def tables(document: Path) -> list[Table]:
    found: list[Table] = []
    section = caption = ""
    inside = False
    for line in document.read_text(encoding="utf-8").splitlines():
        if line.startswith("|"):
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            if not inside:
                found.append(Table(section, caption, cells, []))
            elif not re.fullmatch(r"[|-]+", line):
                found[-1].rows.append(cells)
        elif line.startswith("#"):
            section = caption = line.lstrip("# ")
        elif line.endswith(":"):
            caption = line
        inside = line.startswith("|")
    return found


class Register(NamedTuple):
    address: int
    bits: int
    access: str
    reset: str
    fields: dict[str, tuple[int, int]]
    """Name to its low bit and width."""

    @property
    def words(self) -> int:
        return -(-self.bits // 32)


class Documents:
    """Contents of the documents' tables."""

    def __init__(self, folder: Path) -> None:
        self.tables = tables(folder / "PROTOCOL.md")
        self.registers: dict[str, Register] = {}
        (table,) = (table for table in tables(folder / "REGISTERS.md") if table.section == "Map")
        for address, name, bits, access, reset, _ in table.rows:
            if address:
                register = Register(int(address, 16), int(bits), access, reset, {})
                self.registers[name] = register
            else:
                high, _, low = bits.partition(":")
                first = int(low or high)
                register.fields[name.lstrip(".")] = (first, int(high) - first + 1)
        frame = self._table("Frames", "field")
        self.version = int(frame["version"][2])
        self.tag = {row[0]: (int(row[2]), int(row[1]) // 8) for row in self._table("Tags", "field").values()}

    def numbers(self, where: str) -> dict[str, int]:
        """Name to value of the table below a caption, or a section, that begins so."""
        (table,) = (
            t for t in self.tables if t.header[:2] == ["value", "name"] and t.caption.startswith(where)
        )
        return {row[1]: int(row[0], 0) for row in table.rows}

    def _table(self, section: str, first: str) -> dict[str, list[str]]:
        (table,) = (t for t in self.tables if t.section == section and t.header[0] == first)
        return {row[0]: row for row in table.rows}


class Refused(Exception):
    def __init__(self, error: int, address: int) -> None:
        super().__init__(error, address)
        self.error, self.address = error, address


class Client:
    """One device at a port. Tags are collected in ``tags``, with the sequence of their frame."""

    def __init__(self, port: str, documents: Documents) -> None:
        self.documents = documents
        self.types = documents.numbers("Types")
        self.commands = documents.numbers("Commands")
        self.tags: list[tuple[int, dict[str, int]]] = []
        self._file = os.open(port, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._file, termios.TCSANOW)
        self._bytes = b""
        self._sequence = 0
        self.send(b"\0")

    def close(self) -> None:
        os.close(self._file)

    # Frames.

    def send(self, data: bytes) -> None:
        while data:
            data = data[os.write(self._file, data) :]

    def frame(self, kind: int, payload: bytes) -> bytes:
        body = struct.pack("<BBH", self.documents.version, kind, self._sequence) + payload
        return stuffed(body + struct.pack("<I", zlib.crc32(body))) + b"\0"

    def _next(self) -> tuple[int, int, bytes]:
        """Type, sequence and payload of the next frame."""
        deadline_s = time.monotonic() + LIMIT_S
        while b"\0" not in self._bytes:
            assert time.monotonic() < deadline_s, "the device says nothing"
            if select.select([self._file], [], [], 1.0)[0]:
                self._bytes += os.read(self._file, 4096)
        coded, _, self._bytes = self._bytes.partition(b"\0")
        whole = unstuffed(coded)
        body, (crc,) = whole[:-4], struct.unpack("<I", whole[-4:])
        assert zlib.crc32(body) == crc
        version, kind, sequence = struct.unpack("<BBH", body[:4])
        assert version == self.documents.version
        return kind, sequence, body[4:]

    def hear(self) -> tuple[int, int, bytes]:
        """As `_next`; a tag is collected as well."""
        kind, sequence, payload = self._next()
        if kind == self.types["TAG"]:
            places = self.documents.tag.items()
            tag = {name: int.from_bytes(payload[at : at + size], "little") for name, (at, size) in places}
            self.tags.append((sequence, tag))
        return kind, sequence, payload

    def ask(self, kind: str, payload: bytes, answer: str) -> bytes:
        self._sequence = self._sequence + 1 & 0xFFFF
        self.send(self.frame(self.types[kind], payload))
        while True:
            came, sequence, said = self.hear()
            if came == self.types["TAG"]:
                continue
            assert sequence == self._sequence
            if came == self.types["NAK"]:
                raise Refused(*struct.unpack("<HH", said))
            assert came == self.types[answer]
            return said

    # Registers.

    def read_words(self, address: int, count: int) -> list[int]:
        said = self.ask("READ", struct.pack("<HB", address, count), "DATA")
        assert struct.unpack("<H", said[:2]) == (address,)
        return list(struct.unpack(f"<{count}I", said[2:]))

    def write_words(self, address: int, words: list[int]) -> None:
        said = self.ask("WRITE", struct.pack(f"<H{len(words)}I", address, *words), "ACK")
        assert struct.unpack("<HB", said) == (address, len(words))

    def read(self, name: str) -> int:
        register = self.documents.registers[name]
        words = self.read_words(register.address, register.words)
        return sum(word << 32 * at for at, word in enumerate(words))

    def field(self, name: str, field: str) -> int:
        low, width = self.documents.registers[name].fields[field]
        return self.read(name) >> low & (1 << width) - 1

    def write(self, name: str, value: int) -> None:
        register = self.documents.registers[name]
        self.write_words(register.address, [value >> 32 * at & 0xFFFFFFFF for at in range(register.words)])

    def packed(self, name: str, **fields: int) -> int:
        places = self.documents.registers[name].fields
        return sum(value << places[field][0] for field, value in fields.items())

    def command(self, name: str, run: int = 0) -> None:
        number = self.commands[name]
        self.write_words(self.documents.registers["RUN_ID"].address, [run & 0xFFFFFFFF, run >> 32, number])


def stuffed(data: bytes) -> bytes:
    """COBS: pieces between zeros, each preceded by its length + 1; 254 bytes by 255, with no zero after."""
    coded = bytearray()
    pieces = data.split(b"\0")
    for piece in pieces:
        rest = piece
        while len(rest) >= 254:
            coded += b"\xff" + rest[:254]
            rest = rest[254:]
        coded += bytes([len(rest) + 1]) + rest
    return bytes(coded)


def unstuffed(coded: bytes) -> bytes:
    data, at = bytearray(), 0
    while at < len(coded):
        length = coded[at]
        data += coded[at + 1 : at + length]
        at += length
        if length < 255 and at < len(coded):
            data.append(0)
    return bytes(data)
