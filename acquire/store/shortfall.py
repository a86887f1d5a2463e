"""Lines that are recorded and not on disk, found by lengths alone: in a moment, however long a recording is.

`verify` reads every byte. Here only the indices of the files are read and compared with the files' sizes:
a file that is gone or cut short shows, a flipped bit does not. What is flagged as missing is no shortfall:
its loss is told already.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.errors import AcquireError
from acquire.lines import LineFlag
from acquire.store.scan import COLUMNS, Damage, covered, runs
from acquire.store.shard import ABSENT

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from acquire.store.camera_stream import CameraStream
    from acquire.store.chunks import ChunkReader
    from acquire.store.reader import Recording


def shortfalls(recording: Recording, shards: range | None = None) -> Iterator[Damage]:
    """Of all files of a recording, or of those of some shards. Raises DataError where gaps cannot be read."""
    for arm, stream in recording.arms.items():
        lost = sorted(recording.lost_rows(arm), key=lambda rows: rows.start)
        for name in COLUMNS:
            reader = stream.reader(name)
            for rows in _by_shard(recording, reader.shape.shard_rows, shards):
                absent = _absent(reader, rows)
                if absent.any():
                    absent &= ~covered(lost, rows)
                    absent &= ~_flagged(stream, rows, absent)
                for first, count in runs(absent, recording.first_line + rows.start):
                    yield Damage(arm, name, first, count, "the file is gone or cut short")


def first_shortfall(recording: Recording, shards: range | None = None) -> Damage | None:
    """The first one, if any; what retention has deleted meanwhile is none."""
    found = next(shortfalls(recording, shards), None)
    if found is not None and recording.state != "sealed":
        recording = recording.refreshed()
        found = next(shortfalls(recording, shards), None)
    return found


def missing_segments(recording: Recording) -> Iterator[str]:
    """What is wrong with the segments that a recording lists, in words."""
    for name in recording.attrs.get("segments", ()):
        try:
            segment = recording.beside(name)
        except AcquireError as error:
            yield f"its segment {name} is listed and cannot be read: {error.message}"
            continue
        if segment.attrs["run_id"] != recording.attrs["run_id"]:
            yield f"its segment {name} is of another run, {segment.attrs['run_id']}"


def _by_shard(recording: Recording, size: int, shards: range | None) -> Iterator[range]:
    """Rows that should be there, one shard after the other."""
    for kept in recording.kept_rows():
        for shard in range(kept.start // size, -(-kept.stop // size)):
            if shards is None or shard in shards:
                yield range(max(kept.start, shard * size), min(kept.stop, (shard + 1) * size))


def _absent(reader: ChunkReader, rows: range) -> NDArray[np.bool_]:
    """Which of the rows, all of one shard, lie in chunks that the file is too short for."""
    shard = rows.start // reader.shape.shard_rows
    try:
        entries, intact = reader.index(shard)
        size = reader.file_bytes(shard)
    except OSError:
        return np.ones(len(rows), bool)
    ends = entries.astype(np.float64).sum(axis=1)  # of what is absent, far beyond any file
    absent = (ends > size) | (entries == ABSENT).any(axis=1)
    if not intact:
        absent[:] = True
    slots = np.arange(rows.start, rows.stop) // reader.shape.chunk_rows - shard * reader.shape.shard_chunks
    result: NDArray[np.bool_] = absent[slots]
    return result


def _flagged(stream: CameraStream, rows: range, where: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the rows are flagged as missing, as far as anybody asks and the flags can be read."""
    if not where.any():
        return where
    try:
        flags = stream.read("flags", rows.start, rows.stop)
    except AcquireError:
        return np.zeros(len(rows), bool)
    missing: NDArray[np.bool_] = (flags & LineFlag.MISSING) != 0
    return missing
