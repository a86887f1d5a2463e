"""Worker processes that start in milliseconds: forked from one that has imported their modules.

::

    owner ── job: a pickle | its descriptors ──▶ nursery ── fork ──▶ worker
      ▲                                           │  ▲                  │
      └──────── process number, how it ended ─────┘  └───── its end ────┘

The nursery only imports modules: it has one thread, no device, no file. Anything that must not be forked,
such as a GenTL producer or a library's threads, is loaded by the worker. The nursery ends with its owner,
since the kernel closes the owner's end of the socket; workers detect their owner's end themselves
(`acquire.processes.worker`). A nursery that has died is replaced, and its workers are not affected.

multiprocessing's own forkserver is not used: when it is killed, it reports its living children as dead (exit
code 255), and a successor would write to the ring at the same time as the recorder that it replaces. Here the
owner has a pidfd of every worker, which is reliable whichever process has died.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import io
import os
import pickle
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from multiprocessing import spawn
from multiprocessing.context import set_spawning_popen
from multiprocessing.reduction import ForkingPickler
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

_MOST_FDS = 250
"""Descriptors in one message; the kernel's limit is 253."""
_REAP_S = 1.0
"""Time for the nursery to report how a worker ended."""
UNKNOWN = 255
"""Exit code of a worker whose nursery has died, so that its real one is unknown."""
_START = "import sys; from acquire.processes import nursery; nursery.main(int(sys.argv[1]), sys.argv[2:])"


class Child:
    """The owner's view of one worker process, which may not be forked yet; then its number is unknown.

    Any thread may ask.
    """

    def __init__(self, status: socket.socket) -> None:
        # Two threads may both find a message there, and only one of them gets it: the other must not wait for
        # the next one, which comes at the process's end.
        status.setblocking(False)
        self._status = status
        self._receiving = threading.Lock()
        self._pidfd = -1
        self._pid: int | None = None
        self._exit_code: int | None = None
        self._dead_since_s: float | None = None

    def pid(self, timeout_s: float = 0.0) -> int | None:
        """Return its process number, or None if it is not forked within ``timeout_s``."""
        deadline = time.monotonic() + timeout_s
        while self._pid is None and self._exit_code is None and self._wait(deadline):
            continue
        return self._pid

    def exit_code(self, timeout_s: float = 0.0) -> int | None:
        """Return its exit code (negative: a signal), or None if it is still alive after ``timeout_s``.

        `UNKNOWN` if the nursery cannot report it any more.
        """
        deadline = time.monotonic() + timeout_s
        while self._exit_code is None and self._wait(deadline):
            continue
        return self._exit_code

    def kill(self) -> None:
        """Kill it."""
        # With the pidfd, not the number, which may belong to another process by now.
        if self._pidfd >= 0:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, signal.SIGKILL)

    def close(self) -> None:
        """Release its descriptors. Idempotent."""
        self._status.close()
        if self._pidfd >= 0:
            os.close(self._pidfd)
            self._pidfd = -1

    def _wait(self, deadline: float) -> bool:
        """Wait for the nursery's next message, or the process's end; return False if neither came in time."""
        sources = [fd for fd in (self._status.fileno(), self._pidfd) if fd >= 0]
        waiting = select.poll()
        for source in sources:
            waiting.register(source, select.POLLIN)
        while sources:
            ready = {fd for fd, _ in waiting.poll(max(0.0, deadline - time.monotonic()) * 1000)}
            if self._status.fileno() in ready:
                self._receive()
                return True
            if self._pidfd in ready:
                # The process has ended; a nursery that is dead, or stopped, will not report how.
                self._dead_since_s = self._dead_since_s or time.monotonic()
                if self._status.fileno() < 0 or time.monotonic() - self._dead_since_s > _REAP_S:
                    self._exit_code = UNKNOWN
                    return True
            if not ready or time.monotonic() >= deadline:
                return False
            time.sleep(_REAP_S / 100)  # it has ended: the nursery will report how
        return False

    def _receive(self) -> None:
        with self._receiving:
            try:
                word, fds, _, _ = socket.recv_fds(self._status, 64, 1, socket.MSG_CMSG_CLOEXEC)
            except BlockingIOError:
                return
            except OSError:
                word, fds = b"", []
            if fds:
                self._pid, self._pidfd = int(word), fds[0]
                return
            self._status.close()
            if word:
                self._exit_code = int(word)
            elif self._pidfd < 0:
                self._exit_code = UNKNOWN  # the nursery died before this process was forked


