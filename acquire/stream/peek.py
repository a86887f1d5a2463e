"""A read-only view of a ring for any process of the same user, outside the capture. Nobody waits for it.

The memory is mapped read-only, so that no defect of the reader can harm a line; the reader's position is kept
in its own process and not in the ring. A slow or dead reader delays nobody: when the run ends, its owner
empties the memory (`Ring.discard`) even if a reader still has it mapped.
"""

from __future__ import annotations

import mmap
import os
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import DeviceError
from acquire.processes.shared import SharedBytes
from acquire.stream.ring import Ring, RingShape

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.stream.ring import RingBlock


class ForeignBytes(SharedBytes):
    """Memory of another process, mapped read-only by the path that its owner publishes."""

    def __init__(self, path: str, size: int) -> None:
        """Map the memory. Raises DeviceError if it no longer exists, or may not be read."""
        self.name, self.size = path, size
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise DeviceError(
                f"the lines cannot be read: {path}: {error.strerror}",
                hint="run as the daemon's user, on its host, with at least the daemon's capabilities",
            ) from error
        # The path names a number of the owner's, which may stand for another file by now.
        if os.fstat(self._fd).st_size != size:
            os.close(self._fd)
            raise DeviceError(
                f"the lines cannot be read: {path} is not the memory of this ring",
                hint="again in a moment: the instrument was disarmed or armed again",
            )
        try:
            self.map = mmap.mmap(self._fd, size, flags=mmap.MAP_SHARED, prot=mmap.PROT_READ)
        except BaseException:
            os.close(self._fd)
            raise


class Peek:
    """Follows one ring from its newest block on.

    ::

        while (block := peek.next()) is not None:
            result = look_at(block)
            if peek.took():            # the block was whole until now
                keep(result)
    """

    def __init__(self, name: str, path: str, shape: RingShape) -> None:
        """Open the ring. Raises DeviceError if its memory cannot be mapped."""
        self._ring = Ring(name, shape, ForeignBytes(path, shape.size))
        self._number = self._ring.head
        self.lapped = 0
        """Number of blocks that were overwritten unread."""

    def next(self) -> RingBlock | None:
        """Return the next block, or None if there is none now; the same one until `took`."""
        slots = self._ring.shape.slots
        while (head := self._ring.head) > self._number:
            # As in `Observer.acquire`: the oldest of all slots is the producer's next, and too late to read.
            waiting = head - self._number
            block = self._ring.read(self._number) if waiting < slots else None
            if block is not None:
                return block
            self._skip(max(1, waiting - slots // 2))
        return None

    def took(self) -> bool:
        """Advance to the next block; return whether this one stayed whole. If not, it counts as unread."""
        whole = self._ring.is_whole(self._number)
        if whole:
            self._number += 1
        else:
            self._skip(1)
        return whole

    @property
    def newest_line(self) -> int:
        """The line after the last committed one; 0 before the first."""
        return self._ring.newest_line

    def stretch(self, first_line: int, count: int) -> tuple[NDArray[Any], NDArray[np.uint16]] | None:
        """Return a copy of ``count`` past lines (line, pixel) and their flags; None if a line is missing."""
        shape, head = self._ring.shape, self._ring.head
        pixels = np.empty((count, shape.width), shape.dtype)
        flags = np.empty(count, np.uint16)
        end = first_line + count
        for number in range(head - 1, max(-1, head - shape.slots), -1):
            block = self._ring.read(number)
            if block is None or block.end_line < end:
                return None  # overwritten, or lines are missing in between
            part = block.part(first_line, end)
            if len(part):
                rows = slice(part.first_line - first_line, end - first_line)
                pixels[rows] = part.pixels
                flags[rows] = part.flags
                end = part.first_line
            del block, part  # their views keep the memory mapped
            if not self._ring.is_whole(number):
                return None
            if end <= first_line:
                return pixels, flags
        return None

    def close(self) -> None:
        """Release the memory; views of blocks must be gone. Idempotent."""
        self._ring.close()

    def _skip(self, blocks: int) -> None:
        self.lapped += blocks
        self._number += blocks
