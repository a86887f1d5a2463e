"""Scan of a recording's chunks on disk: which are intact, and what is wrong with the others."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from acquire.lines import LineFlag
from acquire.store.array_files import COLUMNS
from acquire.store.layout import NO_LINE
from acquire.store.shortfall import Damage

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from acquire.store.camera_stream import CameraStream
    from acquire.store.reader import Recording


@dataclass(frozen=True, slots=True)
class ArmScan:
    """Scan of one arm. ``troubles``: array → chunk → what is wrong; chunks not listed are intact."""

    stream: CameraStream
    troubles: dict[str, dict[int, str]]

    def chunks(self, array: str, rows: Iterable[range]) -> Iterator[int]:
        """Yield the chunks of an array that hold any of ``rows``."""
        return chunks_of(self.stream.reader(array).shape.chunk_rows, rows)

    def check(self, array: str, chunk: int) -> None:
        """Check a chunk, and note what is wrong with it."""
        trouble = self.stream.reader(array).trouble(chunk)
        if trouble is not None:
            self.troubles[array][chunk] = trouble

    def lost(self, rows: range) -> NDArray[np.bool_]:
        """Return which of ``rows`` are in a chunk, of any array, that is not intact."""
        lost = np.zeros(len(rows), bool)
        for array, troubles in self.troubles.items():
            size = self.stream.reader(array).shape.chunk_rows
            for chunk in self.chunks(array, [rows]):
                if chunk in troubles:
                    # Chunks of pixels are shorter than those of tags: the two have different borders.
                    lost[max(0, chunk * size - rows.start) : (chunk + 1) * size - rows.start] = True
        return lost

    def damages(self, rows: int) -> Iterator[Damage]:
        """Yield the damage within the first ``rows`` rows; joins adjacent chunks with the same trouble."""
        for array, troubles in self.troubles.items():
            size = self.stream.reader(array).shape.chunk_rows
            joined: list[tuple[range, str]] = []
            for chunk in sorted(troubles):
                begin, what = chunk, troubles[chunk]
                if joined and joined[-1] == (range(joined[-1][0].start, chunk), what):
                    begin = joined.pop()[0].start
                joined.append((range(begin, chunk + 1), what))
            for chunks, what in joined:
                start, stop = chunks.start * size, min(rows, chunks.stop * size)
                if start < stop:
                    yield Damage(self.stream.arm, array, self.stream.first_line + start, stop - start, what)


def chunks_of(size: int, rows: Iterable[range]) -> Iterator[int]:
    """Yield the chunks of ``size`` rows that hold any of ``rows``, which are in order."""
    unseen = 0
    for part in filter(None, rows):
        stop = -(-part.stop // size)
        yield from range(max(unseen, part.start // size), stop)
        unseen = stop


def scan(
    recording: Recording, rows: Sequence[range], progress: Callable[[int, int], None] | None = None
) -> dict[str, ArmScan]:
    """Check the chunks that hold these rows, of every array of both arms."""
    found = {arm: ArmScan(stream, {name: {} for name in COLUMNS}) for arm, stream in recording.arms.items()}
    arrays = [(arm, name) for arm in found for name in COLUMNS]
    total = sum(1 for arm, name in arrays for _ in found[arm].chunks(name, rows))
    done = 0
    for arm, name in arrays:
        for chunk in found[arm].chunks(name, rows):
            found[arm].check(name, chunk)
            done += 1
            if progress is not None:
                progress(done, total)
    return found


def tag_rows(recording: Recording) -> int:
    """Return the rows of a chunk of tags, the longest chunks of a recording."""
    return next(iter(recording.arms.values())).reader("flags").shape.chunk_rows


def grown_rows(found: ArmScan, rows: range) -> int:
    """Return how many of ``rows`` (one chunk of tags), from the first on, are lines, whole in every array."""
    lost = found.lost(rows)
    whole = int(lost.argmax()) if lost.any() else len(rows)
    if not whole:
        return 0
    tags = found.stream.reader("code_index").chunk(rows.start // len(rows))
    return min(whole, int(np.count_nonzero(tags != NO_LINE)))  # NO_LINE is padding


def missing_rows(flags: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """Return which rows are flagged as missing."""
    missing: NDArray[np.bool_] = (flags & LineFlag.MISSING) != 0
    return missing


def covered(ranges: list[range], rows: range) -> NDArray[np.bool_]:
    """Return which of ``rows`` are in one of ``ranges``, which are in order and do not overlap."""
    inside = np.zeros(len(rows), bool)
    for other in ranges[max(0, bisect_right(ranges, rows.start, key=lambda r: r.start) - 1) :]:
        if other.start >= rows.stop:
            break
        inside[max(0, other.start - rows.start) : max(0, other.stop - rows.start)] = True
    return inside


def runs(rows: NDArray[np.bool_], start: int) -> list[tuple[int, int]]:
    """Return the runs of True as (first, count), counted from ``start``."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], rows.view(np.int8), [0]))))
    return [(start + int(low), int(high - low)) for low, high in edges.reshape(-1, 2)]
