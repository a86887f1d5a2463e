"""The store's file system operations: complete writes, atomic replacement, forcing to the medium.

Every change that the store makes on a disk is a method of `Disk` or of the `ShardFile` that it opens, so that
tests can substitute a disk that fails, is slow, or loses power between any two of them.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import stat
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from acquire.errors import StateError, UsageError
from acquire.reading import kind_of, open_regular, read_object
from acquire.store.pages import aligned_bytes, open_direct
from acquire.text import unexpanded

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from typing_extensions import Buffer

SCRATCH = ".next"
"""Name under which a recording's new metadata is prepared, next to the shards of its first array."""

# Never a file that exists, nor one to which a link of that name leads.
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
_WRITABLE = stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH

NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)
"""Errors of a file system without locks, as some network disks are."""


def check_new_path(path: Path) -> None:
    """Raise UsageError unless something new can be created at ``path``. Touches nothing."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except PermissionError as error:
        raise UsageError(
            f"{path}: the directory {path.parent} may not be entered",
            hint="another directory, or the permissions of this one",
        ) from error
    except (OSError, ValueError) as error:  # too long, a circle of links, NUL, not encodable
        reason = error.strerror if isinstance(error, OSError) else error
        raise UsageError(f"{str(path)!r} cannot be a path: {reason}", hint="another name") from error
    else:
        raise UsageError(f"{path} exists already", hint="another name; nothing is ever overwritten")
    if (no := no_directory(path.parent)) is not None:
        why, hint = no
        raise UsageError(f"{path}: {why}", hint=hint)
    if not os.access(path.parent, os.W_OK | os.X_OK):
        why, hint = _not_writable(path.parent)
        raise UsageError(f"{path}: the directory {path.parent} is {why}", hint=hint)
    inside = path.parent.resolve()
    for directory in (inside, *inside.parents):
        try:
            name = read_object(directory / "zarr.json")["attributes"]["format"]
        except (OSError, ValueError, LookupError, TypeError):
            continue
        if isinstance(name, str) and name.startswith("acquire-"):
            raise UsageError(
                f"{path} would be a part of {directory}, which is of format {name!r}",
                possible="a path outside: a copy, a check or the end of retention takes the whole directory",
                hint=str(directory.parent / path.name),
            )


def no_directory(path: Path) -> tuple[str, str] | None:
    """Return why ``path`` is not a directory, and what to try; None if it is one."""
    if path.is_dir():
        return None
    # The first one on the way that is something else: below a file no directory can be created.
    for way in (*reversed(path.parents), path):
        if way.is_symlink() and not way.exists():
            return f"{way} is a link to {way.readlink()}, which does not exist", "another directory"
        if way.exists() and not way.is_dir():
            kind = "a file" if way.is_file() else "something else"
            return f"{way} is {kind} and not a directory", "a path in a directory"
    return f"the directory {path} does not exist", unexpanded(path) or "create it first"


def _not_writable(directory: Path) -> tuple[str, str]:
    """Return why nothing can be created in ``directory``, and what to try."""
    with suppress(OSError):
        if os.statvfs(directory).f_flag & os.ST_RDONLY:
            return (
                "on a disk that is mounted read-only",
                "a directory on another disk, or mount this one for writing",
            )
    return "not writable for this user", "its permissions, or another directory"


def write_all(fd: int, parts: Sequence[Buffer], offset: int) -> None:
    """Write all of ``parts`` from ``offset`` on; continue short writes until the disk raises an error."""
    views = [memoryview(part).cast("B") for part in parts]
    left = sum(map(len, views))
    while (written := os.pwritev(fd, views, offset)) < left:
        # Trying again would never end.
        if written == 0:
            raise OSError(errno.EIO, "the disk takes no more bytes")
        offset += written
        left -= written
        # Continue after the bytes that the disk took, which may end within a part.
        while written >= len(views[0]):
            written -= len(views.pop(0))
        views[0] = views[0][written:]


class ShardFile:
    """A new file of chunks: an index in its first page, which is replaced in place, and pages after it.

    With ``direct`` the pages bypass the page cache if the file system allows it: the disk reads their memory
    itself. Otherwise they go through the cache, and are dropped from it once they are written, since a full
    cache stalls the writer.
    """

    def __init__(self, path: Path, *, direct: bool, fd: int = -1) -> None:
        """Create the file, or take over ``fd``, which is open already.

        ``path`` may then be a link, as in /proc.
        """
        self._fd = os.open(path, _NEW, 0o666) if fd < 0 else fd
        # A second descriptor, since the index is less than a page and has to go through the cache.
        self._direct = open_direct(path, follow=fd >= 0) if direct else -1
        self._cached = (0, 0)

    @property
    def direct(self) -> bool:
        """Whether pages bypass the page cache."""
        return self._direct >= 0

    def write_pages(self, parts: Sequence[Buffer], offset: int) -> None:
        """Write whole pages from page-aligned memory at ``offset``, a multiple of the page."""
        if self.direct:
            try:
                write_all(self._direct, parts, offset)
            except OSError as error:
                # The file system wants larger pages, or took a part: from now on all goes through the cache.
                if error.errno != errno.EINVAL:
                    raise
                os.close(self._direct)
                self._direct = -1
            else:
                return
        self.write(parts, offset)
        # Drop the pages of the previous write: the kernel keeps pages that are not on the disk yet.
        os.posix_fadvise(self._fd, *self._cached, os.POSIX_FADV_DONTNEED)
        self._cached = offset, sum(memoryview(part).nbytes for part in parts)

    def write(self, parts: Sequence[Buffer], offset: int) -> None:
        """Write bytes anywhere, through the page cache."""
        write_all(self._fd, parts, offset)

    def sync(self) -> None:
        """Force the file's bytes to the medium, direct or not."""
        os.fdatasync(self._fd)

    def close(self) -> None:
        """Close the file. Idempotent."""
        fds, self._fd, self._direct = (self._fd, self._direct), -1, -1
        for fd in fds:
            if fd >= 0:
                os.close(fd)


