"""Decimate the lines of one arm to a few 8-bit rows with the darkest and brightest values of their lines.

Row ``r`` covers lines ``r·step`` to ``r·step + step − 1`` by the trigger's count, so that the rows of both
arms correspond, whatever blocks they came in. At high rates only some of the lines are sampled, since this is
a picture and not a record; counts of lost or saturated lines come from the capture path, which sees them all.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.flags import NO_IMAGE

if TYPE_CHECKING:
    from numpy.typing import NDArray

MOST_ROWS_PER_S = 256
"""Four times as many as the page draws, which shows five seconds on 320 rows (`static/waterfall.js`)."""
MOST_COLUMNS = 512
BYTES_PER_S = 4e6
"""Rate of sampled pixels, per arm."""
MOST_SAMPLES = 64
"""Largest number of lines sampled for one row."""
COUNTED_BYTES_PER_S = 1e6
"""Rate of the pixels in the histogram, per arm: to count a pixel takes longer than to compare it."""
MOST_UNSEEN_ROWS = 512
"""Largest number of consecutive rows shown as unseen; a longer pause is shortened."""
BINS = 64
"""Bins of the histogram, over the range of the camera."""
SEEN, LOST, UNSEEN = 0, 1, 2
"""Kinds of rows: seen; some lines were lost; the lines passed while no page was watching."""


@dataclass(frozen=True, slots=True)
class Scale:
    """``step`` lines per row, of which one in ``stride`` is sampled; ``white_dn`` becomes 255.

    One in ``counted`` of the sampled lines is in the histogram, all its pixels.
    """

    step: int
    stride: int
    white_dn: int
    counted: int = 1

    @classmethod
    def of(cls, line_rate_hz: float, line_bytes: int, white_dn: int) -> Scale:
        step = max(1, -(-round(line_rate_hz) // MOST_ROWS_PER_S))
        affordable = BYTES_PER_S / (line_bytes * max(1.0, line_rate_hz / step))
        samples = int(min(MOST_SAMPLES, step, max(1.0, affordable)))
        stride = max(1, step // samples)
        counted = max(1, round(line_rate_hz / stride * line_bytes / COUNTED_BYTES_PER_S))
        return cls(step, stride, white_dn, counted)


@dataclass(slots=True, eq=False)
class Rows:
    """Complete rows from ``first`` on: ``kind`` (row,), and ``low`` and ``high`` (row, column) in 8 bits."""

    first: int
    kind: NDArray[np.uint8]
    low: NDArray[np.uint8]
    high: NDArray[np.uint8]
    histogram: NDArray[np.int64]
    saturated: int
    """Number of pixels in the histogram that are at the camera's white level."""


@dataclass(slots=True)
class _Row:
    """The row that is being filled."""

    number: int
    low: NDArray[Any] | None = None
    high: NDArray[Any] | None = None
    kind: int = SEEN


@dataclass(slots=True)
class _Done:
    kinds: list[int] = field(default_factory=list)
    lows: list[NDArray[Any] | None] = field(default_factory=list)
    highs: list[NDArray[Any] | None] = field(default_factory=list)
    first: int = -1


