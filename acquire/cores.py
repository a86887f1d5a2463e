"""How many cores there are for this process, and linear algebra that keeps to a number of threads.

BLAS' threads wait for one another in a spin. Where others use the cores, each product then waits for a thread
that does not run: two threads on two busy cores are several times slower than one.
"""

from __future__ import annotations

import math
import os
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    from collections.abc import Iterator

LOOKS, LOOK_S = 5, 0.004
"""Threads that run in each of several looks are there to stay."""
SLICES, SLICE_S = 9, 0.004
"""Of processor time, over which a thread's share of a core is measured."""


def usable_cores() -> int:
    """Cores that this process may use: by its affinity, and by its control group's quota (containers)."""
    return max(1, math.ceil(min(len(os.sched_getaffinity(0)), _quota())))


def idle_cores() -> int:
    """Of these, as many as nobody else uses now; at least one."""
    spare = (os.cpu_count() or 1) - (_running() - 1)
    return max(1, min(usable_cores(), spare))


def limit_blas(threads: int) -> threadpool_limits:
    """Every BLAS loaded in this process uses at most so many threads; as a context manager, until it ends.

    The environment variables that BLAS reads at its start come too late in a process that has numpy already.
    """
    return threadpool_limits(threads, user_api="blas")


def slowness() -> float:
    """How many times longer than on a core of its own this thread takes now; at least 1.

    Cores are shared in slices of some milliseconds, over which the time is taken, but for the worst: a hiccup
    is no share.
    """
    took_s = []
    for _ in range(SLICES):
        began, used = time.monotonic(), time.thread_time()
        while time.thread_time() - used < SLICE_S:
            pass
        took_s.append(time.monotonic() - began)
    return max(1.0, (sum(took_s) - max(took_s)) / (SLICE_S * (SLICES - 1)))


def process_age_s(process: Path = Path("/proc/self")) -> float:
    """Since a process began; its start is the 22nd field of ``stat``, counted behind the name's bracket."""
    began = int((process / "stat").read_text(errors="replace").rpartition(")")[2].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - began / os.sysconf("SC_CLK_TCK")


@contextmanager
def limit_threads(threads: int) -> Iterator[None]:
    """The same for BLAS and for compiled loops (numba, where it is loaded), whose threads spin likewise."""
    numba = sys.modules.get("numba")
    before = numba.get_num_threads() if numba else 0
    with limit_blas(threads):
        try:
            if numba:
                numba.set_num_threads(min(threads, before))
            yield
        finally:
            if numba:
                numba.set_num_threads(before)


def _running() -> int:
    """Threads on this machine that run or want to, this one among them."""
    fewest = math.inf
    for _ in range(LOOKS):
        fewest = min(fewest, int(Path("/proc/loadavg").read_text(encoding="ascii").split()[3].split("/")[0]))
        time.sleep(LOOK_S)
    return max(1, int(fewest))


def _quota(root: Path = Path("/sys/fs/cgroup")) -> float:
    """Cores' worth of time that the control group may take (version 2, or 1); infinite without a limit."""
    for files in ("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us"):
        if all((root / name).exists() for name in files):
            limit, period = " ".join((root / name).read_text(encoding="ascii") for name in files).split()
            return math.inf if limit in {"max", "-1"} else int(limit) / int(period)
    return math.inf
