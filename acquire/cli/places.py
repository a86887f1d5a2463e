"""Paths on this machine: arguments that must not be URLs, output directories, and private ones."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

SOCKET = "c.sock"
"""Name of the control socket in a `private_directory`."""
PAGE = "index.html"
# The address of a Unix socket has room for 104 bytes on BSD and macOS, and 108 on Linux.
LONGEST_SOCKET = 90
"""Longest path of a socket (bytes) that every system accepts."""


def given_path(text: str) -> str:
    """Parse a path or URL. Raises UsageError for an empty one, which would be the current directory."""
    # As `acquire recover "$RUN"` in a shell without RUN.
    if not text:
        raise UsageError(
            "the path is empty", possible="a path or URL", hint=". if the current directory is meant"
        )
    return text


def local_path(text: str) -> Path:
    """Parse a path on this machine. Raises UsageError for an empty one, and a URL of anything else."""
    if _is_elsewhere(given_path(text)):
        raise UsageError(
            f"{text} is a URL, but this command changes a recording in place, which a remote store does not "
            "allow",
            possible="a path on this machine",
            hint="the recording where it was made; info, verify, cut, reconstruct and replay accept URLs",
        )
    # A file URL is a path on this machine, and other programs hand these out.
    return Path(text.removeprefix("file://"))


def calibration_place(text: str) -> str:
    """Parse the place of a calibration to write or extend. Raises what saving one there would raise."""
    from acquire.calibrate.file import check_calibration_place

    check_calibration_place(given_path(text))
    return text


def local_directory(given: str | Path) -> Path:
    """Parse a directory on this machine. Raises UsageError for an empty path, and a URL of anything else."""
    text = str(given)  # typer gives the default to the parser as well, and that is a path
    if _is_elsewhere(given_path(text)):
        raise UsageError(
            f"{text} is a URL, but `acquire ls` lists a directory of this machine",
            possible="a path on this machine",
            hint=f"acquire info {text.rstrip('/')}/NAME.zarr describes one",
        )
    return Path(text.removeprefix("file://"))


def _is_elsewhere(text: str) -> bool:
    return "://" in text and not text.startswith("file://")


@contextlib.contextmanager
def private_directory() -> Iterator[Path]:
    """Make a temporary directory for a daemon's socket and files, removed at the end of the block."""
    with contextlib.ExitStack() as held:
        name = held.enter_context(tempfile.TemporaryDirectory(prefix="acquire-"))
        # TMPDIR may be deeper than the path of a socket may be long.
        if len(os.fsencode(f"{name}/{SOCKET}")) > LONGEST_SOCKET:
            name = held.enter_context(tempfile.TemporaryDirectory(prefix="acquire-", dir="/tmp"))
        yield Path(name)


@contextlib.contextmanager
def new_directory(path: Path) -> Iterator[None]:
    """Create the output directory of a command that writes a page into it, as its last file.

    If the command ends early without a page, what it has made is removed: nobody could tell what is missing.
    """
    make_directory(path)
    try:
        yield
    except BaseException:
        if not (path / PAGE).exists():
            shutil.rmtree(path, ignore_errors=True)
        raise


def make_directory(path: Path) -> None:
    """Create a directory. Raises UsageError if it exists, and what `refused` raises if that is impossible."""
    from acquire.store.files import check_new_path
    from acquire.store.refusals import refused

    check_new_path(path)
    with refused(path, "created"):
        path.mkdir()
