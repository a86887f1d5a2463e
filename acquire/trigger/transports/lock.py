"""One user per port: an advisory lock that ends with its process, and shows which process holds it.

pyserial's own exclusive mode only keeps out programs that use it as well; USB has nothing comparable.
"""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path

from acquire.errors import TriggerError
from acquire.processes.lockfile import LockFile

# Not a directory for temporary files, of which a service may have one of its own (PrivateTmp=): the daemon
# and a user's command would lock different files.
SHARED = Path("/run/lock")
_COMMAND_SHOWN = 80
"""Number of characters of the holder's command line in a message."""
_LOOKED_AT_S = 0.1
"""Longest time for which a program that only lists the ports holds a lock."""
_FOR_ALL = 0o666
"""Mode of a lock file, which stays: any user may lock the port next."""


class PortLock:
    """Held from construction to `release`. Raises TriggerError when another holds it."""

    def __init__(self, port: str) -> None:
        path = lock_directory() / f"acquire-{re.sub('[^A-Za-z0-9]+', '-', port).strip('-')}.lock"
        try:
            self._lock = LockFile(path, _FOR_ALL)
        except OSError as error:
            raise TriggerError(
                f"{port} cannot be locked: {path}: {error.strerror}",
                hint="the permissions of that file; it can be deleted while no program uses the port",
            ) from error
        try:
            self._lock.take(_LOOKED_AT_S)
        except BlockingIOError as error:
            holder = self._lock.owner
            self.release()
            raise TriggerError(
                f"{port} is in use by process {_describe(holder)}", hint="stop it, or ask its daemon"
            ) from error
        except OSError as error:
            self.release()
            raise TriggerError(
                f"{port} cannot be locked: {path}: {error.strerror}",
                hint="the permissions of that file; it can be deleted while no program uses the port",
            ) from error

    def release(self) -> None:
        """Release the lock. Idempotent."""
        self._lock.close()


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


def _describe(pid: str) -> str:
    """Return a text such as ``1234 (acquire serve rig.toml)``."""
    if not pid.isdecimal():
        return pid
    try:
        command = Path("/proc", pid, "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return pid
    return f"{pid} ({command.strip()[:_COMMAND_SHOWN]})"
