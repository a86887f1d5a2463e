"""Where sub-segments are solved: in this process, in processes of this machine, on a Dask cluster.

All three take tasks by `submit` and give futures; the caller keeps at most ``workers`` + 1 of them waiting.
"""

from __future__ import annotations

import multiprocessing
import signal
import threading
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

from acquire.cores import idle_cores, limit_blas, limit_threads, usable_cores
from acquire.errors import UsageError
from acquire.reconstruct.work import Part, Task, solve

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

SCHEDULER_TIMEOUT_S = 10
STEPS_PER_TASK = 200
"""How finely the progress of a task in another process is known."""


class Pool(Protocol):
    """Solves tasks. ``workers`` of them at a time."""

    workers: int

    def submit(self, task: Task) -> Future[Part]: ...

    def share_done(self) -> float:
        """Tasks done, those that are being solved counted in part."""
        ...

    def stop(self) -> None:
        """What is being solved ends with the best so far; what waits is still solved unless cancelled."""


class Here:
    """One task at a time, in this process, as it is submitted; ``watch`` is told how far it is."""

    workers = 1

    def __init__(self, watch: Callable[[float], bool] | None = None) -> None:
        """``watch`` takes the tasks done so far, and says whether to stop."""
        self._watch, self._done, self._stopped = watch, 0.0, False

    def submit(self, task: Task) -> Future[Part]:
        future: Future[Part] = Future()
        future.set_result(solve(task, self))
        return future

    def share_done(self) -> float:
        return self._done

    def stop(self) -> None:
        self._stopped = True

    def advance(self, share: float) -> None:
        self._done += share
        if self._watch is not None and self._watch(self._done):
            self._stopped = True

    def is_set(self) -> bool:
        return self._stopped


class Processes:
    """``workers`` processes of this machine, each with its share of the cores."""

    def __init__(self, executor: ProcessPoolExecutor, workers: int, shared: _Shared) -> None:
        self.workers, self._executor, self._shared = workers, executor, shared

    def submit(self, task: Task) -> Future[Part]:
        return self._executor.submit(_solve_in_worker, task)

    def share_done(self) -> float:
        return self._shared.done

    def stop(self) -> None:
        self._shared.stop.set()


class _Shared:
    """What the processes of a pool have in common; given to each at its start."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.stop = context.Event()
        self._steps = context.Semaphore(0)  # counts up: shared memory of a Value would outlive the pool
        self._share = 0.0

    @property
    def done(self) -> float:
        """Tasks done in all processes."""
        return self._steps.get_value() / STEPS_PER_TASK

    def advance(self, share: float) -> None:
        steps, self._share = divmod(self._share + share * STEPS_PER_TASK, 1)
        for _ in range(int(steps)):
            self._steps.release()

    def is_set(self) -> bool:
        return self.stop.is_set()


class Cluster:
    """The workers of a Dask cluster that is already there. They read the recording by themselves."""

    def __init__(self, client: Any) -> None:
        self.workers = max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
        self._executor = client.get_executor(pure=False, retries=2)
        self._lock, self._done = threading.Lock(), 0

    def submit(self, task: Task) -> Future[Part]:
        elsewhere = replace(task, due=None)  # by another clock
        future: Future[Part] = self._executor.submit(solve, elsewhere, _Nobody())
        future.add_done_callback(self._count)
        return future

    def share_done(self) -> float:
        return self._done

    def stop(self) -> None:
        """What a cluster works on is left to it."""

    def _count(self, _: Future[Part]) -> None:
        with self._lock:
            self._done += 1


class _Nobody:
    """Nobody looks on."""

    def advance(self, share: float) -> None: ...

    def is_set(self) -> bool:
        return False


@contextmanager
def open_pool(
    tasks: int,
    workers: int | None = None,
    cluster: str | None = None,
    watch: Callable[[float], bool] | None = None,
) -> Iterator[Pool]:
    """A pool for so many tasks: on the cluster at the address ``cluster``, else on this machine's cores.

    ``watch`` is called from inside a task where the caller has no time of its own (`Here`).
    """
    if workers is not None and workers < 1:
        raise UsageError(f"{workers} workers cannot solve anything", possible="1 or more")
    if cluster is not None:
        with _cluster(cluster) as pool:
            yield pool
        return
    cores = usable_cores()
    count = min(tasks, cores if workers is None else workers)
    if count <= 1:
        with limit_threads(idle_cores()):
            yield Here(watch)
        return
    shared = _Shared()
    executor = ProcessPoolExecutor(
        count, multiprocessing.get_context("spawn"), _begin_worker, (shared, max(1, cores // count))
    )
    try:
        yield Processes(executor, count, shared)
    except KeyboardInterrupt:  # nobody waits for what is being solved
        for child in multiprocessing.active_children():
            child.kill()
        raise
    finally:
        shared.stop.set()
        executor.shutdown(cancel_futures=True)


@contextmanager
def _cluster(address: str) -> Iterator[Cluster]:
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise UsageError(
            "--dask needs dask.distributed, which is not installed", hint="pip install 'tdi-acquire[dask]'"
        ) from error
    try:
        client = Client(  # type: ignore[no-untyped-call]
            address, timeout=SCHEDULER_TIMEOUT_S, set_as_default=False
        )
    except (OSError, ValueError) as error:
        raise UsageError(
            f"no Dask scheduler answers on {address}: {error}", possible="tcp://HOST:8786"
        ) from error
    with client:
        if not client.scheduler_info(n_workers=-1)["workers"]:
            raise UsageError(f"the Dask cluster on {address} has no workers")
        yield Cluster(client)


_worker: _Shared | None = None


def _begin_worker(shared: _Shared, threads: int) -> None:
    """In a new process: Ctrl-C is for the parent; libraries keep to this process's share of the cores."""
    global _worker  # noqa: PLW0603  # a process of a pool has no other place for what it is given at its start
    import numba

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    numba.set_num_threads(min(threads, numba.get_num_threads()))
    limit_blas(threads)
    _worker = shared


def _solve_in_worker(task: Task) -> Part:
    assert _worker is not None
    return solve(task, _worker)
