"""Processes of a run: each has one owner, one pipe to it, and ends with it.

A child leaves SIGINT to its owner. The owner's death shows as the end of the pipe, and counts like SIGTERM
or `Quit`: the child finishes what is under way, within a bounded time, and ends.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import multiprocessing
import multiprocessing.process
import os
import pickle
import select
import signal
import sys
import threading
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acquire.errors import AcquireError, DeviceError
from acquire.logs import write_log
from acquire.processes.messages import Failed, Quit
from acquire.processes.nursery import UNTOLD, nursery

if TYPE_CHECKING:
    from collections.abc import Callable
    from multiprocessing.connection import Connection
    from types import FrameType

_STOPPED_WAIT_S = 5.0
"""For somebody to let a process go on that a signal has stopped: it hears nothing, and ends by force only."""
_KILL_WAIT_S = 10.0
"""For the kernel to end a process that was killed, which takes milliseconds: one that stays waits for a disk,
and goes when the disk answers."""
_LAST_WORD_S = 0.1
_LOOK_S = 0.1
_IMPORTANT = -15
"""Niceness; threads that are started later have it as well."""


class OwnerGone(Exception):  # noqa: N818 - an event, not an error: the child ends in order
    """The owner has died, or wants the process to end."""


class Mailbox:
    """The child's end of the pipe."""

    def __init__(self, pipe: Connection[Any, Any]) -> None:
        self._pipe = pipe
        self._waiting = select.poll()
        self._waiting.register(pipe, select.POLLIN | select.POLLHUP)
        self._terminated = False

    def take(self) -> object | None:
        """The next message, or None when there is none now. Raises OwnerGone."""
        if self._terminated:
            raise OwnerGone("told to terminate")
        if not self._waiting.poll(0):
            return None
        try:
            message = self._pipe.recv()
        except (EOFError, OSError) as error:
            raise OwnerGone("the owner of the capture is gone") from error
        if isinstance(message, Quit):
            raise OwnerGone("the capture was closed")
        return message  # type: ignore[no-any-return]

    def post(self, message: object) -> None:
        """Tell the owner; in vain when it is gone."""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self._pipe.send(message)

    def terminate(self, signum: int, frame: FrameType | None) -> None:  # noqa: ARG002 - a signal handler
        """Take SIGTERM for the owner's word, but never in the middle of a write."""
        self._terminated = True

    def fileno(self) -> int:
        return self._pipe.fileno()


