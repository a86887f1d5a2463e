"""Where sub-segments are solved: in this process, in processes of this machine, on a Dask cluster.

All three take tasks by `submit` and return futures; the caller keeps at most ``workers`` + 1 of them waiting.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
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
FOR_ALL = (signal.SIGINT, signal.SIGHUP, signal.SIGTERM)
"""Signals that reach all processes of a command at once."""
GRACE_S = 30.0
"""Time after SIGTERM in which a process can hand over its best result."""
STEPS_PER_TASK = 200
"""Resolution of the progress of a task in another process."""


class Pool(Protocol):
    """Solves tasks, ``workers`` of them at a time."""

    workers: int

    def submit(self, task: Task) -> Future[Part]:
        """Return at once with the future result, except for `Here`, which solves the task first."""
        ...

    def share_done(self) -> float:
        """Return the number of tasks done, counting those in progress in part."""
        ...

    def stop(self) -> None:
        """End tasks in progress with their best result; waiting ones are still solved unless cancelled."""


class Here:
    """Solves one task at a time, in this process, during its submission."""

    workers = 1

    def __init__(self, watch: Callable[[float], bool] | None = None) -> None:
        """``watch`` is called with the number of tasks done so far and returns whether to stop."""
        self._watch, self._done, self._stopped = watch, 0.0, False

    def submit(self, task: Task) -> Future[Part]:
        """Solve the task, and return its result as a future that is done."""
        future: Future[Part] = Future()
        future.set_result(solve(task, self))
        return future

    def share_done(self) -> float:
        """Return the tasks done, with the share of the one in progress."""
        return self._done

    def stop(self) -> None:
        """Make the task in progress, and all that follow, end with their best result."""
        self._stopped = True

    def advance(self, share: float) -> None:
        """Count progress of the task, and ask whether to stop."""
        self._done += share
        if self._watch is not None and self._watch(self._done):
            self._stopped = True

    def is_set(self) -> bool:
        """Return whether to stop, which the solver asks after every iteration."""
        return self._stopped


class Processes:
    """``workers`` processes of this machine, each with its share of the cores."""

    def __init__(self, executor: ProcessPoolExecutor, workers: int, shared: _Shared) -> None:
        self.workers, self._executor, self._shared = workers, executor, shared

    def submit(self, task: Task) -> Future[Part]:
        """Hand the task to a process, which is started if there are fewer than ``workers``."""
        # A process may be started by this, which takes seconds.
        with _interrupts_blocked():
            return self._executor.submit(_solve_in_worker, task)

    def share_done(self) -> float:
        """Return the tasks done, with those in progress in part, as their processes have reported."""
        return self._shared.done

    def stop(self) -> None:
        """Make the tasks of all processes end after the iteration in progress."""
        self._shared.stop.set()


class _Shared:
    """State that the processes of a pool share; each gets it at its start."""

    def __init__(self) -> None:
        # It is not a fork, which would copy locks that this process's threads hold.
        context = multiprocessing.get_context("spawn")
        self.stop = context.Event()
        self._steps = context.Semaphore(0)  # a counter: the shared memory of a Value would outlive the pool
        self._share = 0.0

    @property
    def done(self) -> float:
        """Number of tasks done in all processes."""
        return self._steps.get_value() / STEPS_PER_TASK

    def advance(self, share: float) -> None:
        # The remainder is kept, so that no share is lost to rounding.
        steps, self._share = divmod(self._share + share * STEPS_PER_TASK, 1)
        for _ in range(int(steps)):
            self._steps.release()

    def is_set(self) -> bool:
        return self.stop.is_set()


class Cluster:
    """The workers of an existing Dask cluster. They read the recording themselves."""

    def __init__(self, client: Any) -> None:
        self.workers = max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
        # Tasks are not pure: the result of an equal task that was solved before is not reused.
        self._executor = client.get_executor(pure=False, retries=2)
        self._lock, self._done = threading.Lock(), 0

    def submit(self, task: Task) -> Future[Part]:
        """Hand the task to the cluster, without its deadline, which another machine's clock cannot keep."""
        without_deadline = replace(task, due=None)  # the deadline is a time of this machine's clock
        future: Future[Part] = self._executor.submit(solve, without_deadline, _NoWatch())
        future.add_done_callback(self._count)
        return future

    def share_done(self) -> float:
        """Return the number of whole tasks done: a cluster does not report their iterations."""
        return self._done

    def stop(self) -> None:
        """Do nothing: tasks that a cluster works on are left to it."""

    def _count(self, _: Future[Part]) -> None:
        with self._lock:
            self._done += 1


