"""Recorded lines that are not on disk, found by lengths alone: in a moment, however long a recording is.

`verify` reads every byte. Here only the indices of the files are read and compared with the files' sizes: a
file that is gone or cut short is detected, a flipped bit is not. Lines flagged as missing do not count:
their loss is recorded already.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cache
from itertools import groupby
from typing import TYPE_CHECKING, Any

from acquire.errors import AcquireError
from acquire.store.array_files import COLUMNS
from acquire.store.shape import ABSENT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.store.array_files import ArrayFiles
    from acquire.store.outline import Outline
    from acquire.store.reader import Recording


@dataclass(frozen=True, slots=True)
class Damage:
    """Lines of one array that are not intact on disk."""

    arm: str
    array: str
    first_line: int
    count: int
    what: str

    def __str__(self) -> str:
        last = self.first_line + self.count - 1
        return f"{self.arm}/{self.array}: lines {self.first_line} to {last}: {self.what}"

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def shortfalls(recording: Outline, shards: range | None = None) -> Iterator[Damage]:
    """Yield the shortfalls of a recording, or of some shards. Raises DataError if gaps cannot be read."""

    @cache
    def whole() -> Recording:
        # At most once, and only if a file is gone: array libraries are slow to load.
        from acquire.store.reader import open_source

        return open_source(recording.source)

    for arm, files in recording.arms.items():
        lost = sorted(recording.lost_rows(arm), key=lambda rows: rows.start)
        for name in COLUMNS:
            array = files.files(name)
            for rows in _by_shard(recording, array.shape.shard_rows, shards):
                for why, absent in _absent(array, rows):
                    for left in _outside(lost, absent):
                        for found in _unflagged(whole, arm, left):
                            yield Damage(arm, name, recording.first_line + found.start, len(found), why)


def first_shortfall(recording: Outline, shards: range | None = None) -> Damage | None:
    """Return the first shortfall, or None; lines that retention has deleted in the meantime do not count."""
    found = next(shortfalls(recording, shards), None)
    if found is not None and recording.state != "sealed":
        recording = recording.refreshed()
        found = next(shortfalls(recording, shards), None)
    return found


def damage_in_words(recording: Outline) -> str | None:
    """Return the damage that shows without reading the lines, or None.

    These are tables that cannot be read, files that are gone or cut short, and missing segments.
    """
    found: list[str] = list(recording.unreadable.values())
    if "gaps" not in recording.unreadable and (shortfall := first_shortfall(recording)) is not None:
        found.append(str(shortfall))
    return "; ".join(found) or next(missing_segments(recording), None)


def missing_segments(recording: Outline) -> Iterator[str]:
    """Yield what is wrong with the segments that a recording lists, in words."""
    for name in recording.attrs.get("segments", ()):
        try:
            segment = recording.beside(name)
        except AcquireError as error:
            yield f"its segment {name} is listed and cannot be read: {error.message}"
            continue
        if segment.attrs["run_id"] != recording.attrs["run_id"]:
            yield f"its segment {name} is of another run, {segment.attrs['run_id']}"


def _by_shard(recording: Outline, size: int, shards: range | None) -> Iterator[range]:
    """Yield the rows that should be there, one shard after the other."""
    for kept in recording.kept_rows():
        for shard in range(kept.start // size, -(-kept.stop // size)):
            if shards is None or shard in shards:
                yield range(max(kept.start, shard * size), min(kept.stop, (shard + 1) * size))


def _absent(array: ArrayFiles, rows: range) -> Iterator[tuple[str, range]]:
    """Yield those of the rows, all of one shard, that cannot be in its file, with the reason."""
    shard, size = rows.start // array.shape.shard_rows, array.shape.chunk_rows
    try:
        entries, intact = array.index(shard)
        there = array.file_bytes(shard)
    except OSError as error:
        yield f"its file cannot be read: {error.strerror or error}", rows
        return
    if not intact:
        yield "the index of its file is damaged", rows
        return

    def why(chunk: int) -> str:
        entry = entries[chunk % array.shape.shard_chunks]
        if ABSENT in entry:
            return "it is not on disk"
        return "its file is cut short" if sum(entry) > there else ""  # offset and size: where it ends

    for reason, chunks in groupby(range(rows.start // size, -(-rows.stop // size)), why):
        if reason:
            first, *others = chunks
            last = others[-1] if others else first
            yield reason, range(max(rows.start, first * size), min(rows.stop, (last + 1) * size))


def _outside(lost: list[range], rows: range) -> Iterator[range]:
    """Yield the parts of ``rows`` that are not in ``lost``, which is in order."""
    start = rows.start
    for gone in lost:
        if gone.start >= rows.stop:
            break
        if start < gone.start:
            yield range(start, gone.start)
        start = max(start, gone.stop)
    if start < rows.stop:
        yield range(start, rows.stop)


def _unflagged(whole: Callable[[], Recording], arm: str, rows: range) -> Iterator[range]:
    """Yield those of the rows that are not flagged as missing; all of them if the flags cannot be read."""
    from acquire.store.present import flags_of
    from acquire.store.scan import missing_rows, runs

    try:
        missing = missing_rows(flags_of(whole(), arm, rows.start, rows.stop))
    except AcquireError:
        yield rows
        return
    for first, count in runs(~missing, rows.start):
        yield range(first, first + count)
