"""A bounded ring of equal slots in shared memory between one producer and one consumer process.

::

    control   head peak drops newest | tail          words of 8 bytes, one cache line per writer
    headers   sequence first_line count time losses  one per slot
    flags     (slot, row) uint16
    pixels    (slot, row, pixel)

The producer claims a slot, fills it in place and commits it; with no slot free it is told so and counts
the lines it drops. The consumer acquires the oldest slot, reads it in place and releases it. Block ``k``
of the stream lies in slot ``k mod slots``; its sequence number is 2k + 1 while it is being filled and
2k + 2 when it is whole, so that a torn or stale read shows. `head` and `tail` have one writer each and
are stored last: a producer killed at any instant leaves whole blocks only. (Stores must be seen in order,
as x86-64 does; elsewhere the doorbell's system call orders them.)

A second reader would get a tail and a doorbell of its own; the producer would then look at the slowest.
"""

from __future__ import annotations

import os
import select
import time
from dataclasses import dataclass
from multiprocessing import reduction
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import DataError, UsageError
from acquire.stream.losses import MAX_LOSSES, Cause, Loss
from acquire.stream.shared import WORD_BYTES, SharedBytes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

_HEAD, _PEAK, _DROPPED_BLOCKS, _DROPPED_LINES, _NEWEST = range(5)
_TAIL = 8
_CONTROL_WORDS = 16
_SEQUENCE, _FIRST_LINE, _COUNT, _TIME_NS, _LOSS_COUNT, _LOSSES = range(6)
_HEADER_WORDS = 32
_PAGE_BYTES = 4096
_CAUSES = tuple(Cause)


@dataclass(frozen=True, slots=True)
class RingShape:
    """``slots`` slots of up to ``rows`` rows of ``width`` samples of ``dtype``."""

    slots: int
    rows: int
    width: int
    dtype: str

    def __post_init__(self) -> None:
        if min(self.slots, self.rows, self.width) < 1:
            raise UsageError(
                f"ring of {self.slots} slots of {self.rows} x {self.width}", possible="1 or more"
            )

    @property
    def flags_offset(self) -> int:
        return (_CONTROL_WORDS + self.slots * _HEADER_WORDS) * WORD_BYTES

    @property
    def pixels_offset(self) -> int:
        return _page_up(self.flags_offset + self.slots * self.rows * 2)

    @property
    def slot_stride(self) -> int:
        """Bytes from slot to slot; page-aligned, so that a slot can go to disk without a copy."""
        return _page_up(self.rows * self.width * np.dtype(self.dtype).itemsize)

    @property
    def size(self) -> int:
        return self.pixels_offset + self.slots * self.slot_stride


@dataclass(frozen=True, slots=True)
class RingStatistics:
    """What happened to a ring since it was made."""

    slots: int
    fill: int
    peak: int
    dropped_blocks: int
    dropped_lines: int


@dataclass(frozen=True, slots=True, eq=False)
class Slot:
    """A claimed slot: views to be filled, ``pixels`` (row, pixel) and ``flags`` (row)."""

    pixels: NDArray[Any]
    flags: NDArray[np.uint16]


@dataclass(frozen=True, slots=True, eq=False)
class RingBlock:
    """A whole block in the ring: views that are valid until it is released.

    ``time_ns`` is the host's monotonic clock at commit; ``losses`` are the lines lost just before.
    """

    first_line: int
    pixels: NDArray[Any]
    flags: NDArray[np.uint16]
    time_ns: int
    losses: tuple[Loss, ...]

    @property
    def end_line(self) -> int:
        return self.first_line + len(self.flags)


