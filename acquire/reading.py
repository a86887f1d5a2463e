"""Safe reading of files that anybody may have created: regular ones of limited size, and JSON objects.

A directory that many programs and people write to holds more than recordings: pipes that keep a reader
waiting for ever, links to devices, documents nested so deeply that the parser gives up. A refusal is an
OSError (the file) or a ValueError (its content) whose message states the reason.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from pathlib import Path
from typing import Any

from acquire.errors import PlaceError
from acquire.text import shown

MOST_BYTES = 2**26
"""Size limit of a document or table that is read whole; the largest that acquire writes is a few MB."""
MOST_DEPTH = 64
"""Limit on the nesting of a document; those that acquire writes have a dozen levels."""


class OddFileError(OSError):
    """The file exists but cannot be one of ours: not a regular file, or too large."""


_KINDS = (
    (stat.S_ISLNK, "a link"),
    (stat.S_ISDIR, "a directory"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


_NESTS: frozenset[type] = frozenset({dict, list})


def path_of(place: object) -> Path:
    """Return the path that a caller gave as a Path or a text. Raises PlaceError for anything else."""
    if not isinstance(place, str | os.PathLike) or "\0" in str(place):
        raise PlaceError(f"{shown(place)} cannot be a path", possible="a Path, or text without a zero byte")
    return Path(place)


def kind_of(mode: int) -> str | None:
    """Return what kind of directory entry a mode stands for, in words; None for a regular file."""
    return next((words for is_kind, words in _KINDS if is_kind(mode)), None)


def open_regular(path: Path | str, flags: int = os.O_RDONLY, *, follow: bool = True) -> int:
    """Open a regular file and return its descriptor. Raises OSError for anything else, without blocking.

    With ``follow``, the path may be a link. A device is not even opened, since some react to that alone.
    """
    mode = os.stat(path, follow_symlinks=follow).st_mode  # noqa: PTH116 - for every chunk that is read
    if (kind := kind_of(mode)) is None:
        # O_NONBLOCK: a pipe that has taken the place of the file since would keep `open` waiting.
        fd = os.open(path, flags | os.O_CLOEXEC | os.O_NONBLOCK | (0 if follow else os.O_NOFOLLOW))
        if (kind := kind_of(os.fstat(fd).st_mode)) is None:  # it may have been replaced since `stat`
            return fd
        os.close(fd)
    number = errno.ELOOP if stat.S_ISLNK(mode) else errno.EINVAL
    raise OddFileError(number, f"it is {kind}, not a file", str(path))


def read_regular(path: Path | str, most_bytes: int = MOST_BYTES, *, follow: bool = True) -> bytes:
    """Return all bytes of a regular file. Raises OSError for anything else, and for one that is too large."""
    fd = open_regular(path, follow=follow)
    with os.fdopen(fd, "rb") as file:
        size = os.fstat(fd).st_size
        # One byte more than allowed shows a file that has grown since, or whose size is not stated.
        data = file.read(most_bytes + 1) if size <= most_bytes else b""
    if max(size, len(data)) > most_bytes:
        raise OddFileError(errno.EFBIG, f"it is larger than the limit of {most_bytes} bytes", str(path))
    return data


def parse_object(data: bytes) -> dict[str, Any]:
    """Return the JSON object that ``data`` holds. Raises ValueError for anything else."""
    try:
        document = json.loads(data)
    except RecursionError:
        raise ValueError("its JSON is nested too deeply") from None
    if not isinstance(document, dict):
        raise ValueError(f"a JSON object is expected, not {type(document).__name__}")  # noqa: TRY004
    # Level by level, since a recursive check would fail where it is needed.
    level: list[Any] = [document]
    for _ in range(MOST_DEPTH):
        level = [
            value
            for node in level
            for value in (node.values() if isinstance(node, dict) else node)
            if type(value) in _NESTS  # what `json` makes has no other class; several times faster
        ]
        if not level:
            return document
    raise ValueError(f"its JSON is nested deeper than {MOST_DEPTH} levels")


def read_object(path: Path | str, *, follow: bool = True) -> dict[str, Any]:
    """Return the JSON object in a regular file. Raises OSError, and ValueError if it holds anything else."""
    return parse_object(read_regular(path, follow=follow))