class _NoWatch:
    """Ignores the progress and never requests a stop."""

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
    """Open a pool for ``tasks`` tasks: on the cluster at address ``cluster``, else on this machine's cores.

    ``watch`` is called from inside a task if the caller itself solves the tasks (`Here`).
    """
    if workers is not None and workers < 1:
        raise UsageError(f"{workers} workers cannot solve anything", possible="1 or more")
    if cluster is not None:
        with _cluster(cluster) as pool:
            yield pool
        return
    cores = usable_cores()
    count = min(tasks, cores if workers is None else workers)
    # There is no second process, whose start takes seconds.
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
    except KeyboardInterrupt:  # the tasks in progress are no longer needed
        for child in multiprocessing.active_children():
            child.kill()
        raise
    finally:
        # `shutdown` waits for the tasks in progress, which end at their next iteration.
        shared.stop.set()
        executor.shutdown(cancel_futures=True)


@contextmanager
def _cluster(address: str) -> Iterator[Cluster]:
    try:
        from distributed import Client, Security
        from distributed.comm.core import connect
    except ModuleNotFoundError as error:
        raise UsageError(
            "--dask needs dask.distributed, which is not installed", hint="pip install 'tdi-acquire[dask]'"
        ) from error

    async def knock() -> None:
        secrets = Security().get_connection_args("client")  # type: ignore[no-untyped-call]
        (await connect(address, timeout=SCHEDULER_TIMEOUT_S, **secrets)).abort()  # type: ignore[no-untyped-call]

    try:
        # A Client that cannot connect stays half constructed: closing it takes 20 s and prints a traceback.
        asyncio.run(knock())
        client = Client(  # type: ignore[no-untyped-call]
            address, timeout=SCHEDULER_TIMEOUT_S, set_as_default=False
        )
    except (OSError, ValueError) as error:
        raise UsageError(
            f"no Dask scheduler answers on {address}: {error}", possible="tcp://HOST:8786"
        ) from error
    with client:
        if not client.scheduler_info(n_workers=-1)["workers"]:
            raise UsageError(
                f"the Dask cluster on {address} has no workers",
                hint=f"dask worker {address}, on every machine",
            )
        yield Cluster(client)


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Hold back Ctrl-C, also in a process that is started meanwhile: it inherits this, see `_begin_worker`.

    Otherwise a Ctrl-C during its start would end it, and the work of all of them would count as failed.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, FOR_ALL)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_worker: _Shared | None = None


def _begin_worker(shared: _Shared, threads: int) -> None:
    """Initialise a worker process: ignore Ctrl-C, keep libraries to this process's share of the cores."""
    global _worker  # noqa: PLW0603  # the only place for the state that a worker process gets at its start
    import numba

    # A terminal sends Ctrl-C, and its end, to all of its processes; `timeout` and batch systems send SIGTERM.
    # The parent, which gets it as well, asks this one to stop.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _end_later)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, FOR_ALL)
    # Numba refuses more threads than it was started with.
    numba.set_num_threads(min(threads, numba.get_num_threads()))
    limit_blas(threads)
    _worker = shared


def _end_later(_number: int, _frame: object) -> None:
    """End this process in a while, unless the parent has had it ended by then."""
    # A daemon thread, which does not keep a process that ends by itself.
    timer = threading.Timer(GRACE_S, os._exit, (1,))
    timer.daemon = True
    timer.start()


def _solve_in_worker(task: Task) -> Part:
    # This is a function of the module, because it is sent by its name. What the processes share cannot be
    # sent with a task.
    assert _worker is not None
    return solve(task, _worker)