class Ring:
    """See the module. One process produces, one consumes, any process may read the statistics."""

    def __init__(
        self, name: str, shape: RingShape, memory: SharedBytes | None = None, bell: int = -1
    ) -> None:
        self.name = name
        self.shape = shape
        self._memory = memory or SharedBytes(f"ring-{name}", shape.size)
        self._bell = bell if bell >= 0 else os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._ringing = select.poll()
        self._ringing.register(self._bell, select.POLLIN)
        self._control = self._memory.words(0, _CONTROL_WORDS)
        self._headers = [
            self._memory.words(_CONTROL_WORDS + k * _HEADER_WORDS, _HEADER_WORDS) for k in range(shape.slots)
        ]
        self._slots = [self._view(k) for k in range(shape.slots)]

    # ---- producer

    def claim(self) -> Slot | None:
        """The next slot to fill, or None when the ring is full."""
        head = self._control[_HEAD]
        if head - self._control[_TAIL] == self.shape.slots:
            return None
        index = head % self.shape.slots
        self._headers[index][_SEQUENCE] = 2 * head + 1
        return self._slots[index]

    def commit(self, first_line: int, count: int, losses: Sequence[Loss] = ()) -> None:
        """Hand the claimed slot's first ``count`` rows over, as lines from ``first_line``."""
        head = self._control[_HEAD]
        header = self._headers[head % self.shape.slots]
        header[_FIRST_LINE], header[_COUNT] = first_line, count
        header[_TIME_NS] = time.monotonic_ns()
        _write_losses(header, losses)
        header[_SEQUENCE] = 2 * head + 2
        self._control[_NEWEST] = first_line + count
        self._control[_PEAK] = max(self._control[_PEAK], head + 1 - self._control[_TAIL])
        self._control[_HEAD] = head + 1
        os.eventfd_write(self._bell, 1)

    def drop(self, lines: int) -> None:
        """Count a block that found the ring full."""
        self._control[_DROPPED_BLOCKS] += 1
        self._control[_DROPPED_LINES] += lines

    # ---- consumer

    def acquire(self, timeout_s: float = 0.0) -> RingBlock | None:
        """The oldest block, or None when none came within ``timeout_s``; the same one until released."""
        if not self._wait(timeout_s):
            return None
        tail = self._control[_TAIL]
        header = self._headers[tail % self.shape.slots]
        self._check(header, tail)
        count, slot = header[_COUNT], self._slots[tail % self.shape.slots]
        return RingBlock(
            first_line=header[_FIRST_LINE],
            pixels=slot.pixels[:count],
            flags=slot.flags[:count],
            time_ns=header[_TIME_NS],
            losses=_read_losses(header) if header[_LOSS_COUNT] else (),
        )

    def release(self) -> None:
        """Give the oldest block's slot back to the producer."""
        tail = self._control[_TAIL]
        self._check(self._headers[tail % self.shape.slots], tail)
        self._control[_TAIL] = tail + 1

    def empty(self) -> int:
        """Release everything that waits, unread; returns the number of lines."""
        lines = 0
        while (block := self.acquire()) is not None:
            lines += len(block.flags)
            self.release()
        return lines

    def fileno(self) -> int:
        """The doorbell: readable when something was committed since `hush`."""
        return self._bell

    def hush(self) -> None:
        """Take note of the doorbell, after a wait on `fileno`."""
        if self._ringing.poll(0):
            os.eventfd_read(self._bell)

    # ---- any process

    @property
    def fill(self) -> int:
        """Blocks committed and not yet released."""
        tail = self._control[_TAIL]
        return int(min(self._control[_HEAD] - tail, self.shape.slots))

    @property
    def newest_line(self) -> int:
        """The line after the last committed one; 0 before the first."""
        return int(self._control[_NEWEST])

    def statistics(self) -> RingStatistics:
        control = self._control
        return RingStatistics(
            slots=self.shape.slots,
            fill=self.fill,
            peak=control[_PEAK],
            dropped_blocks=control[_DROPPED_BLOCKS],
            dropped_lines=control[_DROPPED_LINES],
        )

    def close(self) -> None:
        """Let go of the memory; the other processes keep theirs. Idempotent."""
        if self._bell < 0:
            return
        self._slots.clear()
        for words in (*self._headers, self._control):
            words.release()
        self._memory.close()
        os.close(self._bell)
        self._bell = -1

    def __reduce__(self) -> tuple[Any, ...]:
        return _attach, (self.name, self.shape, self._memory, reduction.DupFd(self._bell))

    def _wait(self, timeout_s: float) -> bool:
        deadline = time.monotonic() + timeout_s
        while self._control[_HEAD] == self._control[_TAIL]:
            remaining_s = deadline - time.monotonic()
            if remaining_s <= 0 or not self._ringing.poll(remaining_s * 1000):
                return False
            os.eventfd_read(self._bell)
        return True

    def _check(self, header: memoryview, block: int) -> None:
        if header[_SEQUENCE] != 2 * block + 2:
            raise DataError(
                f"ring {self.name}: block {block} is torn or stale (sequence {header[_SEQUENCE]})",
                possible=f"sequence {2 * block + 2} while exactly one process produces and one consumes",
            )

    def _view(self, index: int) -> Slot:
        shape = self.shape
        flags_offset = shape.flags_offset + index * shape.rows * 2
        flags = np.frombuffer(self._memory.map, np.uint16, shape.rows, flags_offset)
        pixels_offset = shape.pixels_offset + index * shape.slot_stride
        pixels = np.frombuffer(self._memory.map, shape.dtype, shape.rows * shape.width, pixels_offset)
        return Slot(pixels.reshape(shape.rows, shape.width), flags)


def _write_losses(header: memoryview, losses: Sequence[Loss]) -> None:
    if len(losses) > MAX_LOSSES:
        raise UsageError(f"{len(losses)} losses before one ring slot", possible=f"up to {MAX_LOSSES}")
    for position, loss in enumerate(losses):
        at = _LOSSES + 3 * position
        header[at], header[at + 1] = loss.first_line, loss.count
        header[at + 2] = _CAUSES.index(loss.cause)
    header[_LOSS_COUNT] = len(losses)


def _read_losses(header: memoryview) -> tuple[Loss, ...]:
    words = header[_LOSSES : _LOSSES + 3 * header[_LOSS_COUNT]].tolist()
    return tuple(
        Loss(first, count, _CAUSES[cause])
        for first, count, cause in zip(words[::3], words[1::3], words[2::3], strict=True)
    )


def _page_up(size: int) -> int:
    return -(-size // _PAGE_BYTES) * _PAGE_BYTES


def _attach(name: str, shape: RingShape, memory: SharedBytes, bell: Any) -> Ring:
    return Ring(name, shape, memory, bell.detach())
