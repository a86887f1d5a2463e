"""A test that leaves something behind fails: threads, child processes, descriptors, shared memory.

What is left is looked at again and again for a grace period, since processes and sockets take a moment to
go. Things that a library makes once and keeps for the life of the process are made before the first test.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import importlib
import importlib.util
import multiprocessing.resource_tracker
import os
import re
import sys
import threading
import time
import types
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
import zarr
import zarr.storage
from hypothesis import HealthCheck, settings
from numcodecs import blosc

from acquire.cores import limit_blas, usable_cores
from acquire.forward.kernels import transpose_frames
from acquire.processes.nursery import warm_up

pytest_plugins = ["left_out", "unforced"]

POOL_THREADS = re.compile(r"asyncio_\d+|zarr|fsspec|pydevd|AnyIO worker thread")
"""Worker threads that libraries keep for reuse; they hold nothing of a test."""

KEPT_FILES = re.compile(r"/mpl-data/fonts/")
"""Files that libraries keep open for reuse."""

KEPT_PROCESSES = re.compile(r"/chromium")
"""Of a browser that the tests of a module share, and that ends with it: its helpers come and go."""

FIRST_PAUSE_S = 0.01

Found = dict[str, str]
"""Key of a thing that exists → how to name it to the reader."""


MOST_WORKERS = 8
"""More would wait for the longest test, and each imports everything."""

CLEANING_UP_S = 120.0
"""What a test that failed may take to end: one that was late may hang there again."""

# Threads of BLAS and OpenMP wait for one another in a spin: on two cores that others use too, small products
# take 14 times the processor time. BLAS is loaded by now; child processes and OpenMP read the environment.
limit_blas(int(os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")))
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
settings.register_profile("any speed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any speed")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addini("leak_grace_s", "seconds that a test's leftovers may take to go", default="30")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Two processes per core for folders, since many tests wait; files and single tests run in this one."""
    if all(Path(asked).is_dir() for asked in config.args):
        return min(2 * usable_cores(), MOST_WORKERS)
    return 0


@pytest.hookimpl(trylast=True)
def pytest_exception_interact(node: pytest.Item | pytest.Collector) -> None:
    """pytest has just called off the end of a process that hangs, for a debugger's sake."""
    if isinstance(node, pytest.Item):
        faulthandler.dump_traceback_later(CLEANING_UP_S, file=sys.__stderr__, exit=True)


@pytest.fixture(scope="session", autouse=True)
def _made_once() -> None:
    """What lives as long as the process, however many tests use it."""
    multiprocessing.resource_tracker.ensure_running()
    warm_up("acquire.stream.recorder", "acquire.stream.watcher", "acquire.sim.devices")
    if importlib.util.find_spec(
        "dask"
    ):  # xarray reads through it where it is there, in threads that it keeps
        importlib.import_module("dask").config.set(scheduler="synchronous")
    array = zarr.create_array(zarr.storage.MemoryStore(), shape=(1,), dtype="u1")
    array[:] = np.ones(1, "u1")
    assert array[0] == 1
    blosc.compress(b"1", b"lz4", 1)  # makes its lock
    transpose_frames(np.zeros((1, 1, 1), np.float32), np.zeros((1, 1, 1), np.float32))  # numba's threads


@pytest.fixture(scope="session", autouse=True)
def _children_need_no_pytest() -> Iterator[None]:
    """A spawned child imports its parent's main module: with pytest's, half of its start would be that."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "__main__", types.ModuleType("__main__"))
        yield


@pytest.fixture(autouse=True)
def _nothing_left(request: pytest.FixtureRequest, _made_once: None) -> Iterator[None]:
    before = existing()
    yield
    grace_s = float(request.config.getini("leak_grace_s"))
    if left := leftovers(before, grace_s):
        pytest.fail("left behind: " + "; ".join(sorted(left.values())), pytrace=False)


def leftovers(before: Found, grace_s: float) -> Found:
    """What exists now and did not before, once ``grace_s`` has not made it go."""
    deadline, pause_s = time.monotonic() + grace_s, FIRST_PAUSE_S
    while left := {key: name for key, name in existing().items() if key not in before}:
        if time.monotonic() > deadline:
            return left
        gc.collect()
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, grace_s / 4)
    return {}


def existing() -> Found:
    return threads() | children() | descriptors() | shared_memory()


def threads() -> Found:
    alive = [thread for thread in threading.enumerate() if not POOL_THREADS.match(thread.name)]
    return {f"thread {id(thread)}": f"thread {thread.name!r}" for thread in alive}


def children() -> Found:
    """Descendants of this process, by number and birth, since numbers are used again."""
    found: Found = {}
    for number in descendants(os.getpid()):
        try:
            child = psutil.Process(number)
            if _is_kept(child):
                continue
            found[f"process {child.pid} {child.create_time()}"] = (
                f"process {child.pid} ({' '.join(child.cmdline())[-120:]}), {child.status()}"
            )
        except psutil.NoSuchProcess:
            continue  # gone while it was looked at: not left behind
    return found


def _is_kept(child: psutil.Process) -> bool:
    try:
        return KEPT_PROCESSES.search(child.exe()) is not None
    except psutil.Error:  # a zombie has no program any more, and is looked at as any other
        return False


def descendants(pid: int) -> Iterator[int]:
    """As psutil finds them, which reads every process of the machine, twice for each test."""
    if not Path("/proc/thread-self/children").exists():  # a kernel that does not list them
        yield from (child.pid for child in psutil.Process(pid).children(recursive=True))
        return
    for thread in Path(f"/proc/{pid}/task").glob("*"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it has ended
            for child in (thread / "children").read_text(encoding="ascii").split():
                yield int(child)
                yield from descendants(int(child))


def descriptors() -> Found:
    found: Found = {}
    for entry in list(Path("/proc/self/fd").iterdir()):
        try:
            target = entry.readlink()
        except FileNotFoundError:
            continue  # the descriptor of the listing itself
        if KEPT_FILES.search(str(target)):
            continue
        found[f"fd {entry.name} {target}"] = f"descriptor {entry.name} of {target}"
    return found


def shared_memory() -> Found:
    """Mappings of anonymous files and of named shared memory in this process."""
    maps = Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()
    shared = [line.split(maxsplit=5) for line in maps if "/memfd:" in line or "/dev/shm/" in line]
    return {f"map {fields[0]} {fields[4]}": f"mapping of {fields[5]}" for fields in shared}
