"""What of a recording is on disk: chunk by chunk, which are intact, and what is wrong with the others."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.lines import LineFlag
from acquire.store.layout import NO_LINE, line_columns

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from numpy.typing import NDArray

    from acquire.store.camera_stream import CameraStream
    from acquire.store.reader import Recording

COLUMNS = tuple(column.name for column in line_columns("any"))


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


@dataclass(frozen=True, slots=True)
class ArmScan:
    """One arm: array → chunk → what is wrong with it; chunks that are not listed are intact."""

    stream: CameraStream
    troubles: dict[str, dict[int, str]]

    @property
    def damaged_chunks(self) -> set[int]:
        """Chunks in which an array is not intact."""
        return {chunk for troubles in self.troubles.values() for chunk in troubles}

    def damages(self, rows: int) -> Iterator[Damage]:
        """Neighbouring chunks with the same trouble as one; only the first ``rows`` rows count."""
        size = self.stream.reader("lines").shape.chunk_rows
        for array, troubles in self.troubles.items():
            for chunks, what in _stretches(troubles):
                start, stop = chunks.start * size, min(rows, chunks.stop * size)
                if start < stop:
                    yield Damage(self.stream.arm, array, self.stream.first_line + start, stop - start, what)


def scan(
    recording: Recording, chunks: Iterable[int], progress: Callable[[int, int], None] | None = None
) -> dict[str, ArmScan]:
    """Look at these chunks of every array of both arms."""
    wanted = list(chunks)
    found = {}
    for number, (arm, stream) in enumerate(recording.arms.items()):
        troubles: dict[str, dict[int, str]] = {name: {} for name in COLUMNS}
        for done, chunk in enumerate(wanted):
            for name in COLUMNS:
                trouble = stream.reader(name).trouble(chunk)
                if trouble is not None:
                    troubles[name][chunk] = trouble
            if progress is not None:
                progress(number * len(wanted) + done + 1, len(wanted) * len(recording.arms))
        found[arm] = ArmScan(stream, troubles)
    return found


def real_rows(stream: CameraStream, chunk: int) -> int:
    """Rows of an intact chunk that are lines; the others fill it up."""
    return int(np.count_nonzero(stream.reader("code_index").chunk(chunk) != NO_LINE))


def missing_rows(flags: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """Which rows are flagged as missing."""
    missing: NDArray[np.bool_] = (flags & LineFlag.MISSING) != 0
    return missing


def covered(ranges: list[range], rows: range) -> NDArray[np.bool_]:
    """Which of ``rows`` are in one of ``ranges``, which are in order and do not overlap."""
    inside = np.zeros(len(rows), bool)
    for other in ranges[max(0, bisect_right(ranges, rows.start, key=lambda r: r.start) - 1) :]:
        if other.start >= rows.stop:
            break
        inside[max(0, other.start - rows.start) : max(0, other.stop - rows.start)] = True
    return inside


def runs(rows: NDArray[np.bool_], start: int) -> list[tuple[int, int]]:
    """Stretches of True as (first, count), counted from ``start``."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], rows.view(np.int8), [0]))))
    return [(start + int(low), int(high - low)) for low, high in edges.reshape(-1, 2)]


def _stretches(troubles: dict[int, str]) -> Iterator[tuple[range, str]]:
    numbers = sorted(troubles)
    while numbers:
        first = end = numbers[0]
        while numbers and numbers[0] == end and troubles[end] == troubles[first]:
            numbers.pop(0)
            end += 1
        yield range(first, end), troubles[first]
