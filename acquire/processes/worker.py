"""Processes of a run: each has one owner, one pipe to it, and ends with it.

A child leaves SIGINT to its owner. The owner's death is detected by the end of the pipe, and has the effect
of SIGTERM or `Quit`: the child finishes its work within a bounded time, and ends.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import multiprocessing
import multiprocessing.process
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
from acquire.processes.nursery import UNKNOWN, nursery

if TYPE_CHECKING:
    from collections.abc import Callable
    from multiprocessing.connection import Connection
    from types import FrameType

_STOPPED_WAIT_S = 5.0
"""How long a process stopped by a signal is waited for: it reads no messages, and can only be killed."""
_KILL_WAIT_S = 10.0
"""Time for the kernel to end a killed process, which takes milliseconds, unless the process waits for a
disk."""
_LAST_WORD_S = 0.1
"""How long the exit code is waited for when a pipe has ended."""
_LOOK_S = 0.1
"""Interval at which an ending process is checked for having been stopped by a signal."""


class OwnerGone(Exception):  # noqa: N818 - an event, not an error: the child ends in order
    """The owner has died, or has requested the end of the process."""


class Mailbox:
    """The child's end of the pipe."""

    def __init__(self, pipe: Connection[Any, Any]) -> None:
        self._pipe = pipe
        self._waiting = select.poll()
        self._waiting.register(pipe, select.POLLIN | select.POLLHUP)
        self._terminated = False

    def take(self) -> object | None:
        """Return the next message, or None if there is none now. Raises OwnerGone."""
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
        """Send a message to the owner; without effect if it is gone."""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self._pipe.send(message)

    def terminate(self, signum: int, frame: FrameType | None) -> None:  # noqa: ARG002 - a signal handler
        """Handle SIGTERM like the owner's `Quit`, but never in the middle of a write."""
        self._terminated = True

    def fileno(self) -> int:
        return self._pipe.fileno()