class Nursery:
    """The owner's side of the nursery: one process, which forks a worker for every `fork`."""

    def __init__(self, modules: tuple[str, ...] = ()) -> None:
        """Start the process, which then imports those of ``modules`` that exist."""
        self.modules = modules
        # Sequential packets keep a message together with its descriptors.
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # The nursery must find the modules that its owner finds, whose path may have been changed since.
        path = os.pathsep.join(entry for entry in sys.path if entry)
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603 - this package
                [sys.executable, "-c", _START, str(theirs.fileno()), *modules],
                stdin=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(),),
                # OpenBLAS would start threads when numpy is imported, and a forked worker has none of them.
                env={**os.environ, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"},
            )
        self.owner = os.getpid()

    @property
    def alive(self) -> bool:
        """Whether its process runs."""
        return self._process.poll() is None

    @property
    def pid(self) -> int:
        return self._process.pid

    def fork(self, name: str, target: Callable[..., None], *args: Any) -> Child:
        """Fork a process that calls ``target(*args)``. Raises errors of pickling, and OSError."""
        parcel = _Parcel()
        buffer = io.BytesIO()
        # multiprocessing pickles a pipe or a lock only while it is spawning a process: it then passes
        # descriptors to `parcel`.
        set_spawning_popen(parcel)  # type: ignore[arg-type]
        try:
            ForkingPickler(buffer, pickle.HIGHEST_PROTOCOL).dump((name, target, args))
        finally:
            set_spawning_popen(None)
        content = buffer.getvalue()
        here = spawn.get_preparation_data(name)
        keys = ["sys_path", "sys_argv", "dir"]
        if b"__main__" in content:  # it needs the owner's main module
            keys += ["init_main_from_name", "init_main_from_path"]
        place = {key: here[key] for key in keys if key in here}
        job = pickle.dumps((place, dict(os.environ), content))
        # The job is sent as an anonymous file, since a plan with its arrays may be larger than a packet,
        # which is limited by the socket's buffer.
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        page = os.memfd_create("acquire-job")
        try:
            with theirs, open(page, "wb", closefd=False) as file:
                file.write(job)
                file.flush()
                socket.send_fds(self._channel, [b"job"], [theirs.fileno(), page, *parcel.fds])
        except BaseException:
            ours.close()
            raise
        finally:
            os.close(page)
        return Child(ours)

    def close(self) -> None:
        """End the process; workers continue. Idempotent."""
        self._channel.close()
        # A fork of the owner has a copy of this object, but not the process: it is neither to be killed there
        # nor can it be waited for.
        if self.owner == os.getpid():
            self._process.kill()  # it has no state that could be lost
            self._process.wait()


class Own:
    """The nursery of one owner, created when it is first needed."""

    def __init__(self) -> None:
        self._nursery: Nursery | None = None
        self._changing = threading.Lock()

    def get(self) -> Nursery:
        """Return the nursery, a new one if there is none, or it was inherited by a fork, or has died."""
        with self._changing:
            found = self._nursery
            if found is None or found.owner != os.getpid():
                found = self._nursery = Nursery()
            elif not found.alive:
                found.close()
                found = self._nursery = Nursery(found.modules)
            return found

    def replace(self, new: Callable[[], Nursery | None]) -> None:
        """Close the nursery and take the one that ``new`` returns, with no `get` in between."""
        with self._changing:
            if self._nursery is not None:
                self._nursery.close()
            self._nursery = new()


_own = Own()


def nursery() -> Nursery:
    """Return the nursery of this process, replaced if it has died."""
    return _own.get()


