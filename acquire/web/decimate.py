"""Lines of one arm as few rows of 8 bits: the darkest and the brightest of what a row stands for.

Row ``r`` is lines ``r·step`` to ``r·step + step − 1`` by the trigger's number, so that the rows of both arms
belong together, whatever blocks they came in. Of many lines only some are looked at: a picture, not a record;
what is counted (lost, saturated) comes from the capture path, which sees every line.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

MOST_ROWS_PER_S = 1000
MOST_COLUMNS = 512
BYTES_PER_S = 4e6
"""Of pixels that are looked at, per arm."""
MOST_SAMPLES = 16
"""Lines that are looked at for one row."""
MOST_UNSEEN_ROWS = 512
"""Rows that are shown as unseen at most; a longer pause is shortened."""
BINS = 64
"""Of the histogram, over the range of the camera."""
SEEN, LOST, UNSEEN = 0, 1, 2
"""What a row is: seen; some of its lines were lost; they passed while nobody looked."""


@dataclass(frozen=True, slots=True)
class Scale:
    """How lines become rows. ``step`` lines per row, one of ``stride`` looked at; ``white_dn`` is 255."""

    step: int
    stride: int
    white_dn: int

    @classmethod
    def of(cls, line_rate_hz: float, line_bytes: int, white_dn: int) -> Scale:
        step = max(1, -(-round(line_rate_hz) // MOST_ROWS_PER_S))
        affordable = BYTES_PER_S / (line_bytes * max(1.0, line_rate_hz / step))
        samples = int(min(MOST_SAMPLES, step, max(1.0, affordable)))
        return cls(step, max(1, step // samples), white_dn)


@dataclass(slots=True, eq=False)
class Rows:
    """Rows that are complete: ``kind`` (row), ``low``, ``high`` (row, column), 8 bit, from ``first`` on."""

    first: int
    kind: NDArray[np.uint8]
    low: NDArray[np.uint8]
    high: NDArray[np.uint8]
    histogram: NDArray[np.int64]
    saturated: int
    """Pixels at the camera's white, of those in the histogram."""


@dataclass(slots=True)
class _Row:
    """The row under way."""

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
    """Of one arm and one run. Lines go in block by block; `take` gives the rows that are complete."""

    def __init__(self, scale: Scale, width: int) -> None:
        self._scale = scale
        count = min(width, MOST_COLUMNS)
        self._bins = np.arange(scale.white_dn + 1) * BINS // (scale.white_dn + 1)
        self._edges = np.arange(count) * width // count
        self._row: _Row | None = None
        self._next_line: int | None = None
        self._done = _Done()
        self._waiting: list[tuple[NDArray[np.int64], NDArray[Any]]] = []
        self._histogram = np.zeros(BINS, np.int64)
        self._saturated = 0

    @property
    def columns(self) -> int:
        return len(self._edges)

    def sampled_lines(self, first_line: int, count: int) -> NDArray[np.int64]:
        """Those of a block's lines that are to be looked at, by their numbers."""
        stride = self._scale.stride
        start = max(first_line, self._next_line or first_line)
        return np.arange(start + -start % stride, first_line + count, stride)

    def add(
        self, first_line: int, count: int, lines: NDArray[np.int64], pixels: NDArray[Any], *, lost: bool
    ) -> None:
        """A block of ``count`` lines, of which ``pixels`` (line, pixel) are the sampled ``lines``.

        ``lost``: lines just before it were lost, not merely unseen.
        """
        if self._next_line is not None and first_line > self._next_line:
            self._reduce()
            self._pass_over(first_line, LOST if lost else UNSEEN)
        self._next_line = max(first_line + count, self._next_line or 0)
        if len(lines):
            self._waiting.append((lines, pixels))

    def take(self) -> Rows | None:
        """The rows that were completed since the last call."""
        self._reduce()
        done, self._done = self._done, _Done()
        if not done.kinds:
            return None
        black = np.zeros(self.columns, np.uint8)
        found = Rows(
            first=done.first,
            kind=np.array(done.kinds, np.uint8),
            low=np.stack([black if row is None else self._eight_bits(row) for row in done.lows]),
            high=np.stack([black if row is None else self._eight_bits(row) for row in done.highs]),
            histogram=self._histogram,
            saturated=self._saturated,
        )
        self._histogram, self._saturated = np.zeros(BINS, np.int64), 0
        return found

    def _reduce(self) -> None:
        """What waits, many blocks at once, becomes rows."""
        if not self._waiting:
            return
        lines = np.concatenate([lines for lines, _ in self._waiting])
        sampled = np.concatenate([pixels for _, pixels in self._waiting])
        self._waiting.clear()
        # By value first, and then by bin: there are few values, and many pixels.
        white = self._scale.white_dn
        values = np.bincount(sampled.ravel(), minlength=white + 1)[: white + 1]
        self._histogram += np.bincount(self._bins, values, BINS).astype(np.int64)
        self._saturated += int(values[white])
        low, high = sampled, sampled
        if len(self._edges) < sampled.shape[1]:
            low = np.minimum.reduceat(sampled, self._edges, axis=1)
            high = np.maximum.reduceat(sampled, self._edges, axis=1)
        rows = lines // self._scale.step
        at = np.flatnonzero(np.diff(rows, prepend=rows[0] - 1))
        lows, highs = np.minimum.reduceat(low, at, axis=0), np.maximum.reduceat(high, at, axis=0)
        for number, one_low, one_high in zip(rows[at], lows, highs, strict=True):
            row = self._begin(int(number))  # which an earlier call may have begun
            row.low = one_low if row.low is None else np.minimum(row.low, one_low)
            row.high = one_high if row.high is None else np.maximum(row.high, one_high)

    def _eight_bits(self, row: NDArray[Any]) -> NDArray[np.uint8]:
        scaled: NDArray[np.uint8] = (row.astype(np.uint32) * 255 // self._scale.white_dn).astype(np.uint8)
        return scaled

    def _begin(self, number: int) -> _Row:
        """The row ``number``; the one before it is complete."""
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

    def _pass_over(self, line: int, kind: int) -> None:
        """Rows whose lines did not come; of very many the last."""
        assert self._next_line is not None
        step = self._scale.step
        first, last = self._next_line // step, (line - 1) // step
        if last - first >= MOST_UNSEEN_ROWS:
            self._finish()
            self._done = _Done()
            first = last - MOST_UNSEEN_ROWS + 1
        for number in range(first, last + 1):
            self._begin(number).kind = kind
