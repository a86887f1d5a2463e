"""Places on this machine that a command is given: paths, and directories that it makes."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator


def local_path(text: str) -> Path:
    """A path on this machine; UsageError for a URL of anything else."""
    if "://" in text and not text.startswith("file://"):
        raise UsageError(
            f"{text} is a URL, and this command changes a recording in place, which a remote store cannot do",
            possible="a path on this machine",
            hint="the recording where it was made; info, verify, cut, reconstruct and replay take URLs",
        )
    return Path(text.removeprefix("file://"))


@contextlib.contextmanager
def new_directory(path: Path) -> Iterator[None]:
    """Make the directory that a command fills; it is removed again if nothing has been put in it."""
    from acquire.store.files import check_new_path

    check_new_path(path)
    path.mkdir()
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # it is not empty
            path.rmdir()
