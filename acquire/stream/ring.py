"""A bounded ring of equal slots in shared memory: one producer process, one reader that it waits for, and
observers that it does not.

::

    control   head peak drops newest dropped | tail | cursor peak lost | …   8-byte words, a line per writer
    headers   sequence first_line count time total losses               one per slot
    flags     (slot, row) uint16
    pixels    (slot, row, pixel)

                 oldest that `lease` can take back
                 ▼              ▼ tail        ▼ head
       │ reserve │   history    │   waiting   │ free, claimed next …   (block k lies in slot k mod slots)

The producer claims a slot, fills it in place and commits it; if no slot is free it counts the lines that it
drops. The reader acquires the oldest slot, reads it in place and releases it. Released blocks stay in place
until the producer comes round: they are the ring's history, and `lease` takes them back. Between history and
producer ``reserve`` slots are kept free, so that the cameras can continue while the reader begins with the
history.

An observer (`acquire.stream.observer`) reads without being waited for: if it is dead or slow the producer
laps it, and it finds out how many slots it lost.

The sequence number of block ``k`` is 2k + 1 while it is being filled and 2k + 2 when it is whole, so that a
torn or stale read is detected. Every word has one writer, and `head` and `tail` are stored last: a producer
killed at any instant leaves whole blocks only, and its successor, given the same memory, continues after
them. (Other processes must see stores in order, as on x86-64; elsewhere the doorbell's system call orders
them. Only `lease` stores and then reads: two slots of reserve are more than a store can be late.)
"""

from __future__ import annotations

import mmap
import os
import select
import time
from dataclasses import dataclass
from multiprocessing import reduction
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import DataError, UsageError
from acquire.lines import LineBlock
from acquire.processes.shared import WORD_BYTES, SharedBytes
from acquire.stream.losses import MAX_LOSSES, Cause, Loss

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

_HEAD, _PEAK, _DROPPED_BLOCKS, _DROPPED_LINES, _NEWEST, _DROPPED_END = range(6)
_TAIL = 8  # the reader's, in a cache line of its own
_OBSERVERS = 16  # each observer's words as well
_LINE_WORDS = 8  # words in a cache line: writers in different processes do not contend for one
_SEQUENCE, _FIRST_LINE, _COUNT, _TIME_NS, _TOTAL, _LOSS_COUNT, _LOSSES = range(7)
_HEADER_WORDS = 32  # six, and three for each of MAX_LOSSES, in whole cache lines
_PAGE_BYTES = 4096
_CAUSES = tuple(Cause)
LEAST_RESERVE = 2


@dataclass(frozen=True, slots=True)
class RingShape:
    """``slots`` slots of up to ``rows`` rows of ``width`` samples of ``dtype``; room for ``observers``.

    ``reserve`` slots are never history: they stay free for the producer while the reader begins with history.
    """

    slots: int
    rows: int
    width: int
    dtype: str
    observers: int = 0
    reserve: int = 2

    def __post_init__(self) -> None:
        if min(self.slots, self.rows, self.width) < 1:
            raise UsageError(
                f"a ring cannot have {self.slots} slots of {self.rows} x {self.width}", possible="1 or more"
            )
        if self.reserve < LEAST_RESERVE:
            raise UsageError(
                f"a ring cannot have a reserve of {self.reserve}", possible=f"{LEAST_RESERVE} or more"
            )

    @property
    def history_slots(self) -> int:
        """Largest number of slots that can be taken back."""
        return max(0, self.slots - self.reserve)

    @property
    def control_words(self) -> int:
        """Words at the beginning of the memory: counters of the ring, then of each observer."""
        return _OBSERVERS + self.observers * _LINE_WORDS

    @property
    def flags_offset(self) -> int:
        """Byte at which the lines' flags begin, after the headers of all slots."""
        return (self.control_words + self.slots * _HEADER_WORDS) * WORD_BYTES

    @property
    def pixels_offset(self) -> int:
        """Byte at which the pixels of the first slot begin: at a page, as those of every slot."""
        return _page_up(self.flags_offset + self.slots * self.rows * 2)

    @property
    def slot_stride(self) -> int:
        """Bytes from slot to slot; page-aligned, so that a slot can be written to disk without a copy."""
        return _page_up(self.rows * self.width * np.dtype(self.dtype).itemsize)

    @property
    def size(self) -> int:
        """Bytes of shared memory: the header, and the slots behind it."""
        return self.pixels_offset + self.slots * self.slot_stride


