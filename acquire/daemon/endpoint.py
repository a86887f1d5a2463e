"""The control socket: one daemon at a time, reachable by its user only.

A lock on a file beside the socket says whether a daemon lives. The kernel frees it when the process
ends, however it ends, so that a socket left behind by a killed daemon is recognised and replaced.
The lock file stays: to remove it would let two daemons lock two files of one name.
"""

from __future__ import annotations

import fcntl
import os
import socket
import stat
from pathlib import Path

from acquire.errors import StateError, UsageError

LONGEST_PATH = 107
"""Bytes of a Unix socket's path that the kernel takes."""


class Endpoint:
    """A listening Unix socket with mode 0600, and the lock that makes it the only one."""

    def __init__(self, path: Path) -> None:
        """Lock and listen.

        Raises UsageError where ``path`` cannot be a socket, StateError where another daemon has it.
        """
        self.path = path
        _check(path)
        self._lock = _lock(path)
        try:
            self.socket = _listen(path)
        except BaseException:
            os.close(self._lock)
            raise

    def close(self) -> None:
        """Remove the socket and let the next daemon in. Idempotent."""
        if self._lock < 0:
            return
        self.socket.close()
        self.path.unlink(missing_ok=True)
        os.close(self._lock)
        self._lock = -1


def lock_path(path: Path) -> Path:
    return path.with_name(path.name + ".lock")


def _check(path: Path) -> None:
    if len(os.fsencode(path)) > LONGEST_PATH:
        raise UsageError(f"control socket {path}", possible=f"a path of at most {LONGEST_PATH} bytes")
    if not path.parent.is_dir():
        raise UsageError(f"control socket {path}: its directory does not exist")
    if path.exists() and not stat.S_ISSOCK(path.stat().st_mode):
        raise UsageError(f"control socket {path}: something else lies there, it stays untouched")


def _lock(path: Path) -> int:
    try:
        lock = os.open(lock_path(path), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise UsageError(f"control socket {path}: cannot lock it: {error.strerror}") from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        owner = os.pread(lock, 20, 0).decode().strip()
        os.close(lock)
        raise StateError(
            f"another daemon (process {owner}) listens on {path}",
            hint="acquire status, or another --socket",
        ) from None
    os.ftruncate(lock, 0)
    os.pwrite(lock, f"{os.getpid()}\n".encode(), 0)
    return lock


def _listen(path: Path) -> socket.socket:
    path.unlink(missing_ok=True)  # left by a daemon that was killed: the lock was free
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    before = os.umask(0o177)
    try:
        listener.bind(str(path))
        listener.listen(16)
    except OSError as error:
        listener.close()
        raise UsageError(f"control socket {path}: {error.strerror}") from error
    finally:
        os.umask(before)
    return listener
