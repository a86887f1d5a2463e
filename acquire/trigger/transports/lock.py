"""One user per port: an advisory lock that ends with its process, and shows which process holds it.

pyserial's own exclusive mode only keeps out programs that use it as well; USB has nothing comparable.
"""

from __future__ import annotations

import fcntl
import os
import re
import tempfile
import time
from pathlib import Path

from acquire.errors import TriggerError

# Not a directory for temporary files, of which a service may have one of its own (PrivateTmp=): the daemon
# and a user's command would lock different files.
SHARED = Path("/run/lock")
_COMMAND_SHOWN = 80
_LOOKED_AT_S = 0.1
"""Longest time for which a program that only lists the ports holds a lock."""
_LOOK_AGAIN_S = 0.0005


class PortLock:
    """Held from construction to `release`. Raises TriggerError when another holds it."""

    def __init__(self, port: str) -> None:
        path = lock_directory() / f"acquire-{re.sub('[^A-Za-z0-9]+', '-', port).strip('-')}.lock"
        try:
            self._descriptor = _open_for_all(path)
        except OSError as error:
            raise TriggerError(f"{port} cannot be locked: {path}: {error.strerror}") from error
        # flock, not a file with a number in it: the kernel releases it with the process, however that ends.
        try:
            self._take()
        except OSError as error:
            holder = os.pread(self._descriptor, 32, 0).decode(errors="replace").strip()
            self.release()
            raise TriggerError(
                f"{port} is in use by process {_describe(holder)}", hint="stop it, or ask its daemon"
            ) from error
        # The process number, for the error of others.
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, f"{os.getpid()}\n".encode(), 0)

    def _take(self) -> None:
        """Take the lock; raise BlockingIOError if it is held for longer than `holder_of` holds it."""
        deadline_s = time.monotonic() + _LOOKED_AT_S
        while True:
            try:
                fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() > deadline_s:
                    raise
                time.sleep(_LOOK_AGAIN_S)
            else:
                return

    def release(self) -> None:
        """Release the lock. Idempotent."""
        # The file stays: removing it would let two processes lock two files of the same name.
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def holder_of(port: str) -> str:
    """Return ``in use by process 1234 (…)``, or "", without keeping the lock."""
    try:
        PortLock(port).release()
    except TriggerError as error:
        return error.message
    return ""


def lock_directory() -> Path:
    """Return the directory of all users' locks, or else this host's directory for temporary files."""
    return SHARED if os.access(SHARED, os.W_OK) else Path(tempfile.gettempdir())


def _open_for_all(path: Path) -> int:
    """Open the lock file so that other users can use it as well, whatever the umask of the first.

    An existing file is opened without O_CREAT, with which the kernel refuses other users' files in sticky
    directories.
    """
    try:
        return os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        os.fchmod(descriptor, 0o666)  # of the mode above, the umask has taken what others need
        return descriptor


def _describe(pid: str) -> str:
    """Return a text such as ``1234 (acquire serve rig.toml)``."""
    if not pid.isdecimal():  # the holder has not written its number yet
        return "unknown"
    try:
        command = Path("/proc", pid, "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return pid
    return f"{pid} ({command.strip()[:_COMMAND_SHOWN]})"
