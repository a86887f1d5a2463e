"""The control socket: one daemon at a time, reachable by its user only.

The default socket is in a directory that only its user can enter; a directory that another user created
first, in /tmp, is refused. `acquire.daemon.peer` is the client's counterpart.

A lock on a file next to the socket shows whether a daemon is alive. The kernel releases it however the
process ends, so that a socket left behind by a killed daemon is recognised and replaced.
"""

from __future__ import annotations

import contextlib
import os
import socket
import stat
from pathlib import Path

from acquire.daemon.connections import Listener
from acquire.daemon.peer import ELSEWHERE
from acquire.errors import StateError, UsageError
from acquire.place import default_socket
from acquire.processes.lockfile import LockFile, identity_of

LONGEST_PATH = 107
"""Longest path of a Unix socket that the kernel accepts, in bytes."""


class Endpoint:
    """A listening Unix socket with mode 0600, and the lock that makes it the only one."""

    def __init__(self, path: Path) -> None:
        """Lock and listen.

        Raises UsageError if ``path`` cannot be a socket, StateError if another daemon has it.
        """
        self.path = path
        check_path(path)
        self._closed = False
        self._lock = _lock(path)
        try:
            self.socket = _listen(path)
        except BaseException:
            self._lock.close()
            raise
        self._identity = identity_of(path)

    def renewed(self) -> Listener | None:
        """Make lock and socket again if their names were removed; return a new socket, or None.

        Raises as the construction does. What another program put in their place is left untouched.
        """
        if not self._lock.is_there:
            _check_directory(self.path)
            lock = _lock(self.path)
            self._lock.close()
            self._lock = lock
        found = identity_of(self.path)
        if found is not None and found == self._identity:
            return None
        if found is not None:
            raise UsageError(
                f"control socket {self.path}: something else is there now, and is left untouched",
                hint=f"remove it, and the daemon (process {os.getpid()}) is reachable again",
            )
        self.socket = _listen(self.path)
        self._identity = identity_of(self.path)
        return self.socket

    def remove(self) -> None:
        """Remove the socket's name. May be called from any thread; the lock ends with the process."""
        # Something else may have taken its place.
        if identity_of(self.path) == self._identity:
            with contextlib.suppress(OSError):
                self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Remove the socket and let the next daemon in. Idempotent."""
        if self._closed:
            return
        self._closed = True
        self.socket.close()
        # Before the lock is released: afterwards the name may be that of the next daemon's socket.
        self.remove()
        self._lock.close()


def check_path(path: Path) -> None:
    """Raise UsageError unless a daemon could listen there, or does."""
    if len(os.fsencode(path)) > LONGEST_PATH:
        raise UsageError(
            f"control socket {path} has too long a path",
            possible=f"a path of at most {LONGEST_PATH} bytes",
            hint=ELSEWHERE,
        )
    _check_directory(path)
    if os.path.lexists(path) and not stat.S_ISSOCK(path.lstat().st_mode):
        raise UsageError(
            f"control socket {path}: something else is there, and is left untouched", hint=ELSEWHERE
        )


def lock_path(path: Path) -> Path:
    """Return the file whose lock makes a daemon the only one on this socket."""
    return path.with_name(path.name + ".lock")


def _check_directory(path: Path) -> None:
    # The directory of any other path was chosen by the user, who may share it; clients look at it
    # (`peer`).
    if path == default_socket():
        _own(path.parent)
    if not path.parent.is_dir():
        raise UsageError(f"control socket {path}: its directory does not exist", hint=ELSEWHERE)


def _own(directory: Path) -> None:
    """Create the directory of the default socket, or make sure that it belongs to this user alone."""
    in_tmp = not os.environ.get("XDG_RUNTIME_DIR")
    if in_tmp:
        with contextlib.suppress(OSError):  # if it cannot be created, the checks below report why
            directory.mkdir(mode=0o700)
    try:
        # In /tmp anybody could have made the name a link; XDG_RUNTIME_DIR was chosen for this user.
        found = directory.lstat() if in_tmp else directory.stat()
    except OSError as error:
        raise UsageError(
            f"the control socket cannot be made in {directory}: {error.strerror}", hint=ELSEWHERE
        ) from error
    if not stat.S_ISDIR(found.st_mode):
        raise UsageError(f"control socket in {directory}: that is not a directory", hint=ELSEWHERE)
    if found.st_uid != os.geteuid():
        raise UsageError(
            f"control socket in {directory}: that directory belongs to user {found.st_uid}", hint=ELSEWHERE
        )
    # XDG_RUNTIME_DIR may let others look; whoever may write there could replace the socket.
    if stat.S_IMODE(found.st_mode) & (0o077 if in_tmp else 0o022):
        raise UsageError(
            f"control socket in {directory}: that directory is open to others "
            f"(mode {stat.S_IMODE(found.st_mode):04o})",
            hint=f"chmod 700 {directory}, or {ELSEWHERE}",
        )


def _lock(path: Path) -> LockFile:
    name = lock_path(path)
    try:
        lock = LockFile(name)
    except OSError as error:
        raise UsageError(
            f"control socket {path}: cannot lock {name}: {error.strerror}", hint=ELSEWHERE
        ) from error
    try:
        lock.take()
    except BlockingIOError:
        owner = lock.owner
        lock.close()
        if not os.path.lexists(path):  # otherwise each of two commands would send the user to the other
            raise StateError(
                f"another daemon (process {owner}) listens on {path}, which was removed",
                hint=f"kill {owner}, after which it seals its recording and ends"
                if owner.isdecimal()
                else "",
            ) from None
        raise StateError(
            f"another daemon (process {owner}) listens on {path}", hint="acquire status, or another --socket"
        ) from None
    except OSError as error:
        lock.close()
        raise UsageError(f"control socket {path}: cannot lock {name}: {error.strerror}") from error
    return lock


def _listen(path: Path) -> Listener:
    path.unlink(missing_ok=True)  # left by a daemon that was killed: the lock was free
    listener = Listener(socket.AF_UNIX, socket.SOCK_STREAM)
    # With umask rather than chmod afterwards: in between anybody could connect.
    before = os.umask(0o177)
    try:
        listener.bind(str(path))
        listener.listen()
    except OSError as error:
        listener.close()
        raise UsageError(f"the control socket {path} cannot be made: {error.strerror}") from error
    finally:
        os.umask(before)
    return listener