class Worker:
    """The owner's side of one child process, forked from the nursery: ``target(mailbox, *args)``.

    It is on its way when this returns: `expect` waits for its first word.
    """

    def __init__(self, name: str, target: Callable[..., None], *args: Any) -> None:
        self.name = name
        self._sending = threading.Lock()
        self._outbox: deque[object] = deque()
        self.pipe, theirs = multiprocessing.Pipe()
        self._has_room = select.poll()
        self._has_room.register(self.pipe, select.POLLOUT)
        try:
            self._child = nursery().bear(name, _live, theirs, name, target, *args)
        except (OSError, pickle.PicklingError, AttributeError, TypeError) as error:
            self.pipe.close()
            raise DeviceError(f"{name}: the process cannot be started: {error}") from error
        finally:
            theirs.close()  # else the pipe would not end with the child

    @property
    def pid(self) -> int | None:
        """The process's number; None while it is not known yet."""
        return self._child.pid()

    @property
    def death(self) -> str | None:
        """How the process ended, or None while it lives."""
        code = self._child.exit_code()
        if code is None:
            return None
        if code == UNTOLD:
            return "ended, and nobody is left to say how"
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"

    @property
    def is_stopped(self) -> bool:
        """A signal keeps the process from running, until another lets it go on."""
        try:
            state = Path(f"/proc/{self.pid}/stat").read_text(encoding="utf-8", errors="replace")
        except OSError:
            return False  # it has ended
        # The name stands in parentheses before the state, and may itself hold a parenthesis or a space.
        return state.rpartition(") ")[2][:1] in ("T", "t")

    def post(self, message: object) -> None:
        """Tell the child; in vain when it is dead, which `death` tells.

        Never waits for a child that does not listen: what its pipe does not take is sent by a later `post` or
        `flush`, in order.
        """
        self._outbox.append(message)
        self.flush()

    def flush(self) -> None:
        """Send what the pipe takes by now of what was posted."""
        with self._sending:
            if self.pipe.closed:
                self._outbox.clear()
            try:
                # A Unix socket counts as writable while a quarter of its buffer is in use at most; what is
                # left takes any of our messages whole, so that `send` does not wait.
                while self._outbox and self._has_room.poll(0):
                    self.pipe.send(self._outbox.popleft())
            except (BrokenPipeError, ConnectionResetError):
                self._outbox.clear()

    @property
    def unsent(self) -> int:
        """Messages that were posted, and that the pipe has not taken yet."""
        return len(self._outbox)

    def kill(self) -> None:
        """End the process by force; it dies when the system lets it, which may take a disk's answer."""
        self._child.kill()

    def message(self, timeout_s: float = 0.0) -> object | None:
        """The child's next message, or None when there is none."""
        try:
            return self.pipe.recv() if self.pipe.poll(timeout_s) else None
        except (EOFError, OSError):
            return None

    def expect(self, kind: type[Any], deadline: float) -> Any:
        """The next message, which must be a ``kind``, before the monotonic ``deadline``.

        Raises the child's own error, or DeviceError when it dies or says nothing.
        """
        message = self.message(max(0.0, deadline - time.monotonic()))
        if isinstance(message, Failed):
            raise message.error
        if isinstance(message, kind):
            # The nursery tells the number in a socket of its own: it may come later than the child's word.
            self._child.pid(max(0.0, deadline - time.monotonic()))
            return message
        # A process that dies closes its pipe a moment before `death` can tell how it ended.
        self._child.exit_code(_LAST_WORD_S if message is None else 0.0)
        raise DeviceError(f"{self.name}: {self.death or 'it did not answer in time'}")

    def end(self, deadline: float) -> None:
        """End the process: by word until the monotonic ``deadline``, then by force. Idempotent.

        One that stands still, stopped by a signal, is not waited for as long as one that may be at work.
        Raises DeviceError, after the end, when it took force.
        """
        if self.pipe.closed:
            return
        self.post(Quit())
        self._await_end(deadline)
        forced = self._child.exit_code() is None
        if forced:
            self._child.kill()
            self._child.exit_code(_KILL_WAIT_S)
        self.pipe.close()
        if self._child.exit_code() is None:
            self._child.close()
            raise DeviceError(
                f"{self.name}: the process was killed, and has not ended within {_KILL_WAIT_S:g} s",
                hint="it waits for a disk or device that does not answer, and ends when that does",
            )
        self._child.close()
        if forced:
            raise DeviceError(f"{self.name}: the process did not end when told to, and was killed")

    def _await_end(self, deadline: float) -> None:
        """Until the process has ended, the monotonic ``deadline``, or it has stood still for too long."""
        ran_s = time.monotonic()
        while self._child.exit_code() is None and (now_s := time.monotonic()) < deadline:
            if not self.is_stopped:
                ran_s = now_s
            elif now_s - ran_s > _STOPPED_WAIT_S:
                return
            self.flush()
            self._child.exit_code(min(deadline - now_s, _LOOK_S))


def become_urgent() -> bool:
    """Run before everything else on the host, in real time; says whether that is allowed here.

    For what waits most of the time and does little at once: it would starve the host otherwise.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except PermissionError:
        return False
    return True


def become_important() -> bool:
    """Get more of the processors than others, who still get some; says whether that is allowed here."""
    try:
        os.setpriority(os.PRIO_PROCESS, 0, _IMPORTANT)
    except PermissionError:
        return False
    return True


def _live(pipe: Connection[Any, Any], name: str, target: Callable[..., None], *args: Any) -> None:
    """The life of a child, from its first to its last instruction."""
    mailbox = Mailbox(pipe)
    # Ctrl-C goes to the whole foreground group: the owner ends its children in order, by word.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, mailbox.terminate)
    # Locks that libraries make, as blosc's does, have a name in /dev/shm where children are spawned, which a
    # kill of the whole group would leave there for ever; one made for forked children loses it at once.
    multiprocessing.set_start_method("fork", force=True)
    write_log(logging.WARNING)
    gc.freeze()  # what was imported never dies: no collection needs to look at it again
    try:
        target(mailbox, *args)
    except OwnerGone:
        return
    except AcquireError as error:
        mailbox.post(Failed(error))
        sys.exit(1)
    except Exception as error:  # noqa: BLE001 - the outermost boundary: told to the owner
        mailbox.post(Failed(AcquireError(f"{name}: {type(error).__name__}: {error}")))
        sys.exit(1)
