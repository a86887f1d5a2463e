"""Whether recordings can begin in the configured directory, and if not, why and what to do."""

from __future__ import annotations

import errno
import os
from typing import TYPE_CHECKING, NamedTuple

from acquire.errors import StateError, UsageError
from acquire.store.mount import MOUNT_IT, NOT_MOUNTED, mount_above
from acquire.store.refusals import CURES

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.daemon.journal import Claim

_MISSING = "mount its disk, or put the directory back"


class Trouble(NamedTuple):
    """Why nothing can be recorded there, and what helps."""

    text: str
    hint: str

    def __str__(self) -> str:
        return f"{self.text}; {self.hint}"


def trouble(directory: Path, why: str, hint: str) -> Trouble:
    return Trouble(f"no recording can begin in {directory}: {why}", hint)


class Place:
    """A directory and the mount point of its disk, as they were when the daemon started.

    ``claim``: the lock that keeps other daemons from it.
    """

    def __init__(self, directory: Path, claim: Claim | None = None) -> None:
        self._directory = directory
        self._claim = claim
        self._mount = mount_above(directory)
        self._is_other = False

    def take_other(self) -> bool:
        """Return whether another directory was found in its place since the last call."""
        is_other, self._is_other = self._is_other, False
        return is_other

    def look(self) -> Trouble | None:
        """Return the trouble with it, or None. May wait for the disk."""
        directory, mount = self._directory, self._mount
        # Where a disk was mounted there is a directory without it, too: on the host's own disk, which the
        # recordings would fill, and would be hidden once the disk is back.
        if not mount.is_mount():
            return trouble(directory, NOT_MOUNTED.format(mount), MOUNT_IT)
        # By its attributes: `is_dir` hides why a directory cannot be reached.
        try:
            directory.stat()
        except OSError as error:
            return unreachable(directory, error)
        if not directory.is_dir():
            return trouble(directory, "it is not a directory any more", "move away what is there instead")
        if os.statvfs(directory).f_flag & os.ST_RDONLY:
            return trouble(directory, "it is on a disk that is mounted read-only", CURES[errno.EROFS])
        if not os.access(directory, os.W_OK | os.X_OK):
            return trouble(directory, "this user may not write to it", f"chown or chmod {directory}")
        self._mount = mount_above(directory)  # a disk that was mounted since then counts from now on
        return self._lock()

    def _lock(self) -> Trouble | None:
        """Lock the directory again if it is another one, or its lock was removed."""
        if self._claim is None:
            return None
        try:
            self._is_other = self._claim.take() or self._is_other
        except (StateError, UsageError) as error:
            return trouble(self._directory, error.message, error.hint or "")
        except OSError:
            return None  # a directory without locks: reported when the daemon started
        return None


def unreachable(directory: Path, error: OSError) -> Trouble:
    """Return the trouble with a directory that cannot be queried."""
    if isinstance(error, FileNotFoundError):
        return trouble(directory, "it is not there", _MISSING)
    if error.errno in (errno.ENOTDIR, errno.ELOOP):
        return trouble(directory, "it is not a directory any more", "move away what is there instead")
    hint = CURES.get(error.errno or 0, "the kernel's log for errors of the disk or its network")
    return trouble(directory, error.strerror or str(error), hint)