class Disk:
    """The local file system. Raises the system's OSError."""

    def make_directory(self, path: Path, *, parents: bool = False) -> None:
        """Create a directory; with ``parents``, also those above, and none of them need be new."""
        path.mkdir(parents=parents, exist_ok=parents)

    def create(self, path: Path, *, direct: bool) -> ShardFile:
        """Create a new file of chunks."""
        return ShardFile(path, direct=direct)

    def write_file(self, path: Path, data: Buffer, *, durable: bool) -> None:
        """Write a whole small file, replacing an existing one; ``durable`` forces it to the medium.

        An existing file is unlinked and not overwritten: under another name it may be somebody's file.
        """
        self.remove(path)
        fd = os.open(path, _NEW, 0o666)
        try:
            write_all(fd, [data], 0)
            # Its name is forced by whoever gives it its final one (`Publisher.replace`).
            if durable:
                os.fsync(fd)
        finally:
            os.close(fd)

    def patch(self, path: Path, data: Buffer, offset: int) -> None:
        """Replace bytes of an existing file, or add some after its end.

        Raises OSError for a file that has another name as well, or is read-only: it is somebody's copy.
        """
        fd = open_regular(path, os.O_WRONLY, follow=False)
        try:
            found = os.fstat(fd)
            if found.st_nlink > 1 or not found.st_mode & _WRITABLE:
                why = "has other names (hard links)" if found.st_nlink > 1 else "is read-only"
                raise PermissionError(errno.EPERM, f"{path} {why} and is not changed")
            write_all(fd, [data], offset)
        finally:
            os.close(fd)

    def reserve(self, path: Path, size: int) -> None:
        """Create a file that reserves ``size`` bytes of the disk; remove it to use them."""
        self.remove(path)
        fd = os.open(path, _NEW, 0o666)
        try:
            os.posix_fallocate(fd, 0, size)  # a file that is only made longer would be sparse
        finally:
            os.close(fd)

    def reserve_more(self, path: Path, size: int) -> None:
        """Make a file of `reserve` larger; it keeps what it has if the disk refuses."""
        fd = os.open(path, os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            os.posix_fallocate(fd, 0, size)
        finally:
            os.close(fd)

    def rename(self, source: Path, target: Path) -> None:
        """Replace ``target`` in one step."""
        source.replace(target)

    def exchange(self, one: Path, other: Path) -> None:
        """Exchange the names of two files or directories in one step, if the file system can."""
        import ctypes  # only for this, which happens rarely

        library = ctypes.CDLL(None, use_errno=True)
        if not hasattr(library, "renameat2"):  # not glibc, or one from before 2018
            raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
        names = os.fsencode(one), os.fsencode(other)
        if library.renameat2(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE):
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code), str(one), None, str(other))

    def remove(self, path: Path) -> None:
        """Remove a file, if it exists."""
        path.unlink(missing_ok=True)

    def remove_tree(self, path: Path) -> None:
        """Remove a directory with everything below it, as far as possible."""
        shutil.rmtree(path, ignore_errors=True)

    def remove_directory(self, path: Path) -> None:
        """Remove a directory, if it exists and is empty."""
        with suppress(FileNotFoundError):
            try:
                path.rmdir()
            except OSError as error:
                if error.errno != errno.ENOTEMPTY:
                    raise

    def sync_directory(self, path: Path) -> None:
        """Force the entries of a directory to the medium; it may be reached by a link, as /data often is."""
        _sync(path, os.O_DIRECTORY)

    def sync_tree(self, path: Path) -> None:
        """Force every file and directory below ``path``, and ``path`` itself, to the medium.

        Files that another process removes in the meantime, as a copier its hold, are skipped.
        """
        for directory, files in _walk(path):
            for file in files:
                with suppress(FileNotFoundError):
                    if kind_of(file.lstat().st_mode) is None:
                        # A link out of the recording, or a pipe in it, must not hold the writer up.
                        _sync(file, os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                self.sync_directory(directory)
            except FileNotFoundError:
                if directory == path:
                    raise

    def free_bytes(self, path: Path) -> int:
        """Return how many bytes the file system of ``path`` can still take from this user."""
        room = os.statvfs(path)
        return room.f_bavail * room.f_frsize


DISK = Disk()
"""The default disk."""


_MEASURED = ".acquire-{}.measure"


def measure_disk(directory: Path, size: int = 2**27) -> float:
    """Measure the bytes per second that the disk of ``directory`` takes, without the page cache if possible.

    Writes ``size`` bytes to a file that loses its name first, so that a kill leaves nothing. Raises OSError.
    """
    # Files of killed measurements, on file systems that cannot create a file without a name.
    for path in directory.glob(_MEASURED.format("*")):
        if not Path("/proc", path.stem.removeprefix(".acquire-")).exists():
            path.unlink(missing_ok=True)
    block = aligned_bytes(2**22)  # as large as the recorder's writes: the cost per write is negligible
    file = _nameless(directory)
    try:
        begun = time.perf_counter()
        for offset in range(0, size, len(block)):
            file.write_pages([block.data], offset)
        file.sync()
        return size / (time.perf_counter() - begun)
    finally:
        file.close()


def _nameless(directory: Path) -> ShardFile:
    """Create a file without a name, or, if the file system cannot, one whose name is removed."""
    try:
        fd = os.open(directory, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600)
    except OSError as error:
        # EISDIR: a kernel that does not know the flag sees an attempt to write to a directory.
        if error.errno not in (errno.EOPNOTSUPP, errno.EISDIR, errno.EINVAL):
            raise
        path = directory / _MEASURED.format(os.getpid())
        try:
            return ShardFile(path, direct=True)
        finally:
            path.unlink(missing_ok=True)
    return ShardFile(Path(f"/proc/self/fd/{fd}"), direct=True, fd=fd)


def tree_bytes(path: Path) -> int:
    """Return the bytes of all files below ``path``."""
    size, left = 0, [os.fspath(path)]
    # Without a Path for each file: lists of recordings come to tens of thousands.
    while left:
        # Of a growing recording, commits rename files and retention removes some at any moment.
        with suppress(OSError), os.scandir(left.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    left.append(entry.path)
                    continue
                with suppress(FileNotFoundError):
                    found = entry.stat()
                    size += found.st_size if stat.S_ISREG(found.st_mode) else 0
    return size


@contextmanager
def locked(path: Path, doing: str, *, surely: bool = False) -> Iterator[None]:
    """Lock the directory ``path``. Raises StateError while another process has it. Ends with this process.

    A file system without locks counts as unlocked; with ``surely`` it raises StateError instead.
    """
    fd = lock(path, doing, surely=surely)
    try:
        yield
    finally:
        os.close(fd)


def lock(path: Path, doing: str, *, surely: bool = False) -> int:
    """Return a descriptor that locks the directory ``path`` until it is closed; see `locked`."""
    # Lock the directory itself: a lock file could be left behind, or have the name of an array.
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | os.O_NOFOLLOW)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(fd)
        raise StateError(
            f"{doing} {path}: another process is writing it", hint="again, when its recording has ended"
        ) from error
    except OSError as error:
        if error.errno not in NO_LOCKS:
            os.close(fd)
            raise
        if surely:
            os.close(fd)
            raise StateError(
                f"{doing} {path}: its file system has no locks, which would show whether it is being written",
                hint="a copy of it on a disk of this host, or a mount with locks",
            ) from error
    return fd


def is_locked(path: Path) -> bool | None:
    """Return whether a process has the directory ``path`` locked; None if that cannot be known."""
    # A shared lock: two that only look do not meet each other.
    try:
        fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return None
    finally:
        os.close(fd)
    return False


def _walk(path: Path) -> Iterator[tuple[Path, list[Path]]]:
    # From the bottom up: `sync_tree` forces bytes before the names that lead to them.
    for directory, _, names in os.walk(path, topdown=False):
        base = path.__class__(directory)
        yield base, [base / name for name in names]


def _sync(path: Path, flags: int) -> None:
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | flags)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


@dataclass(frozen=True, slots=True)
class Publisher:
    """Replaces files so that a reader finds either the old or the new bytes.

    ``scratch`` is the file in which new bytes are prepared: on the same file system, and where no Zarr reader
    lists names, since a killed writer leaves it behind. One thread at a time.
    """

    scratch: Path
    disk: Disk = DISK

    def replace(self, path: Path, data: Buffer, *, durable: bool = False) -> None:
        """Replace ``path``; ``durable`` forces bytes and name to the medium before returning."""
        # Bytes first: otherwise a name might lead to an empty file after a power failure.
        try:
            self.disk.write_file(self.scratch, data, durable=durable)
            self.disk.rename(self.scratch, path)
        except OSError:
            with suppress(OSError):  # a disk that is full takes the name, but no byte
                self.disk.remove(self.scratch)
            raise
        if durable:
            self.disk.sync_directory(path.parent)
