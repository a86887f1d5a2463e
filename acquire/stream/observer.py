"""A reader that the producer does not wait for: for previews, events and checks.

An observer that is slow or dead costs nobody anything. The producer comes round and overwrites what it has
not seen: that is counted, as the price of not being waited for, and the observer goes on with what is new::

    while (block := observer.acquire()) is not None:
        result = look_at(block)
        if observer.release():      # the block was whole until now
            keep(result)

The last line is what makes torn reads impossible: what was overwritten while it was looked at is dropped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from acquire.stream.ring import Ring, RingBlock

_CURSOR, _PEAK, _LOST = range(3)


@dataclass(frozen=True, slots=True)
class ObserverStatistics:
    """Of one observer, in blocks: what waits for it, the most that did, and what it never saw whole."""

    fill: int
    peak: int
    lost: int


class Observer:
    """Observer ``number`` of a ring; one process at a time. Who follows it goes on where it stopped."""

    def __init__(self, ring: Ring, number: int) -> None:
        self._ring = ring
        self._words = ring.observer_words(number)

    def acquire(self) -> RingBlock | None:
        """The next block, or None when there is none now; the same one until released, if it lasts."""
        while (cursor := self._words[_CURSOR]) < (head := self._ring.head):
            waiting = head - cursor
            self._words[_PEAK] = max(self._words[_PEAK], min(waiting, self._ring.shape.slots))
            # The slot of the oldest block is the producer's next.
            block = self._ring.read(cursor) if waiting < self._ring.shape.slots else None
            if block is not None:
                return block
            self._lose(max(1, waiting - self._ring.shape.slots // 2))
        return None

    def release(self) -> bool:
        """Go on to the next; says whether the block was whole all the while. If not, it counts as lost."""
        whole = self._ring.is_whole(self._words[_CURSOR])
        if whole:
            self._words[_CURSOR] += 1
        else:
            self._lose(1)
        return whole

    def skip(self) -> int:
        """Go on with the next block that comes; the blocks that were passed over, which are not lost."""
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