@dataclass(frozen=True, slots=True)
class RingStatistics:
    """Counts of a ring since it was created, in blocks, except ``dropped_lines``.

    ``fill``: blocks that wait for the reader; ``peak``: their maximum; dropped: blocks that found no free
    slot; ``history``: blocks that can be taken back.
    """

    slots: int
    fill: int
    peak: int
    dropped_blocks: int
    dropped_lines: int
    history: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class RingBlock(LineBlock):
    """A whole block in the ring: views that are valid until it is released.

    ``committed_ns`` is the host's monotonic clock at commit; ``losses`` are the lines lost just before.
    """

    committed_ns: int
    losses: tuple[Loss, ...]


class Ring:
    """See the module. One process produces, one consumes, any may observe and read the statistics."""

    def __init__(
        self, name: str, shape: RingShape, memory: SharedBytes | None = None, bell: int = -1
    ) -> None:
        self.name = name
        self.shape = shape
        self._memory = memory or SharedBytes(f"ring-{name}", shape.size)
        self._bell = bell if bell >= 0 else os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._ringing = select.poll()
        self._ringing.register(self._bell, select.POLLIN)
        self._control = self._memory.words(0, shape.control_words)
        self._headers = [
            self._memory.words(shape.control_words + k * _HEADER_WORDS, _HEADER_WORDS)
            for k in range(shape.slots)
        ]
        self._slots: list[tuple[NDArray[Any], NDArray[np.uint16]]] = []
        """Pixels (row, pixel) and flags (row) of each."""
        for k in range(shape.slots):
            at = shape.flags_offset + k * shape.rows * 2
            flags = np.frombuffer(self._memory.map, np.uint16, shape.rows, at)
            at = shape.pixels_offset + k * shape.slot_stride
            pixels = np.frombuffer(self._memory.map, shape.dtype, shape.rows * shape.width, at)
            self._slots.append((pixels.reshape(shape.rows, shape.width), flags))

    # ---- producer

    def claim(self, first_line: int, count: int) -> LineBlock | None:
        """Return ``count`` lines from ``first_line`` on, to be filled in place; None if the ring is full."""
        head = self._control[_HEAD]
        if head - self._control[_TAIL] == self.shape.slots:
            return None
        index = head % self.shape.slots
        # Before a pixel is touched: an observer that still reads the slot's old block then finds the number
        # odd, and rejects the block.
        self._headers[index][_SEQUENCE] = 2 * head + 1
        pixels, flags = self._slots[index]
        return LineBlock(first_line, pixels[:count], flags[:count])

    def commit(self, block: LineBlock, losses: Sequence[Loss] = ()) -> None:
        """Hand over the lines that were claimed last, now filled, and those lost just before them."""
        if len(losses) > MAX_LOSSES:
            raise UsageError(
                f"one ring slot cannot have {len(losses)} losses before it", possible=f"up to {MAX_LOSSES}"
            )
        first_line, count = block.first_line, len(block.flags)
        head, total = self._control[_HEAD], self.committed_lines + count
        header = self._headers[head % self.shape.slots]
        header[_FIRST_LINE], header[_COUNT] = first_line, count
        header[_TIME_NS], header[_TOTAL] = time.monotonic_ns(), total
        for position, loss in enumerate(losses):
            at = _LOSSES + 3 * position
            header[at], header[at + 1] = loss.first_line, loss.count
            header[at + 2] = _CAUSES.index(loss.cause)
        header[_LOSS_COUNT] = len(losses)
        # After the header's words: a reader that finds it even finds the words of this block.
        header[_SEQUENCE] = 2 * head + 2
        self._control[_NEWEST] = first_line + count
        self._control[_PEAK] = max(self._control[_PEAK], head + 1 - self._control[_TAIL])
        self._control[_HEAD] = head + 1  # last: a producer killed before this has handed over nothing
        os.eventfd_write(self._bell, 1)  # after the head: whoever it wakes must find the block

    def drop(self, first_line: int, lines: int) -> None:
        """Count a block that found the ring full."""
        self._control[_DROPPED_BLOCKS] += 1
        self._control[_DROPPED_LINES] += lines
        self._control[_DROPPED_END] = first_line + lines

    # ---- the reader that is waited for

    def acquire(self, timeout_s: float = 0.0) -> RingBlock | None:
        """Return the oldest block, or None if none came within ``timeout_s``; the same one until released."""
        deadline = time.monotonic() + timeout_s
        # The counts decide, not the bell, which may have been rung for a block that was taken already.
        while self._control[_HEAD] == self._control[_TAIL]:
            remaining_s = deadline - time.monotonic()
            if remaining_s <= 0 or not self._ringing.poll(remaining_s * 1000):
                return None
            os.eventfd_read(self._bell)
        tail = self._control[_TAIL]
        block = self.read(tail)
        if block is None:
            raise self._torn(tail)
        return block

    def release(self) -> None:
        """Give the oldest block's slot back to the producer."""
        tail = self._control[_TAIL]
        if not self.is_whole(tail):
            raise self._torn(tail)
        self._control[_TAIL] = tail + 1

    def lease(self, first_line: int) -> list[range]:
        """Take released blocks back, from the one that holds ``first_line`` on; return the lines of each.

        If the history begins later, all of it is taken: see `history_line`. `acquire` returns them again.
        """
        tail = self._control[_TAIL]
        oldest = min(tail, self._oldest())
        self._control[_TAIL] = oldest  # first keep the producer away, then check which blocks are left
        # The producer may have claimed the oldest slots between our read of the head and this store.
        while oldest < tail:
            header = self._header(oldest)
            if self.is_whole(oldest) and header[_FIRST_LINE] + header[_COUNT] > first_line:
                break
            oldest += 1
            self._control[_TAIL] = oldest
        headers = map(self._header, range(oldest, tail))
        return [range(header[_FIRST_LINE], header[_FIRST_LINE] + header[_COUNT]) for header in headers]

    def empty(self) -> list[range]:
        """Release all waiting blocks unread; return the lines of each."""
        blocks = []
        while (block := self.acquire()) is not None:
            blocks.append(range(block.first_line, block.end_line))
            self.release()
        return blocks

    def fileno(self) -> int:
        """The doorbell: readable if a block was committed since `hush`."""
        return self._bell

    def hush(self) -> None:
        """Reset the doorbell, after a wait on `fileno`."""
        # Poll first: reading a bell that has not been rung is an error (EAGAIN).
        if self._ringing.poll(0):
            os.eventfd_read(self._bell)

    # ---- any process

    @property
    def path(self) -> str:
        """A path to the memory, valid while the process that created it lives."""
        return self._memory.path

    @property
    def fill(self) -> int:
        """Blocks committed and not yet released."""
        # Tail first: a head that is read later is never behind it, though both may advance in between.
        tail = self._control[_TAIL]
        return int(min(self._control[_HEAD] - tail, self.shape.slots))

    @property
    def room_lines(self) -> int:
        """Lines that find a free slot, if blocks keep their average length."""
        head = int(self._control[_HEAD])
        rows = self.committed_lines / head if head else self.shape.rows
        return int((self.shape.slots - self.fill) * rows)

    @property
    def newest_line(self) -> int:
        """The line after the last committed one; 0 before the first."""
        return int(self._control[_NEWEST])

    @property
    def dropped_end(self) -> int:
        """The line after the last one that found the ring full; 0 before the first."""
        return int(self._control[_DROPPED_END])

    @property
    def committed_lines(self) -> int:
        """Lines committed so far; correct also after a producer's death at any instant."""
        # From the last whole block's header: a separate counter would be stored before or after the head,
        # and a kill in between would leave the two inconsistent.
        head = self._control[_HEAD]
        return int(self._header(head - 1)[_TOTAL]) if head else 0

    @property
    def released_lines(self) -> int:
        """Lines in the blocks that the reader has released and not taken back."""
        # From the oldest block that waits: in a full ring, the slot of the one before it is overwritten.
        tail = self._control[_TAIL]
        if self._control[_HEAD] == tail:
            return self.committed_lines
        header = self._header(tail)
        return int(header[_TOTAL] - header[_COUNT])

    @property
    def released_line(self) -> int:
        """The line after the last that the reader has released, or lost since; 0 before the first."""
        tail = self._control[_TAIL]
        return self.newest_line if self._control[_HEAD] == tail else int(self._header(tail)[_FIRST_LINE])

    @property
    def oldest_block(self) -> RingBlock | None:
        """The first block that `lease` can take back, or that waits; None if there is none."""
        first = min(self._control[_TAIL], self._oldest())
        blocks = map(self.read, range(first, self._control[_HEAD]))
        return next((block for block in blocks if block is not None), None)

    @property
    def history_line(self) -> int:
        """The first line that `lease` can take back, or that waits; `newest_line` if there is none."""
        block = self.oldest_block
        return self.newest_line if block is None else block.first_line

    @property
    def head(self) -> int:
        """Number of the next block; all blocks before it were committed."""
        return int(self._control[_HEAD])

    def read(self, number: int) -> RingBlock | None:
        """Return block ``number`` in place, or None if it is not in the ring or is being overwritten.

        A reader that is not waited for must check `is_whole` again after having used the block.
        """
        header, (pixels, flags) = self._header(number), self._slots[number % self.shape.slots]
        if not self.is_whole(number):
            return None
        count = header[_COUNT]
        losses: tuple[Loss, ...] = ()
        if header[_LOSS_COUNT]:
            words = iter(header[_LOSSES : _LOSSES + 3 * header[_LOSS_COUNT]].tolist())
            losses = tuple(
                Loss(first, lost, _CAUSES[why]) for first, lost, why in zip(words, words, words, strict=True)
            )
        block = RingBlock(
            first_line=header[_FIRST_LINE],
            pixels=pixels[:count],
            flags=flags[:count],
            committed_ns=header[_TIME_NS],
            losses=losses,
        )
        return block if self.is_whole(number) else None  # the header may be another block's by now

    def is_whole(self, number: int) -> bool:
        """Return whether the slot holds this block, completely."""
        sequence: int = self._header(number)[_SEQUENCE]
        return sequence == 2 * number + 2

    def observer_words(self, number: int) -> memoryview:
        """Return the words owned by one observer, initially 0. The caller must release it before `close`."""
        if not 0 <= number < self.shape.observers:
            raise UsageError(
                f"ring {self.name} has no observer {number}", possible=f"0 to {self.shape.observers - 1}"
            )
        at = _OBSERVERS + number * _LINE_WORDS
        return self._control[at : at + _LINE_WORDS]

    def statistics(self) -> RingStatistics:
        control = self._control
        return RingStatistics(
            slots=self.shape.slots,
            fill=self.fill,
            peak=control[_PEAK],
            dropped_blocks=control[_DROPPED_BLOCKS],
            dropped_lines=control[_DROPPED_LINES],
            history=max(0, control[_TAIL] - self._oldest()),
        )

    def discard(self) -> None:
        """Give the memory back to the host, even if a process that hangs still has it mapped."""
        self._memory.map.madvise(mmap.MADV_REMOVE)

    def close(self) -> None:
        """Release the memory; the other processes keep theirs. Idempotent."""
        if self._bell < 0:
            return
        self._slots.clear()  # memory can only be unmapped once there are no views of it
        for words in (*self._headers, self._control):
            words.release()
        self._memory.close()
        os.close(self._bell)
        self._bell = -1

    def __reduce__(self) -> tuple[Any, ...]:
        return _attach, (self.name, self.shape, self._memory, reduction.DupFd(self._bell))

    def _oldest(self) -> int:
        return int(max(0, self._control[_HEAD] - self.shape.history_slots))

    def _header(self, number: int) -> memoryview:
        return self._headers[number % self.shape.slots]

    def _torn(self, number: int) -> DataError:
        return DataError(
            f"ring {self.name}: block {number} is torn or stale (sequence {self._header(number)[_SEQUENCE]})",
            possible=f"sequence {2 * number + 2} while exactly one process produces and one consumes",
        )


def _page_up(size: int) -> int:
    return -(-size // _PAGE_BYTES) * _PAGE_BYTES


def _attach(name: str, shape: RingShape, memory: SharedBytes, bell: Any) -> Ring:
    return Ring(name, shape, memory, bell.detach())
