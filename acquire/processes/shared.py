"""Shared memory of the processes of one run: anonymous files, passed to child processes by descriptor.

An anonymous file (memfd) has no name that could outlive a killed process: the kernel frees it with the last
descriptor and mapping. No resource tracker is involved.
"""

from __future__ import annotations

import mmap
import os
from multiprocessing import reduction
from pathlib import Path
from typing import Any

from acquire.errors import DeviceError

WORD_BYTES = 8


class SharedBytes:
    """``size`` bytes, initially 0; mapped and touched in every process that has them.

    They can be pickled only while a child is being started; the child gets the same bytes.
    """

    def __init__(self, name: str, size: int, fd: int | None = None) -> None:
        self.name = name
        self.size = size
        if fd is None:
            if size > (available := available_bytes()):
                raise DeviceError(
                    f"{name} needs {size / 2**20:.0f} MiB of shared memory",
                    possible=f"{available / 2**20:.0f} MiB",
                    hint="fewer or shorter ring slots, or fewer seconds (stream.ring_slots, ring_seconds)",
                )
            fd = os.memfd_create(f"acquire-{name}")
            try:
                # Fail now, rather than with SIGBUS at a later store into a page that cannot be allocated.
                os.posix_fallocate(fd, 0, size)
            except OSError as error:
                os.close(fd)
                raise DeviceError(
                    f"{name} needs {size / 2**20:.0f} MiB of shared memory: {error.strerror}",
                    hint="fewer or shorter ring slots",
                ) from error
        self._fd = fd
        # Populate now: a page's first touch during capture would cost more than the copy itself.
        self.map = mmap.mmap(self._fd, size, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE)

    def words(self, first: int, count: int) -> memoryview:
        """Return ``count`` signed 64-bit words from word ``first``; a store of one word is never torn."""
        start = first * WORD_BYTES
        return memoryview(self.map)[start : start + count * WORD_BYTES].cast("q")

    @property
    def path(self) -> str:
        """A path to the bytes for processes not started from here; valid while this process lives."""
        return f"/proc/{os.getpid()}/fd/{self._fd}"

    def close(self) -> None:
        """Unmap; the owner of views must have released them before. Idempotent."""
        if not self.map.closed:
            self.map.close()
            os.close(self._fd)

    def __reduce__(self) -> tuple[Any, ...]:
        # The descriptor, not the name: the file has no path under which the child could open it. The child's
        # copy is independent of ours, so that either may close first.
        return _attach, (self.name, self.size, reduction.DupFd(self._fd))


class Counters:
    """Named whole numbers that one process writes and any process reads, without a lock or a pipe."""

    def __init__(self, names: tuple[str, ...], memory: SharedBytes | None = None) -> None:
        self.names = names
        self._memory = memory or SharedBytes("counters", len(names) * WORD_BYTES)
        self._words = self._memory.words(0, len(names))
        self._position = {name: position for position, name in enumerate(names)}

    def __getitem__(self, name: str) -> int:
        return int(self._words[self._position[name]])

    def __setitem__(self, name: str, value: int) -> None:
        self._words[self._position[name]] = value

    def add(self, name: str, value: int) -> None:
        # Not atomic: correct only because no other process writes this number at the same time.
        self._words[self._position[name]] += value

    def close(self) -> None:
        """Release the memory. Idempotent."""
        self._words.release()
        self._memory.close()

    def __reduce__(self) -> tuple[Any, ...]:
        return Counters, (self.names, self._memory)


def available_bytes() -> int:
    """Return the memory that is available without swapping, by the kernel's estimate."""
    with Path("/proc/meminfo").open(encoding="ascii") as lines:
        sizes = dict(line.split(":") for line in lines)
    return int(sizes["MemAvailable"].split()[0]) * 1024


def _attach(name: str, size: int, descriptor: Any) -> SharedBytes:
    return SharedBytes(name, size, descriptor.detach())