def warm_up(*modules: str) -> None:
    """Have the nursery of this process import ``modules`` now, so that workers start at once."""
    _own.replace(lambda: Nursery(modules))


@atexit.register
def end() -> None:
    """End the nursery of this process. Idempotent."""
    _own.replace(lambda: None)


# ---- sending a job


class _Parcel:
    """Collects descriptors of pickled objects; the part of a ``popen`` object that multiprocessing uses."""

    def __init__(self) -> None:
        self.fds: list[int] = []

    def duplicate_for_child(self, fd: int) -> int:
        self.fds.append(fd)
        return len(self.fds) - 1

    def DupFd(self, index: int) -> Received:  # noqa: N802 - multiprocessing's name
        return Received(index)


@dataclass(frozen=True, slots=True)
class Received:
    """A descriptor that came with a job."""

    index: int

    def detach(self) -> int:
        """Return the descriptor's number in this process."""
        return _received[self.index]


_received: list[int] = []


def is_worker() -> bool:
    """Return whether this process is a nursery's worker, whose cores are for the capture path."""
    return bool(_received)


# ---- the nursery's process


def main(fd: int, modules: list[str]) -> None:
    """Main function of the nursery, and of every worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # sent to a terminal's foreground group: left to the owner
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    for module in modules:
        with contextlib.suppress(ImportError):  # a driver that is not installed: its worker reports it
            importlib.import_module(module)
    # A collection in a worker would write to every object's header, and so copy the shared pages.
    gc.collect()
    gc.freeze()
    page = _keep(socket.socket(fileno=fd))
    if page is None:
        return
    with open(page, "rb") as file:  # noqa: PTH123 - a descriptor
        file.seek(0)
        place, environment, job = pickle.load(file)  # noqa: S301 - from the owner, through a private socket
    # The owner's current environment: that of the nursery is as of its start.
    os.environ.clear()
    os.environ.update(environment)
    spawn.prepare(place)
    name, target, args = pickle.loads(job)  # noqa: S301 - as above
    with contextlib.suppress(OSError), open("/proc/self/comm", "w", encoding="utf-8") as comm:  # noqa: PTH123
        comm.write(f"acquire {name}"[:15])
    target(*args)


def _keep(channel: socket.socket) -> int | None:
    """Fork workers until the owner is gone, then return None. In a worker, return its job's descriptor."""
    waiting = select.poll()
    waiting.register(channel, select.POLLIN)
    children: dict[int, tuple[int, socket.socket]] = {}
    while True:
        for ready, _ in waiting.poll():
            if ready in children:
                waiting.unregister(ready)
                pid, status = children.pop(ready)
                _, ended = os.waitpid(pid, 0)  # at once: a pidfd is readable when its process has ended
                os.close(ready)
                with status, contextlib.suppress(OSError):  # the owner may be gone
                    status.send(str(os.waitstatus_to_exitcode(ended)).encode())
                continue
            _, fds, _, _ = socket.recv_fds(channel, 16, _MOST_FDS, socket.MSG_CMSG_CLOEXEC)
            if not fds:  # the end of the socket: the owner has closed it, or has died
                return None
            pid = os.fork()
            if pid == 0:
                return _begin(channel, children, fds)
            status = socket.socket(fileno=fds.pop(0))
            # Even if the worker has ended already, the number is still its own: nobody else can reap it.
            pidfd = os.pidfd_open(pid)
            with contextlib.suppress(OSError):  # the owner may have given the worker up
                socket.send_fds(status, [str(pid).encode()], [pidfd])
            for fd in fds:
                os.close(fd)
            children[pidfd] = pid, status
            waiting.register(pidfd, select.POLLIN)


def _begin(channel: socket.socket, children: dict[int, tuple[int, socket.socket]], fds: list[int]) -> int:
    """Close everything that belongs to the nursery, in a new worker; return its job's descriptor."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    channel.close()
    # Also other workers' sockets: the owner detects the nursery's death by their end, which a copy would
    # hide.
    for pidfd, (_, status) in children.items():
        status.close()
        os.close(pidfd)
    os.close(fds[0])
    _received[:] = fds[2:]
    return fds[1]
