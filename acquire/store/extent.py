"""How long a recording claims to be, against what lies on disk: nobody counts to a number out of a text."""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.lines import ARMS
from acquire.store.attributes import MOST_LINES
from acquire.store.layout import line_columns

if TYPE_CHECKING:
    from acquire.store.reader import Recording

MOST_ABSENT_CHUNKS = 2**17
"""Of an array, that a recording may claim and that are not on disk: terabytes of an accident, and seconds of
a scan. Only a recording that claims more than these has its files counted when it is opened.
"""


def check_lengths(recording: Recording) -> None:
    """Raise ValueError where a recording cannot be as long as its root says."""
    readers = {
        f"{arm}/{column.name}": stream.reader(column.name)
        for arm, stream in recording.arms.items()
        for column in line_columns("any")
    }
    first = readers[f"{ARMS[0]}/lines"]
    for key, reader in readers.items():
        if reader.shape.shard_rows != first.shape.shard_rows:
            raise ValueError(f"files of {key} have other rows than those of {ARMS[0]}/lines")
        if reader.rows > MOST_LINES:
            raise ValueError(f"{key} claims {reader.rows} lines")
    _check_dropped(recording)
    claimed = kept_shards(recording)
    chunks = max(reader.shape.shard_chunks for reader in readers.values())
    if claimed * chunks <= MOST_ABSENT_CHUNKS:
        return
    there = max(len(recording.source.names(f"{key}/c")) for key in readers)
    if (claimed - there) * chunks > MOST_ABSENT_CHUNKS:
        most = there * first.shape.shard_rows
        raise ValueError(f"{recording.lines} lines are claimed, and there are files for {most} at most")


def kept_shards(recording: Recording) -> int:
    """Files of each array that hold lines which retention has not dropped, as the root says."""
    size = recording.arms[ARMS[0]].reader("lines").shape.shard_rows
    return sum((rows.stop - 1) // size - rows.start // size + 1 for rows in recording.kept_rows())


def _check_dropped(recording: Recording) -> None:
    """Dropped stretches are parts of the recording, one after the other."""
    end = 0
    for rows in sorted(recording.dropped_rows(), key=lambda rows: rows.start):
        if not end <= rows.start < rows.stop <= recording.lines:
            raise ValueError(f"lines are said to be dropped that are none: rows {rows.start} to {rows.stop}")
        end = rows.stop
