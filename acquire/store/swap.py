"""Replacement of a directory as a whole: at every moment the old one or the new one is there, complete.

::

    .NAME.HEX.new.zarr ─▶ forced to the medium ─▶ exchanged with NAME ─▶ what was NAME is removed

On a file system that cannot exchange two names, NAME is first renamed to .NAME.HEX.before. A process that is
killed before the new one has the name leaves none under it, and `put_back` gives it to the old one again.

One process at a time (`alone`): whatever else has such a name was left by a process that was killed.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import secrets
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

from acquire.errors import AcquireError, PlaceError, StateError
from acquire.store.files import DISK, NO_LOCKS, check_new_path

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

NEW, BEFORE = ".new.zarr", ".before"
NO_EXCHANGE = (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP)
"""Errors of file systems that cannot exchange two names, as most network disks are."""
WAIT_S = 60.0
"""Longest wait for another process, which has only to write a few small files."""
_AGAIN_S = 0.02


@contextmanager
def alone(path: Path) -> Iterator[bool]:
    """Keep other processes from replacing anything beside ``path``; yield whether that is certain.

    It is not on a file system without locks. Raises StateError if another process does not end.
    """
    # The directory itself is locked, since a lock file would have to stay beside what it guards.
    try:
        fd = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:
        # One that may be written, but not read; or none at all, which whoever writes will report.
        yield False
        return
    try:
        yield _lock(fd, path)
    finally:
        os.close(fd)


def _lock(fd: int, path: Path) -> bool:
    deadline_s = time.monotonic() + WAIT_S
    while True:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if time.monotonic() >= deadline_s:
                raise StateError(
                    f"{path} cannot be changed: another process has locked {path.parent} for {WAIT_S:g} s",
                    hint=f"again, when it has ended; fuser {path.parent} names it",
                ) from error
            time.sleep(_AGAIN_S)
        except OSError as error:
            # EBADF: NFS locks for writing only what is open for it, which a directory never is.
            if error.errno not in (*NO_LOCKS, errno.EBADF):
                raise
            return False
        else:
            return True


def beside(path: Path) -> Path:
    """Return an unused name for what will have the name of ``path``."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}{NEW}")


def swap_in(new: Path, path: Path) -> None:
    """Force ``new``, of `beside`, to the medium, and put it in the place of ``path`` if there is one.

    Raises OSError, and UsageError if nothing new can be created at ``path``.
    """
    DISK.sync_tree(new)
    if not os.path.lexists(path):
        check_new_path(path)
        DISK.rename(new, path)
        DISK.sync_directory(path.parent)
        return
    before = new
    try:
        DISK.exchange(new, path)
    except OSError as error:
        if error.errno not in NO_EXCHANGE:
            raise
        before = new.with_name(new.name.removesuffix(NEW) + BEFORE)
        _rename_both(path, before, new)
    # The old one remains on the disk until it is certain that the new one has the name.
    DISK.sync_directory(path.parent)
    DISK.remove_tree(before)


def _rename_both(path: Path, before: Path, new: Path) -> None:
    DISK.rename(path, before)
    try:
        DISK.rename(new, path)
    except BaseException:
        # Ctrl-C as well: only a kill may leave nothing under the name.
        if not os.path.lexists(path):
            DISK.rename(before, path)
        raise


def put_back(path: Path, check: Callable[[Path], object]) -> bool:
    """Rename to ``path`` what a killed process was replacing there; return whether there was anything.

    ``check`` raises an AcquireError for one that is not complete. Raises PlaceError if it cannot be renamed.
    """
    if os.path.lexists(path):
        return False
    for old in sorted(left_over(path, BEFORE), key=lambda each: each.stat().st_mtime_ns, reverse=True):
        try:
            check(old)
        except AcquireError:
            continue
        try:
            DISK.rename(old, path)
            DISK.sync_directory(path.parent)
        except OSError as error:
            raise PlaceError(
                f"{path} is missing, since a process was killed while it replaced it, and {old}, which it "
                f"was before, cannot be renamed: {error.strerror}",
                hint=f"mv {old} {path}, as a user who may write to {path.parent}",
            ) from error
        return True
    return False


def clear_left_over(path: Path) -> None:
    """Remove what killed processes have left beside ``path``. Only when `alone`, and with ``path`` there."""
    if os.path.lexists(path):
        for each in (*left_over(path, NEW), *left_over(path, BEFORE)):
            DISK.remove_tree(each)


def left_over(path: Path, end: str) -> list[Path]:
    """Return the directories beside ``path`` whose names are its own with ``end``."""
    # Nothing with a further dot, which belongs to a NAME.MORE beside it.
    name = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]+{re.escape(end)}")
    try:
        return [each for each in path.parent.iterdir() if name.fullmatch(each.name) and each.is_dir()]
    except OSError:
        return []
