"""The stream that every writer gets, and its measurement; needs only numpy.

Blocks of 1024 lines of 4640 px, 8 bit, of arm a and b in turn, from touched memory, as fast as possible.
The clock stops when everything is closed and forced to the medium, since a page cache is not a disk.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from pathlib import Path
from typing import Protocol

import numpy as np

ARMS = ("a", "b")
LINES, PIXELS = 1024, 4640
BLOCK_BYTES = LINES * PIXELS
DIFFERENT = 8


class Writer(Protocol):
    """Interface of a peer's script."""

    def append(self, arm: str, block: np.ndarray) -> None: ...
    def close(self) -> None: ...


def blocks() -> list[np.ndarray]:
    """Page-aligned blocks that differ from one another."""
    rng = np.random.default_rng(1)
    memory = np.empty((DIFFERENT + 1) * BLOCK_BYTES, np.uint8)
    start = -memory.ctypes.data % 4096
    stack = memory[start : start + DIFFERENT * BLOCK_BYTES].reshape(DIFFERENT, LINES, PIXELS)
    profile = 100 + 50 * np.sin(np.linspace(0, 20, PIXELS))
    for block in stack:
        block[:] = (profile + 8 * rng.standard_normal((LINES, PIXELS), np.float32)).clip(1, 254)
    return list(stack)


def measure(writer: Writer, directory: Path, count: int) -> None:
    """Write ``count`` blocks of each arm, and print the cost as JSON."""
    stack, slowest_s = blocks(), 0.0
    begun_s, begun_cpu_s = time.perf_counter(), _cpu_s()
    for k in range(count):
        for arm in ARMS:
            before_s = time.perf_counter()
            writer.append(arm, stack[k % DIFFERENT])
            slowest_s = max(slowest_s, time.perf_counter() - before_s)
    writer.close()
    # Time every writer until its bytes are on the medium, even if it leaves that to the system.
    for path in directory.rglob("*"):
        if path.is_file():
            fd = os.open(path, os.O_RDONLY)
            os.fsync(fd)
            os.close(fd)
    elapsed_s, cpu_s = time.perf_counter() - begun_s, _cpu_s() - begun_cpu_s
    gigabytes = 2 * count * BLOCK_BYTES / 1e9
    result = {
        "mb_per_s": gigabytes * 1e3 / elapsed_s,
        "cpu_s_per_gb": cpu_s / gigabytes,
        "slowest_ms": slowest_s * 1e3,
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
    }
    json.dump(result, sys.stdout)


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