class Worker:
    """The owner's side of one child process, forked from the nursery: ``target(mailbox, *args)``.

    It is still starting when this returns: `expect` waits for its first message.
    """

    def __init__(self, name: str, target: Callable[..., None], *args: Any) -> None:
        self.name = name
        self._sending = threading.Lock()
        self._outbox: deque[object] = deque()
        self.pipe, theirs = multiprocessing.Pipe()
        self._has_room = select.poll()
        self._has_room.register(self.pipe, select.POLLOUT)
        try:
            self._child = nursery().fork(name, _main, theirs, name, target, *args)
        except (OSError, pickle.PicklingError, AttributeError, TypeError) as error:
            self.pipe.close()
            busy = "fewer other programs on this host, or more memory"
            local = "no lambda and no local class, such as a camera driver's opener: they cannot be sent"
            raise DeviceError(
                f"{name}: the process cannot be started: {error}",
                hint=busy if isinstance(error, OSError) else local,
            ) from error
        finally:
            theirs.close()  # otherwise the pipe would not end with the child

    @property
    def pid(self) -> int | None:
        """The process number; None while it is not known yet."""
        return self._child.pid()

    @property
    def death(self) -> str | None:
        """How the process ended, or None while it is alive."""
        code = self._child.exit_code()
        if code is None:
            return None
        if code == UNKNOWN:
            return "ended, with an unknown exit code"
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"

    @property
    def is_stopped(self) -> bool:
        """Whether the process is stopped by a signal, until another one continues it."""
        try:
            state = Path(f"/proc/{self.pid}/stat").read_text(encoding="utf-8", errors="replace")
        except OSError:
            return False  # it has ended
        # The name is in parentheses before the state, and may itself contain a parenthesis or a space.
        return state.rpartition(") ")[2][:1] in ("T", "t")

    def post(self, message: object) -> None:
        """Send a message to the child; without effect if it is dead, see `death`.

        Never waits for a child that does not read: messages that do not fit into its pipe are sent by a later
        `post` or `flush`, in order.
        """
        self._outbox.append(message)
        self.flush()

    def flush(self) -> None:
        """Send as many posted messages as fit into the pipe."""
        with self._sending:
            if self.pipe.closed:
                self._outbox.clear()
            try:
                # A Unix socket counts as writable while at most a quarter of its buffer is in use; the rest
                # holds any of our messages completely, so that `send` does not wait.
                while self._outbox and self._has_room.poll(0):
                    self.pipe.send(self._outbox.popleft())
            except (BrokenPipeError, ConnectionResetError):
                self._outbox.clear()

    @property
    def unsent(self) -> int:
        """Number of posted messages that are not in the pipe yet."""
        return len(self._outbox)

    def kill(self) -> None:
        """Kill the process; it dies when the kernel permits, which may have to wait for a disk."""
        self._child.kill()

    def message(self, timeout_s: float = 0.0) -> object | None:
        """Return the child's next message, or None if none comes within ``timeout_s``."""
        try:
            return self.pipe.recv() if self.pipe.poll(timeout_s) else None
        except (EOFError, OSError):
            return None

    def expect(self, kind: type[Any], deadline: float) -> Any:
        """Return the next message, which must be a ``kind``, before the monotonic ``deadline``.

        Raises the child's own error, or DeviceError if it dies or does not answer.
        """
        message = self.message(max(0.0, deadline - time.monotonic()))
        if isinstance(message, Failed):
            raise message.error
        if isinstance(message, kind):
            # The nursery sends the process number on a separate socket, possibly later than this message.
            self._child.pid(max(0.0, deadline - time.monotonic()))
            return message
        # A process that dies closes its pipe a moment before its exit code is available.
        self._child.exit_code(_LAST_WORD_S if message is None else 0.0)
        if self.death is None:
            raise DeviceError(
                f"{self.name}: it did not answer in time", hint="again, on a host that is less busy"
            )
        raise DeviceError(
            f"{self.name}: {self.death}", hint="look into the log of this program, and the kernel's"
        )

    def end(self, deadline: float) -> AcquireError | None:
        """End the process: by `Quit` until the monotonic ``deadline``, then by force. Idempotent.

        A process stopped by a signal is waited for only briefly. Returns an error that it reported and nobody
        has read, for example of a camera that cannot be closed. Raises DeviceError, after the end, if it had
        to be killed.
        """
        if self.pipe.closed:
            return None
        self.post(Quit())
        ran_s = time.monotonic()
        while self._child.exit_code() is None and (now_s := time.monotonic()) < deadline:
            if not self.is_stopped:
                ran_s = now_s
            elif now_s - ran_s > _STOPPED_WAIT_S:
                break
            self.flush()  # the pipe may have had no room for Quit
            self._child.exit_code(min(deadline - now_s, _LOOK_S))
        forced = self._child.exit_code() is None
        if forced:
            self._child.kill()
            self._child.exit_code(_KILL_WAIT_S)
        reported = self._unread_error()
        self.pipe.close()
        if self._child.exit_code() is None:
            self._child.close()
            raise DeviceError(
                f"{self.name}: the process was killed, and has not ended within {_KILL_WAIT_S:g} s",
                hint="check the disk or device that it waits for: it ends once that answers",
            )
        self._child.close()
        if forced:
            raise DeviceError(
                f"{self.name}: the process did not end when told to, and was killed",
                hint="acquire devices shows whether its device answers; what it had not written yet is lost",
            )
        return reported

    def _unread_error(self) -> AcquireError | None:
        found = None
        while (message := self.message()) is not None:
            found = message.error if isinstance(message, Failed) else found
        return found


def _main(pipe: Connection[Any, Any], name: str, target: Callable[..., None], *args: Any) -> None:
    """Main function of a child."""
    mailbox = Mailbox(pipe)
    # Ctrl-C goes to the whole foreground group: the owner ends its children in order, by messages.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, mailbox.terminate)
    # With the start method "spawn", locks created by libraries such as blosc keep a name in /dev/shm, which
    # would stay there for ever after a kill of the whole group; with "fork" the name is removed at once.
    multiprocessing.set_start_method("fork", force=True)
    write_log(logging.WARNING)
    gc.freeze()  # imported objects are never freed: no collection needs to traverse them again
    try:
        target(mailbox, *args)
    except OwnerGone:
        return
    except AcquireError as error:
        mailbox.post(Failed(error))
        sys.exit(1)
    except Exception as error:  # noqa: BLE001 - the outermost boundary: reported to the owner
        mailbox.post(Failed(AcquireError(f"{name}: {type(error).__name__}: {error}")))
        sys.exit(1)
