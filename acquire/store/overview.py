"""A coarse picture of a whole recording, stored with its lines: hours at a glance, in any Zarr viewer.

::

    overview/  a  b   (line, pixel)   row i: the mean of rows T·i … T·i + 7 of the arm that are not missing
               line   (line)          the trigger's number of the line in row T·i

The first lines of every T are added up as they pass; whenever there are too many rows, T doubles and every
second row is dropped, so that memory and time are bounded however long a recording gets. The overview is
written when the recording is sealed, and its failure never makes a recording fail.
"""

from __future__ import annotations

import errno
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import DataError
from acquire.lines import ARMS, LineFlag
from acquire.store import layout
from acquire.store.codecs import check_size, decode, encode
from acquire.store.plugin_codecs import missing_codec
from acquire.store.shape import CRC_BYTES, ArrayShape, codec_of, crc32c
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.lines import TaggedBlock
    from acquire.store.files import Disk, Publisher
    from acquire.store.reader import Recording
    from acquire.store.spec import RecordingSpec

NAME = "overview"
KEYS = (NAME, *(f"{NAME}/{name}" for name in (*ARMS, "line")))
CHUNKS = (*(f"{NAME}/{arm}/c/0/0" for arm in ARMS), f"{NAME}/line/c/0")
"""Keys of its data; everything else is metadata."""
AVERAGED = 8
"""Number of lines averaged into one row."""
FIRST_STEP = 64
"""T of a short recording."""
MOST_ROWS = 1024
MOST_SAMPLES = 2**22
"""Limit per arm: very wide lines have fewer rows."""
SPARE_BYTES = 2**22
"""Bytes of the disk that are left for the rest of a recording's end."""
MISSING = np.uint16(LineFlag.MISSING)
ROWS = {"long_name": "mean of some lines", "units": "DN"}
NUMBERS = {"long_name": "the trigger's number of the row's first line", "units": "1"}


