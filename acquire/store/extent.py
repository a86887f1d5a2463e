"""Check of a recording's claimed length against its files: no loop may run over an unchecked number."""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.flags import ARMS
from acquire.store.array_files import COLUMNS
from acquire.store.attributes import MOST_LINES

if TYPE_CHECKING:
    from acquire.store.outline import Outline

MOST_ABSENT_CHUNKS = 2**17
"""Number of chunks of an array that may be claimed without being on disk: terabytes lost by an accident, and
seconds of a scan. The files are counted at opening only if a recording claims more chunks than this.
"""


def check_lengths(recording: Outline) -> None:
    """Raise ValueError if a recording cannot be as long as its root states."""
    arrays = {f"{arm}/{name}": files.files(name) for arm, files in recording.arms.items() for name in COLUMNS}
    first = arrays[f"{ARMS[0]}/lines"]
    for key, array in arrays.items():
        # Retention, copies and recovery take the file of the same number of every array for the same lines.
        if array.shape.shard_rows != first.shape.shard_rows:
            raise ValueError(f"the files of {key} do not hold the same rows as those of {ARMS[0]}/lines")
        if array.rows > MOST_LINES:
            raise ValueError(f"{key} claims {array.rows} lines")
    # Dropped ranges are parts of the recording, one after the other.
    end = 0
    for rows in sorted(recording.dropped_rows(), key=lambda rows: rows.start):
        if not end <= rows.start < rows.stop <= recording.lines:
            raise ValueError(f"the dropped rows {rows.start} to {rows.stop - 1} are not in the recording")
        end = rows.stop
    claimed = kept_shards(recording)
    chunks = max(array.shape.shard_chunks for array in arrays.values())
    if claimed * chunks <= MOST_ABSENT_CHUNKS:
        return
    there = max(len(recording.source.names(f"{key}/c")) for key in arrays)
    if (claimed - there) * chunks > MOST_ABSENT_CHUNKS:
        most = there * first.shape.shard_rows
        raise ValueError(f"{recording.lines} lines are claimed, and there are files for {most} at most")


def kept_shards(recording: Outline) -> int:
    """Return the number of files of each array with lines that retention has not dropped, by the root."""
    size = recording.arms[ARMS[0]].files("lines").shape.shard_rows
    return sum((rows.stop - 1) // size - rows.start // size + 1 for rows in recording.kept_rows())
