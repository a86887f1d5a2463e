"""A small file next to the recordings with paths that the next daemon has to deal with."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import TYPE_CHECKING

from acquire.reading import read_object
from acquire.store.files import Publisher

if TYPE_CHECKING:
    from collections.abc import Iterable

MOST_PATHS = 10_000
"""Number of entries of a journal that are read."""

log = logging.getLogger("acquire.daemon")


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
            log.error("%s: %d entries are not absolute paths, or too many", self._file, odd)
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
