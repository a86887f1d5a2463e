"""Memory that ends for chosen processes: a control group with a limit, whose kernel takes what it takes."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Self

V1, V2 = Path("/sys/fs/cgroup/memory"), Path("/sys/fs/cgroup")
HOG = """
import os, sys
from pathlib import Path
group, events = Path(sys.argv[1]), Path(sys.argv[2])
(group / "cgroup.procs").write_text(str(os.getpid()))
begun, taken = events.read_text(), []
while events.read_text() == begun:                     # until the kernel has taken one
    taken.append(bytes(2**20))
    taken[-1] = bytearray(taken[-1])                   # written to: zeros alone take no memory
"""
END_S = 120.0
ROOM_BYTES = 256 * 2**20
"""For the one that takes the memory: it is then the largest of those that are nobody's choice."""
FIRST = "1000"
"""Score of those that the kernel kills rather than the one that takes the memory."""


class MemoryGroup:
    """Processes that share a limit once they `run_out`. Raises OSError where this is not allowed."""

    def __init__(self) -> None:
        self._root = V1 if V1.is_dir() else V2
        self.path = self._root / f"acquire-test-{os.getpid()}"
        self.path.mkdir()
        old = self._root == V1
        self._limit = self.path / ("memory.limit_in_bytes" if old else "memory.max")
        self._usage = self.path / ("memory.usage_in_bytes" if old else "memory.current")
        self._events = self.path / ("memory.oom_control" if old else "memory.events")
        try:
            self._limit.write_text("-1" if old else "max")
            self._kills()
        except (OSError, TypeError):
            self.path.rmdir()
            raise OSError("no limit of memory can be set here") from None

    def _kills(self) -> int:
        return int(re.search(r"^oom_kill (\d+)$", self._events.read_text(), re.MULTILINE)[1])  # type: ignore[index]

    @property
    def pids(self) -> list[int]:
        return [int(word) for word in (self.path / "cgroup.procs").read_text().split()]

    def run_out(self, victim: int | None = None) -> set[int]:
        """Let somebody else take the memory that there is, until the kernel has killed one of the group for
        it: ``victim``, or whom it chooses. Who takes it may be killed for it, too, but not alone.

        Who is gone.
        """
        begun = {pid for pid in self.pids if victim in (None, pid)}
        for pid in begun:
            Path(f"/proc/{pid}/oom_score_adj").write_text(FIRST)
        unlimited = self._limit.read_text()
        self._limit.write_text(str(int(self._usage.read_text()) + ROOM_BYTES))
        words = [sys.executable, "-c", HOG, str(self.path), str(self._events)]
        try:
            subprocess.run(words, check=False, timeout=END_S)
        finally:
            self._limit.write_text("-1" if self._root == V1 else unlimited)
        deadline = time.monotonic() + END_S
        while not (gone := begun - set(self.pids)):  # what was killed takes a moment to leave
            assert time.monotonic() < deadline, "the kernel has killed none of the group"
            time.sleep(0.02)
        return gone

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for pid in self.pids:
            with contextlib.suppress(ProcessLookupError):  # it has ended
                (self._root / "cgroup.procs").write_text(str(pid))
        deadline = time.monotonic() + END_S
        while True:
            try:
                self.path.rmdir()
            except OSError:  # what was killed is still leaving
                assert time.monotonic() < deadline
                time.sleep(0.05)
            else:
                return


def can_limit_memory() -> bool:
    if os.geteuid() != 0:  # the one who takes the memory must not be taken for it
        return False
    try:
        with MemoryGroup():
            return True
    except OSError:
        return False
