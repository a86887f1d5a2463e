"""A small file next to the recordings with paths that the next daemon has to deal with."""

from __future__ import annotations

import contextlib
import json
import logging
import os
from pathlib import Path
from typing import TYPE_CHECKING

from acquire.errors import StateError, UsageError
from acquire.processes.lockfile import LockFile
from acquire.reading import read_object
from acquire.store.files import NO_LOCKS, Publisher
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

MOST_PATHS = 10_000
"""Number of entries of a journal that are read."""
_OTHERWISE = "a name of its own in its rig file, or --set name=NAME; or another recording.directory"

log = logging.getLogger("acquire.daemon")


def journal_path(directory: Path, name: str, what: str) -> Path:
    """Return the file in which the rig ``name`` lists recordings that are not sealed, or not copied, yet."""
    return directory / f".{what}-{name}.json"


class Claim:
    """The right of one daemon to the journals of the rig ``name`` in ``directory``: a lock file there.

    One thread at a time.
    """

    def __init__(self, directory: Path, name: str) -> None:
        self._directory = directory
        self._name = name
        self._path = directory / f".recordings-{name}.lock"
        self._lock: LockFile | None = None
        self._identity: tuple[int, int] | None = None

    def take(self) -> bool:
        """Lock the directory, unless its lock is held; return whether another directory was locked before.

        Raises StateError if another daemon has the lock, UsageError if something else has its name, and
        OSError for a directory that cannot be locked.
        """
        if self._lock is not None and self._lock.is_there:
            return False
        try:
            found = self._directory.stat()
            # Whoever may write to the directory may follow this daemon.
            lock = LockFile(self._path, found.st_mode & 0o666)
            with contextlib.ExitStack() as undo:
                undo.callback(lock.close)
                self._lock_it(lock)
                undo.pop_all()
        except OSError as error:
            if os.path.lexists(self._path) and error.errno not in NO_LOCKS:
                text = f"{self._path}, which keeps two daemons of one rig apart: {error.strerror}"
                raise UsageError(text, hint=_OTHERWISE) from error
            raise
        self.close()
        before, self._identity = self._identity, (found.st_dev, found.st_ino)
        self._lock = lock
        return before not in (None, self._identity)

    def _lock_it(self, lock: LockFile) -> None:
        try:
            lock.take()
        except BlockingIOError:
            who = f"another daemon (process {lock.owner}) of a rig named {self._name}"
            raise StateError(f"{who} records into {self._directory}", hint=_OTHERWISE) from None

    def close(self) -> None:
        """Release the lock. Idempotent."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None


@contextlib.contextmanager
def only_user(directory: Path, name: str) -> Iterator[Claim]:
    """Keep the journals of the rig ``name`` in ``directory`` from every other daemon.

    Raises StateError if one uses them: each would overwrite the other's lists. A directory that cannot be
    locked is logged.
    """
    with contextlib.closing(Claim(directory, name)) as claim:
        try:
            claim.take()
        except OSError as error:
            log.warning(
                "a second daemon of this rig would not be noticed in %s: %s", directory, error.strerror
            )
        yield claim


class Journal:
    """The file and its only list, ``key``; ``what`` describes the paths in log messages."""

    def __init__(self, file: Path | None, key: str, what: str) -> None:
        self._file = file
        self._key = key
        self._what = what
        self._written: list[str] | None = None

    def read(self) -> list[Path]:
        """Return the paths left by an earlier daemon; none, and a line in the log, if the file is damaged."""
        if self._file is None:
            return []
        try:
            named = read_object(self._file, follow=False)[self._key]
            paths = [
                path
                for path in named[:MOST_PATHS]
                if isinstance(path, str) and "\0" not in path and Path(path).is_absolute()
            ]
        except FileNotFoundError:
            return []
        except (OSError, ValueError, LookupError, TypeError) as error:
            log.error("%s does not say what is %s: %s", self._file, self._what, error)  # noqa: TRY400 - no traceback
            return []
        if (odd := len(named) - len(paths)) > 0:
            log.error("%s: %s no absolute path, or too many", self._file, counted(odd, "entry", "is"))
        self._written = paths
        return [Path(path) for path in paths]

    def write(self, paths: Iterable[Path]) -> None:
        """Write the paths that are left now, or remove the file; a failure is logged."""
        left = [str(path) for path in paths]
        if self._file is None or left == self._written:
            return
        # Set even if writing fails: the error is logged once, and the next change tries again.
        self._written = left
        try:
            if left:
                text = json.dumps({self._key: left}, indent=1).encode()
                scratch = self._file.with_name(f"{self._file.name}.next")
                # Replaced as a whole, since the daemon may be killed at any moment.
                Publisher(scratch).replace(self._file, text, durable=True)
            else:
                self._file.unlink(missing_ok=True)
        except OSError as error:
            log.error(  # noqa: TRY400 - no traceback
                "%s cannot be written: %s; the next daemon will not know what is %s",
                self._file,
                error.strerror or error,
                self._what,
            )
