"""Reading files that anybody may have put there: regular ones only, up to a size, and JSON that is an object.

A directory that many programs and people write to holds more than recordings: pipes that keep a reader
waiting for ever, links to devices, documents nested so deeply that the parser gives up. What is refused here
is an OSError (the file) or a ValueError (its content), with a reason in words.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

MOST_BYTES = 2**26
"""Of a document or a table that is read whole; the largest that acquire writes is a few MB."""
MOST_DEPTH = 64
"""Of nested lists and objects in a document; those that acquire writes have a dozen levels."""


class OddFileError(OSError):
    """It is there, and nothing that could be read as a file of ours."""


_KINDS = (
    (stat.S_ISLNK, "a link"),
    (stat.S_ISDIR, "a directory"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def kind_of(mode: int) -> str | None:
    """What a directory entry is, in words; None for a regular file."""
    return next((words for is_kind, words in _KINDS if is_kind(mode)), None)


def open_regular(path: Path | str, flags: int = os.O_RDONLY, *, follow: bool = True) -> int:
    """A descriptor of a regular file. Raises OSError for anything else, without waiting for it.

    ``follow``: a link may lead to the file. A device is not even opened: some act on that alone.
    """
    mode = os.stat(path, follow_symlinks=follow).st_mode  # noqa: PTH116 - for every chunk that is read
    if (kind := kind_of(mode)) is None:
        fd = os.open(path, flags | os.O_CLOEXEC | os.O_NONBLOCK | (0 if follow else os.O_NOFOLLOW))
        if (kind := kind_of(os.fstat(fd).st_mode)) is None:  # it may have been exchanged since
            return fd
        os.close(fd)
    number = errno.ELOOP if stat.S_ISLNK(mode) else errno.EINVAL
    raise OddFileError(number, f"it is {kind}, not a file", str(path))


def read_regular(path: Path | str, most_bytes: int = MOST_BYTES, *, follow: bool = True) -> bytes:
    """All bytes of a regular file. Raises OSError for anything else, and for a file that is too large."""
    fd = open_regular(path, follow=follow)
    with os.fdopen(fd, "rb") as file:
        size = os.fstat(fd).st_size
        data = file.read(most_bytes + 1) if size <= most_bytes else b""
    if max(size, len(data)) > most_bytes:
        raise OddFileError(errno.EFBIG, f"it is larger than the {most_bytes} bytes that are read", str(path))
    return data


def parse_object(data: bytes) -> dict[str, Any]:
    """The JSON object that ``data`` is. Raises ValueError for anything else."""
    try:
        document = json.loads(data)
    except RecursionError:
        raise ValueError("its JSON is nested too deeply") from None
    if not isinstance(document, dict):
        raise ValueError(f"a JSON object is expected, not {type(document).__name__}")  # noqa: TRY004
    level: list[Any] = [document]
    for _ in range(MOST_DEPTH):
        level = [
            value
            for node in level
            for value in (node.values() if isinstance(node, dict) else node)
            if isinstance(value, dict | list)
        ]
        if not level:
            return document
    raise ValueError(f"its JSON is nested deeper than {MOST_DEPTH} levels")


def read_object(path: Path | str, *, follow: bool = True) -> dict[str, Any]:
    """The JSON object in a regular file. Raises OSError, and ValueError for what is no such object."""
    return parse_object(read_regular(path, follow=follow))