class Decimator:
    """Decimates one arm during one run. `add` takes lines block by block; `take` returns complete rows."""

    def __init__(self, scale: Scale, width: int) -> None:
        self._scale = scale
        count = min(width, MOST_COLUMNS)
        self._bins = np.arange(scale.white_dn + 1) * BINS // (scale.white_dn + 1)
        edges = np.arange(count + 1) * width // count
        self._members = _members(edges[:-1], edges[1:])
        self._row: _Row | None = None
        self._next_line: int | None = None
        self._lost = False
        """Whether lines were lost since `_next_line`."""
        self._done = _Done()
        self._waiting: list[tuple[NDArray[np.int64], NDArray[Any]]] = []
        self._histogram = np.zeros(BINS, np.int64)
        self._saturated = 0

    @property
    def columns(self) -> int:
        return int(self._members.shape[1])

    def sampled_lines(self, first_line: int, count: int) -> NDArray[np.int64]:
        """Return the numbers of a block's lines that are to be sampled."""
        stride = self._scale.stride
        start = max(first_line, self._next_line or first_line)
        # Multiples of the stride: the choice does not depend on where blocks begin.
        return np.arange(start + -start % stride, first_line + count, stride)

    def add(
        self,
        first_line: int,
        flags: NDArray[np.uint16],
        lines: NDArray[np.int64],
        pixels: NDArray[Any],
        *,
        lost: bool,
    ) -> None:
        """Add a block of lines with ``flags``; ``pixels`` (line, pixel) are those of the sampled ``lines``.

        ``lost``: the lines just before it were lost, and not merely unseen. Lines without an image are lost.
        """
        self._lost |= lost
        usable = (flags & NO_IMAGE) == 0
        if usable.all():  # as most blocks are, and the other way takes ten times as long
            stretches = [[0, len(usable)]]
        else:
            ends = np.flatnonzero(np.diff(usable, prepend=False, append=False))
            stretches = ends.reshape(-1, 2).tolist()
        for start, stop in stretches:
            begin, end = first_line + start, first_line + stop
            # What waits belongs before the gap: rows are added in order only.
            if self._next_line is not None and begin > self._next_line:
                self._reduce()
                self._skip_to(begin, LOST if self._lost else UNSEEN)
            self._next_line = max(end, self._next_line or 0)
            here = (lines >= begin) & (lines < end)
            if here.any():
                self._waiting.append((lines[here], pixels[here]))
            self._lost = False
        self._lost |= not usable[-1]

    def take(self) -> Rows | None:
        """Return the rows completed since the last call."""
        self._reduce()
        done, self._done = self._done, _Done()
        if not done.kinds:
            return None
        black = np.zeros(self.columns, np.uint8)
        rows = Rows(
            first=done.first,
            kind=np.array(done.kinds, np.uint8),
            low=self._eight_bits(np.stack([black if row is None else row for row in done.lows])),
            high=self._eight_bits(np.stack([black if row is None else row for row in done.highs])),
            histogram=self._histogram,
            saturated=self._saturated,
        )
        self._histogram, self._saturated = np.zeros(BINS, np.int64), 0
        return rows

    def _reduce(self) -> None:
        """Turn the waiting blocks into rows, many blocks at a time."""
        if not self._waiting:
            return
        lines = np.concatenate([lines for lines, _ in self._waiting])
        sampled = np.concatenate([pixels for _, pixels in self._waiting])
        self._waiting.clear()
        # First by value and then by bin, because there are few values and many pixels.
        white, counted = self._scale.white_dn, lines // self._scale.stride % self._scale.counted == 0
        values = np.bincount(sampled[counted].ravel(), minlength=white + 1)[: white + 1]
        self._histogram += np.bincount(self._bins, values, BINS).astype(np.int64)
        self._saturated += int(values[white])
        rows = lines // self._scale.step
        begins = np.flatnonzero(np.diff(rows, prepend=rows[0] - 1))
        members = _members(begins, np.append(begins[1:], len(rows)))
        lows, highs = (self._extremes(sampled, members, extreme) for extreme in (np.minimum, np.maximum))
        for number, row_low, row_high in zip(rows[begins], lows, highs, strict=True):
            row = self._begin(int(number))  # an earlier call may have begun this row
            row.low = row_low if row.low is None else np.minimum(row.low, row_low)
            row.high = row_high if row.high is None else np.maximum(row.high, row_high)

    def _extremes(self, sampled: NDArray[Any], members: NDArray[np.intp], extreme: np.ufunc) -> NDArray[Any]:
        """Return the extremes (row, column); ``members`` (line, row) are the lines of each row."""
        # Lines first, as long as they are contiguous. `reduceat` would take ten times as long.
        found: NDArray[Any] = sampled[members[0]]
        for more in members[1:]:
            extreme(found, sampled[more], out=found)
        if len(self._members) == 1:
            return found
        columns = np.take(found, self._members.ravel(), axis=1).reshape(len(found), *self._members.shape)
        reduced: NDArray[Any] = extreme.reduce(columns, axis=1)
        return reduced

    def _eight_bits(self, rows: NDArray[Any]) -> NDArray[np.uint8]:
        # In 32 bits, which hold 255 times the largest value of 16 bits.
        scaled: NDArray[np.uint8] = (rows.astype(np.uint32) * 255 // self._scale.white_dn).astype(np.uint8)
        return scaled

    def _begin(self, number: int) -> _Row:
        """Return row ``number``, and finish the row before it."""
        if self._row is None or self._row.number != number:
            self._finish()
            self._row = _Row(number)
        return self._row

    def _finish(self) -> None:
        row = self._row
        if row is None:
            return
        done = self._done
        if done.first < 0:
            done.first = row.number
        done.kinds.append(row.kind)
        done.lows.append(row.low)
        done.highs.append(row.high)
        self._row = None

    def _skip_to(self, line: int, kind: int) -> None:
        """Add rows of ``kind`` for the lines before ``line``, or only the last of very many."""
        assert self._next_line is not None
        step = self._scale.step
        first, last = self._next_line // step, (line - 1) // step
        if last - first >= MOST_UNSEEN_ROWS:
            self._finish()
            self._done = _Done()
            first = last - MOST_UNSEEN_ROWS + 1
        for number in range(first, last + 1):
            self._begin(number).kind = kind


def _members(begins: NDArray[np.intp], ends: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the indices (member, group) of each group; short ones repeat their last member."""
    most = int((ends - begins).max())
    members: NDArray[np.intp] = np.minimum(begins + np.arange(most)[:, None], ends - 1)
    return members