class PassingOverview:
    """One arm's overview while its lines pass; rows are counted from ``first_line``."""

    def __init__(self, pixels: int) -> None:
        self.step = FIRST_STEP
        # An even number, since `widen` keeps every second row.
        rows = max(2, min(MOST_ROWS, MOST_SAMPLES // pixels) // 2 * 2)
        # Sums of AVERAGED 16-bit samples fit; the system allocates the memory page by page, on first use.
        self._sums = np.zeros((rows, pixels), np.uint32)
        self._counts = np.zeros(rows, np.uint32)

    def add(self, block: TaggedBlock, first_line: int) -> None:
        """Add the next lines; missing ones are filled with 0."""
        start, count = block.first_line - first_line, len(block.flags)
        # All of the block's rows must have a place before its first line is added.
        while (start + count - 1) // self.step >= len(self._counts):
            self.widen(2 * self.step)
        for offset in range(AVERAGED):
            skipped = (offset - start) % self.step
            lines = block.pixels[skipped :: self.step]
            row = (start + skipped) // self.step
            rows = slice(row, row + len(lines))
            self._sums[rows] += lines
            self._counts[rows] += (block.flags[skipped :: self.step] & MISSING) == 0

    def widen(self, step: int) -> None:
        """Increase T to ``step``, keeping the rows that remain."""
        while self.step < step:
            for values in (self._sums, self._counts):
                half = len(values) // 2
                for row in range(half):  # in place, since an allocation could fail
                    values[row] = values[2 * row]
                values[half:] = 0
            self.step *= 2

    def rows(self, lines: int, data_type: str) -> NDArray[Any]:
        """Return the rows of ``lines`` lines, without an incomplete last one; 0 if all lines are missing."""
        count = max(0, (lines - AVERAGED) // self.step + 1)
        means = self._sums[:count] / np.maximum(self._counts[:count], 1)[:, None]
        return np.rint(means).astype(np.dtype(data_type).newbyteorder("<"))


def write_overview(
    publisher: Publisher, path: Path, passing: Mapping[str, PassingOverview], spec: RecordingSpec, lines: int
) -> dict[str, layout.Document]:
    """Write it for a recording of ``lines`` lines; return the metadata by path. Raises OSError."""
    # An arm that is ahead may have doubled its T once more.
    step = max(arm.step for arm in passing.values())
    for arm in passing.values():
        arm.widen(step)
    arrays = {name: arm.rows(lines, spec.dtype) for name, arm in passing.items()}
    count = len(next(iter(arrays.values())))
    if not count:  # too short for a first row
        return {}
    documents = {name: _document(rows, ("line", "pixel"), ROWS) for name, rows in arrays.items()}
    arrays["line"] = (spec.first_line + step * np.arange(count)).astype("<u8")
    documents["line"] = _document(arrays["line"], ("line",), NUMBERS)
    # Twice the size, for data that do not pack well and for metadata: the recording's end must still fit.
    spare = publisher.disk.free_bytes(path) - 2 * sum(rows.nbytes for rows in arrays.values())
    if spare < SPARE_BYTES:
        raise OSError(errno.ENOSPC, "the disk has room for the recording's end alone")
    for name, rows in arrays.items():
        chunk = path / NAME / name / "c" / "/".join("0" * rows.ndim)
        publisher.disk.make_directory(chunk.parent, parents=True)
        payload = encode(np.ascontiguousarray(rows), "lz4")
        publisher.replace(chunk, payload.tobytes() + crc32c(payload.data))
        publisher.replace(path / NAME / name / "zarr.json", layout.to_json(documents[name]))
    about = {
        "description": f"means of the first {AVERAGED} of every {step} lines, as far as they are there",
        "lines_per_row": step,
        "lines_averaged": AVERAGED,
    }
    group = layout.group_document(about, documents)
    publisher.replace(path / NAME / "zarr.json", layout.to_json(group))
    return {NAME: group, **{f"{NAME}/{name}": document for name, document in documents.items()}}


def withdraw_overview(disk: Disk, path: Path) -> None:
    """Remove one that could not be written; the recording's end needs its room."""
    for key in (*CHUNKS, *(f"{key}/zarr.json" for key in KEYS)):
        with suppress(OSError):
            disk.remove(path / key)


def _document(rows: NDArray[Any], dimensions: tuple[str, ...], attributes: dict[str, Any]) -> layout.Document:
    shape = ArrayShape(rows.dtype.name, rows.shape[1:], len(rows), 1, "lz4")
    return layout.array_document(
        shape=rows.shape,
        data_type=shape.data_type,
        dimensions=dimensions,
        chunk_shape=rows.shape,
        codecs=[layout.BYTES, *layout.packing(shape), layout.CRC32C],
        attributes=attributes,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Overview:
    """One arm at a glance: ``rows`` (row, pixel) in DN, one for every ``lines_per_row`` lines."""

    first_line: int
    lines_per_row: int
    rows: NDArray[Any]


def read_overview(recording: Recording, arm: str) -> Overview | None:
    """Return the overview of an arm; None if there is none. Raises DataError if it is damaged."""
    nodes = recording.document["consolidated_metadata"]["metadata"]
    if NAME not in nodes:
        return None
    key = f"{NAME}/{arm}"
    try:
        document = nodes[key]
        rows, pixels = map(int, document["shape"])
        shape = ArrayShape(document["data_type"], (pixels,), rows, 1, codec_of(document["codecs"]))
        if not (0 < rows <= MOST_ROWS and pixels == recording.arms[arm].pixels):
            raise ValueError(f"it has {rows} rows of {pixels} pixels")
        data = recording.source.read(f"{key}/c/0/0")
        payload = memoryview(data)[:-CRC_BYTES]
        if crc32c(payload) != data[-CRC_BYTES:]:
            raise ValueError("the checksum is wrong")
        check_size(payload, shape.chunk_bytes, shape.codec)
        values = decode(payload, shape.codec, shape.chunk_bytes).view(shape.dtype).reshape(shape.chunk_shape)
        step = int(nodes[NAME]["attributes"]["lines_per_row"])
        if step < AVERAGED:
            raise ValueError(f"it has a row for every {step} lines")
        return Overview(recording.first_line, step, values)
    except layout.DAMAGE as error:
        raise DataError(
            f"{recording}: its overview cannot be read: {error}",
            hint="the lines themselves, from which it was made",
        ) from error


def contradictions(recording: Recording, arm: str) -> Iterator[str]:
    """Yield the faults of an arm's overview, compared with those of its lines that are there and intact.

    Without the codec of the pixels, only the overview itself is read.
    """
    try:
        found = read_overview(recording, arm)
    except DataError as error:
        yield error.message
        return
    if found is None or missing_codec(recording.codec):
        return
    if wrong := sum(_differ(recording, arm, found, rows) for rows in _groups(recording, found)):
        yield f"{arm}: {counted(wrong, 'row of the overview', 'is')} not the mean of the lines"


def _groups(recording: Recording, found: Overview) -> Iterator[range]:
    """Yield the rows whose lines are read at once: a chunk at a time, without dropped lines."""
    step, size = found.lines_per_row, recording.arms[ARMS[0]].reader("lines").shape.chunk_rows
    together = max(1, size // step)
    there = min(len(found.rows), max(0, recording.lines - AVERAGED) // step + 1)
    for first in range(0, there, together):
        rows = range(first, min(there, first + together))
        lines = range(rows.start * step, rows[-1] * step + AVERAGED)
        if not any(lines.start < gone.stop and gone.start < lines.stop for gone in recording.dropped_rows()):
            yield rows


def _differ(recording: Recording, arm: str, found: Overview, rows: range) -> int:
    """Return how many of the rows are not the mean of their lines; rows with a missing line are skipped."""
    step, stream = found.lines_per_row, recording.arms[arm]
    start, stop = rows.start * step, rows[-1] * step + AVERAGED
    try:
        missing = (stream.read("flags", start, stop) & MISSING) != 0
        lines = stream.read("lines", start, stop)
    except DataError:  # reported as damage elsewhere
        return 0
    wrong = 0
    for number in rows:
        some = slice(number * step - start, number * step - start + AVERAGED)
        if not missing[some].any():
            wrong += not np.array_equal(found.rows[number], np.rint(lines[some].mean(axis=0)))
    return wrong
