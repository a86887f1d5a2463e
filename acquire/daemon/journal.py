"""Paths that the next daemon has to hear of, in a small file beside the recordings."""

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
"""That a journal is believed to name."""

log = logging.getLogger("acquire.daemon")


class Journal:
    """The file and its one list, ``key``; ``what`` names in a log what the paths are for."""

    def __init__(self, file: Path | None, key: str, what: str) -> None:
        self._file = file
        self._key = key
        self._what = what
        self._written: list[str] | None = None

    def read(self) -> list[Path]:
        """What an earlier daemon has left; nothing, and a line in the log, where that is not clear."""
        if self._file is None:
            return []
        try:
            named = read_object(self._file, follow=False)[self._key]
            paths = [str(path) for path in named[:MOST_PATHS] if _is_path(path)]
        except FileNotFoundError:
            return []
        except (OSError, ValueError, LookupError, TypeError) as error:
            log.error("%s does not say what is %s: %s", self._file, self._what, error)  # noqa: TRY400
            return []
        if (odd := len(named) - len(paths)) > 0:
            log.error("%s: %d entries are no absolute paths, or too many", self._file, odd)
        self._written = paths
        return [Path(path) for path in paths]

    def write(self, paths: Iterable[Path]) -> None:
        """Write down what is left now, or remove the file; a failure costs a line in the log."""
        left = [str(path) for path in paths]
        if self._file is None or left == self._written:
            return
        self._written = left
        try:
            if left:
                text = json.dumps({self._key: left}, indent=1).encode()
                scratch = self._file.with_name(f"{self._file.name}.next")
                Publisher(scratch).replace(self._file, text, durable=True)
            else:
                self._file.unlink(missing_ok=True)
        except OSError as error:
            log.error(  # noqa: TRY400
                "%s cannot be written: %s; the next daemon will not know what is %s",
                self._file,
                error.strerror or error,
                self._what,
            )


def _is_path(value: object) -> bool:
    return isinstance(value, str) and "\0" not in value and Path(value).is_absolute()
