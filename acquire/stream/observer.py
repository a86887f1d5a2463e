"""A reader that the producer does not wait for: for previews, events and checks.

An observer that is slow or dead delays nobody. The producer comes round and overwrites the blocks that it has
not read; these are counted as lost to this observer, which continues with newer ones::

    while (block := observer.acquire()) is not None:
        result = look_at(block)
        if observer.release():      # the block was whole until now
            keep(result)

The check in `release` makes torn reads impossible: a result from a block that was overwritten in the meantime
is dropped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from acquire.stream.ring import Ring, RingBlock

_CURSOR, _PEAK, _LOST = range(3)


@dataclass(frozen=True, slots=True)
class ObserverStatistics:
    """Counts of one observer, in blocks: waiting, most that ever waited, and never read whole."""

    fill: int
    peak: int
    lost: int


class Observer:
    """Observer ``number`` of a ring; one process at a time. Its successor continues where it stopped."""

    def __init__(self, ring: Ring, number: int) -> None:
        self._ring = ring
        self._words = ring.observer_words(number)

    def acquire(self) -> RingBlock | None:
        """Return the next block, or None if there is none now; the same one until released or overwritten."""
        while (cursor := self._words[_CURSOR]) < (head := self._ring.head):
            waiting = head - cursor
            self._words[_PEAK] = max(self._words[_PEAK], min(waiting, self._ring.shape.slots))
            # With all slots waiting, the oldest block's slot is the producer's next: too late to read it.
            block = self._ring.read(cursor) if waiting < self._ring.shape.slots else None
            if block is not None:
                return block
            # Skip to half a ring behind: the block after this one would be overtaken just as soon.
            self._lose(max(1, waiting - self._ring.shape.slots // 2))
        return None

    def release(self) -> bool:
        """Advance to the next block; return whether this one stayed whole. If not, it counts as lost."""
        whole = self._ring.is_whole(self._words[_CURSOR])
        if whole:
            self._words[_CURSOR] += 1
        else:
            self._lose(1)
        return whole

    def skip(self) -> int:
        """Advance to the next block to come; return the number of blocks skipped, which are not lost."""
        head = self._ring.head
        passed = head - self._words[_CURSOR]
        self._words[_CURSOR] = head
        return int(passed)

    def statistics(self) -> ObserverStatistics:
        cursor, peak, lost = self._words[:3]
        return ObserverStatistics(min(self._ring.head - cursor, self._ring.shape.slots), peak, lost)

    def close(self) -> None:
        """Release the ring's memory, before the ring does. Idempotent."""
        self._words.release()

    def _lose(self, blocks: int) -> None:
        self._words[_LOST] += blocks
        self._words[_CURSOR] += blocks
