"""Lock files: the kernel releases the lock however its process ends, and the file says which process has it.

The files stay when the lock is released: removing one would let two processes lock two files of one name.
"""

from __future__ import annotations

import errno
import fcntl
import os
import pwd
import secrets
import stat
import time
from contextlib import suppress
from pathlib import Path

LONGEST_LOCK = 32
"""Largest lock file, in bytes: a process number and a newline."""
_AGAIN_S = 0.0005
"""flock(2) waits without a limit or not at all, so a wait with a limit is a series of attempts."""


class LockFile:
    """An open lock file. One thread at a time.

    Attributes
    ----------
    identity : device and inode, by which a file that took its place can be told from it
    """

    def __init__(self, path: Path, mode: int = 0o600) -> None:
        """Open the file, or create it with ``mode`` whatever the umask is.

        Raises OSError, whose `strerror` states the reason; anything but a lock file is left untouched.
        """
        self.path = path
        self._descriptor = _open(path, mode)
        found = os.fstat(self._descriptor)
        self.identity = found.st_dev, found.st_ino
        if not stat.S_ISREG(found.st_mode) or found.st_size > LONGEST_LOCK:
            self.close()
            raise OSError(errno.EINVAL, "it is not a lock of acquire, and is left untouched")
        # Its creator may have been killed, or had an umask, before everybody could use it.
        if found.st_uid == os.geteuid() and stat.S_IMODE(found.st_mode) & mode != mode:
            with suppress(OSError):
                os.fchmod(self._descriptor, mode)

    def take(self, within_s: float = 0.0) -> None:
        """Take the lock, and write this process's number. Raises OSError; BlockingIOError: another has it."""
        deadline_s = time.monotonic() + within_s
        while True:
            try:
                fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() >= deadline_s:
                    raise
                time.sleep(_AGAIN_S)
            else:
                break
        # Only under the lock: until then the file has the number of its owner, which refusals name.
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, f"{os.getpid()}\n".encode(), 0)

    @property
    def owner(self) -> str:
        """Number of the process that has the lock; ``unknown`` if it has not written it yet."""
        number = os.pread(self._descriptor, LONGEST_LOCK, 0).decode("ascii", "replace").strip()
        return number if number.isdecimal() else "unknown"

    @property
    def is_there(self) -> bool:
        """Whether the file still has its name, so that another process would find it."""
        return identity_of(self.path) == self.identity

    def close(self) -> None:
        """Release the lock. Idempotent."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def identity_of(path: Path) -> tuple[int, int] | None:
    """Return device and inode of what has this name, or None; links are not followed."""
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _open(path: Path, mode: int) -> int:
    # If others can write to the directory, a link could make us truncate another file, a pipe wait for ever.
    # Without O_CREAT, with which the kernel refuses other users' files in sticky directories.
    flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    while True:
        try:
            return os.open(path, flags)
        except FileNotFoundError:
            pass
        except PermissionError as error:
            raise OSError(error.errno, _not_ours(path) or error.strerror) from error
        # Under another name first: a second user would find it before it has its mode, and be refused.
        scratch = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
        descriptor = os.open(scratch, flags | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            os.fchmod(descriptor, mode)
            os.link(scratch, path)
        except FileExistsError:  # another process was faster: that one's is used
            os.close(descriptor)
        except OSError:  # a file system without hard links
            os.close(descriptor)
            return os.open(path, flags | os.O_CREAT, mode)
        else:
            return descriptor
        finally:
            scratch.unlink(missing_ok=True)


def _not_ours(path: Path) -> str:
    """Return whose the file is, if another user's; it is not removed, since that user may have its lock."""
    try:
        uid = path.lstat().st_uid
    except OSError:
        return ""
    if uid == os.geteuid():
        return ""
    try:
        name = pwd.getpwuid(uid).pw_name
    except KeyError:
        name = str(uid)
    return f"it belongs to user {name}, who keeps it from other users"
