"""Reading rows of one arm of which some are missing or dropped; these are never read."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import DataError
from acquire.lines import LineFlag

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.store.reader import Recording

MISSING = np.uint16(LineFlag.MISSING)


def flags_of(recording: Recording, arm: str, start: int, stop: int) -> NDArray[np.uint16]:
    """Return the flags of rows ``start .. stop - 1``; dropped rows are flagged as missing."""
    flags = np.full(stop - start, MISSING, np.uint16)
    for rows in recording.kept_rows():
        first, end = max(rows.start, start), min(rows.stop, stop)
        if first < end:
            flags[first - start : end - start] = recording.camera(arm).read("flags", first, end)
    return flags


def present_values(
    recording: Recording, arm: str, name: str, start: int, flags: NDArray[np.uint16]
) -> NDArray[Any]:
    """Return an array's values from row ``start`` on, one for each of ``flags``; 0 for missing rows.

    In a recovered recording, rows that are not intact on disk are flagged as missing. Raises DataError if a
    row that is not flagged cannot be read.
    """
    stream = recording.camera(arm)
    present = (flags & MISSING) == 0
    if present.all():
        return stream.read(name, start, start + len(flags))
    shape = stream.reader(name).shape
    values = np.zeros((len(flags), *shape.row_shape), shape.dtype)
    if not present.any():
        return values
    try:
        values[present] = stream.read(name, start, start + len(flags))[present]
    except DataError:  # chunks of missing rows may be damaged: read around them
        edges = np.flatnonzero(np.diff(present, prepend=False, append=False))
        for first, end in edges.reshape(-1, 2).tolist():
            values[first:end] = stream.read(name, start + first, start + end)
    return values
