"""Gives lines their code, ticks and time, and checks these against the trigger's tags.

They follow from the line's number: line ``l`` begins at code index S·l and is read out from tick
(S·l + n - 1)·substep_ticks on. A tag that agrees confirms every line up to its own. No I/O.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from acquire.geometry import Geometry
from acquire.lines import LineFlag, LineTable, TaggedBlock
from acquire.trigger.base import LineTag

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from acquire.clock import ClockFit
    from acquire.lines import LineBlock
    from acquire.trigger.base import TriggerRun

UNCONFIRMED = np.uint16(LineFlag.TIME_ESTIMATED | LineFlag.CODE_UNVERIFIED)

# Code and times are computed for this many lines at once, for both arms. Enough tables are kept for the
# distance between the arms in an ordinary run.
_SPAN_LINES = 32768
_SPANS_KEPT = 4


@dataclass(frozen=True, slots=True)
class TagMismatch:
    """A tag of the trigger that contradicts the line count, and the tag expected in its place."""

    tag: LineTag
    expected: LineTag

    def __str__(self) -> str:
        tag, expected = self.tag, self.expected
        if tag == expected:
            return f"the trigger came back to line {tag.line}: it started again"
        return (
            f"tag of line {tag.line}: code index {tag.code_index}, tick {tag.tick}; "
            f"expected {expected.code_index} and {expected.tick}"
        )


def tag_rows(tags: Sequence[LineTag]) -> NDArray[np.uint64]:
    """Return tags as (tag, 3) uint64: line, code index, tick."""
    rows = np.array([(tag.line, tag.code_index, tag.tick) for tag in tags], np.uint64)
    return rows.reshape(len(tags), 3)


class Tagger:
    """Tags blocks of one run. ``confirmed_end`` is the line after the last one that a tag confirmed."""

    def __init__(self, run: TriggerRun, stages: int, clock: ClockFit) -> None:
        self._run = run
        self._clock = clock
        self._readout_substep = Geometry(stages, run.substeps, 1).readout_substep
        self._spans: dict[int, LineTable] = {}
        self._last_line = -1
        self._restarted = False
        self.confirmed_end = 0

    def verify(self, rows: NDArray[np.uint64]) -> list[TagMismatch]:
        """Compare tags (tag, 3), see `tag_rows`, with the prediction; return those that contradict it.

        Tags that are consistent but go back in lines show that the trigger started again: nothing after that
        is confirmed any more.
        """
        lines = rows[:, 0]
        code_index = lines * np.uint64(self._run.substeps)
        expected = np.stack([lines, code_index, code_index * np.uint64(self._run.substep_ticks)], axis=1)
        # The common case, all tags as predicted and in order, at a fraction of the cost.
        numbers = lines.tolist()
        ahead = all(before < line for before, line in pairwise((self._last_line, *numbers)))
        if ahead and not self._restarted and np.array_equal(rows, expected):
            self._last_line = numbers[-1] if numbers else self._last_line
            self.confirmed_end = self._last_line + 1
            return []
        wrong = (rows != expected).any(axis=1)
        right = np.flatnonzero(~wrong)
        counted = rows[right, 0].astype(np.int64)  # signed, since the line before the first is -1
        back = np.diff(counted, prepend=self._last_line) <= 0
        certain = counted[~np.logical_or.accumulate(back)]
        if len(certain) and not self._restarted:
            self._last_line = int(certain[-1])
            self.confirmed_end = self._last_line + 1
        self._restarted |= bool(back.any())
        suspects = np.union1d(np.flatnonzero(wrong), right[back])
        return [TagMismatch(LineTag(*map(int, rows[k])), LineTag(*map(int, expected[k]))) for k in suspects]

    def tag(self, arm: str, block: LineBlock) -> TaggedBlock:
        """Return the arm's lines with code and time; those that no tag has confirmed so far are flagged."""
        flags = block.flags
        confirmed = max(0, self.confirmed_end - block.first_line)
        if confirmed < len(block):
            flags = flags.copy()  # they are in the ring, where observers read them
            flags[confirmed:] |= UNCONFIRMED
        table = self.table(block.first_line, len(block))
        return TaggedBlock(block.first_line, block.pixels, flags, arm, table)

    def table(self, first_line: int, count: int) -> LineTable:
        """Return the table of ``count`` lines from ``first_line`` on, a slice of one that both arms share."""
        for start, span in reversed(self._spans.items()):
            if start <= first_line and first_line + count <= start + len(span):
                return span[first_line - start : first_line - start + count]
        substeps, lines = self._run.substeps, max(count, _SPAN_LINES)
        first_bit, bits_end = substeps * first_line, substeps * (first_line + lines)
        code_index = np.arange(first_bit, bits_end, substeps, dtype=np.uint64)
        tick = (code_index + np.uint64(self._readout_substep)) * np.uint64(self._run.substep_ticks)
        bits = self._run.code.bits(first_bit, substeps * lines)
        code = np.zeros(lines, np.uint8)
        for substep in range(substeps):  # packbits takes several times as long on rows this short
            code |= bits[substep::substeps] << np.uint8(substep)
        self._spans[first_line] = span = LineTable(code_index, code, tick, self._clock.time_ns(tick))
        if len(self._spans) > _SPANS_KEPT:
            del self._spans[next(iter(self._spans))]  # the oldest
        return span[:count]
