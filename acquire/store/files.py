"""What the store asks of a file system: whole writes, atomic replacement, forcing to the medium."""

from __future__ import annotations

import errno
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from typing_extensions import Buffer


def check_new_path(path: Path) -> None:
    """Raise UsageError unless something new can be created at ``path``. Touches nothing."""
    if _is_taken(path):
        raise UsageError(f"{path} exists already", hint="another name; nothing is ever overwritten")
    if not path.parent.is_dir():
        raise UsageError(f"{path}: the directory {path.parent} does not exist", hint="create it first")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise UsageError(f"{path}: the directory {path.parent} is not writable", hint="another directory")


def _is_taken(path: Path) -> bool:
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except (OSError, ValueError) as error:  # too long, a circle of links, NUL, not encodable
        reason = error.strerror if isinstance(error, OSError) else error
        raise UsageError(f"{str(path)!r} cannot be a path: {reason}", hint="another name") from error
    return True


def write_all(fd: int, data: Buffer, offset: int) -> None:
    """Write all of ``data`` (contiguous) at ``offset``; a short write goes on until the disk says why."""
    view = memoryview(data).cast("B")
    while len(view):
        written = os.pwrite(fd, view, offset)
        if written == 0:
            raise OSError(errno.EIO, "the disk takes no more bytes")
        view, offset = view[written:], offset + written


def sync_directory(path: Path) -> None:
    """Force the entries of a directory to the medium."""
    _sync(path, os.O_DIRECTORY)


def sync_tree(path: Path) -> None:
    """Force every file and directory below ``path``, and ``path`` itself, to the medium."""
    for directory, files in _walk(path):
        for file in files:
            _sync(file)
        sync_directory(directory)


def reserve(path: Path, size: int) -> None:
    """A file that keeps ``size`` bytes of the disk for later; delete it to have them."""
    with path.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, size)


def tree_bytes(path: Path) -> int:
    """Bytes of all files below ``path``."""
    return sum(file.stat().st_size for _, files in _walk(path) for file in files)


def _walk(path: Path) -> Iterator[tuple[Path, list[Path]]]:
    for directory, _, names in os.walk(path, topdown=False):
        base = path.__class__(directory)
        yield base, [base / name for name in names]


def _sync(path: Path, flags: int = 0) -> None:
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | flags)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


@dataclass(frozen=True, slots=True)
class Publisher:
    """Replaces files so that a reader meets the old bytes or the new ones, nothing between.

    ``scratch`` is where the new bytes are prepared: on the same file system, and where no Zarr reader
    lists names, since a writer that is killed leaves it behind. One thread at a time.
    """

    scratch: Path

    def replace(self, path: Path, data: Buffer, *, durable: bool = False) -> None:
        """Replace ``path``; ``durable`` forces bytes and name to the medium before it returns."""
        fd = os.open(self.scratch, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o666)
        try:
            write_all(fd, data, 0)
            if durable:
                os.fsync(fd)
        finally:
            os.close(fd)
        self.scratch.replace(path)
        if durable:
            sync_directory(path.parent)
