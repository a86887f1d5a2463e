"""Cores available to this process, and limits on the threads of its linear algebra.

BLAS threads busy-wait for one another. If other programs use the cores, every product waits for a thread that
is not running: two threads on two busy cores are several times slower than one.
"""

from __future__ import annotations

import math
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_Result = TypeVar("_Result")

LOOKS, LOOK_S = 5, 0.004
"""Number and spacing of looks at the running threads: those that run at every look count as lasting."""
SLICES, SLICE_S = 9, 0.004
"""Slices of processor time over which a thread's share of a core is measured."""


def usable_cores() -> int:
    """Return how many cores this process may use, by its affinity and its control group's quota."""
    return max(1, math.ceil(min(len(os.sched_getaffinity(0)), _quota())))


def idle_cores() -> int:
    """Return how many of the usable cores no other thread occupies now; at least one."""
    # All threads of the machine are counted, so they are compared with all of its cores.
    spare = (os.cpu_count() or 1) - (_running() - 1)
    return max(1, min(usable_cores(), spare))


def limit_blas(threads: int) -> threadpool_limits:
    """Limit every BLAS loaded in this process to ``threads``; as a context manager, until its end.

    BLAS reads its environment variables when it is loaded, too early for a process that already has numpy.
    """
    return threadpool_limits(threads, user_api="blas")


def slowness() -> float:
    """Measure how many times longer than on a core of its own this thread takes now; at least 1.

    The scheduler shares cores in slices of some milliseconds, so the time is averaged over several of them.
    The worst is left out, since a single hiccup says nothing about the share.
    """
    took_s = []
    for _ in range(SLICES):
        began, used = time.monotonic(), time.thread_time()
        while time.thread_time() - used < SLICE_S:
            pass
        took_s.append(time.monotonic() - began)
    return max(1.0, (sum(took_s) - max(took_s)) / (SLICE_S * (SLICES - 1)))


def process_age_s(process: Path = Path("/proc/self")) -> float:
    """Return the age of a process in seconds, from the start time in ``stat``."""
    # The start time is field 22. Fields are counted from the bracket that closes the name (field 2), since a
    # name may hold spaces and brackets.
    began = int((process / "stat").read_text(errors="replace").rpartition(")")[2].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - began / os.sysconf("SC_CLK_TCK")


@contextmanager
def limit_threads(threads: int) -> Iterator[None]:
    """Limit BLAS and compiled loops (numba, if loaded), whose threads busy-wait too, to ``threads``."""
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


def granted_threads() -> int:
    """Return how many threads compiled loops may use now (`limit_threads`); 1 without numba."""
    numba = sys.modules.get("numba")
    return int(numba.get_num_threads()) if numba else 1


def side_by_side(first: Callable[[], _Result], second: Callable[[], _Result]) -> tuple[_Result, _Result]:
    """Return the results of both; ``second`` runs in a thread of its own, which has ended by then.

    That takes a tenth of a millisecond, and gains only what both do without the interpreter's lock, as BLAS.
    """
    with ThreadPoolExecutor(1, "side by side") as helper:
        other = helper.submit(second)
        return first(), other.result()


def _running() -> int:
    """Return the threads of this machine that run or want to, this one among them."""
    fewest = math.inf
    for _ in range(LOOKS):
        # The fourth field is the number of running threads, a slash, and that of all threads.
        fewest = min(fewest, int(Path("/proc/loadavg").read_text(encoding="ascii").split()[3].split("/")[0]))
        time.sleep(LOOK_S)
    return max(1, int(fewest))


def _quota(root: Path = Path("/sys/fs/cgroup")) -> float:
    """Return the control group's quota in cores (version 2, or 1); infinite without a limit."""
    for files in ("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us"):
        if all((root / name).exists() for name in files):
            # Version 2 has both numbers in one file.
            limit, period = " ".join((root / name).read_text(encoding="ascii") for name in files).split()
            return math.inf if limit in {"max", "-1"} else int(limit) / int(period)
    return math.inf
