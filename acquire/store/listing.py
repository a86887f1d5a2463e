"""Which entries of a directory are recordings, videos or calibrations: by their name, or by what they hold.

Recordings may have any name. Everything called NAME.zarr counts, so that a damaged one, or a link that leads
nowhere, is reported instead of left out. Of other entries, those directories count that state a format of
ours, or hold the lines of a recording whose root document is lost. Neither links nor hidden directories
without that ending are looked into, nor anything further down.
"""

from __future__ import annotations

import os
from pathlib import Path

from acquire.flags import ARMS
from acquire.reading import read_object

SUFFIX = ".zarr"
ROOT = "zarr.json"
COPY = ".attributes"
"""Copy of the root's attributes, next to the shards of the first array; see `acquire.store.rebuild`."""
_OURS = "acquire-"
"""Beginning of each of our formats."""


def candidates(directory: Path) -> list[Path]:
    """Return the entries that are, or may be, recordings, videos or calibrations, by name. Raises OSError."""
    with os.scandir(directory) as entries:
        return sorted(directory / entry.name for entry in entries if _counts(entry))


def is_ours(path: Path) -> bool:
    """Return whether an entry of a directory is one of `candidates`, and a directory itself."""
    if path.is_symlink() or not path.is_dir():
        return False
    return path.name.endswith(SUFFIX) or (not path.name.startswith(".") and _holds_ours(path))


def _counts(entry: os.DirEntry[str]) -> bool:
    if entry.name.endswith(SUFFIX):
        return True
    try:
        is_directory = entry.is_dir(follow_symlinks=False)
    except OSError:
        return False
    return is_directory and not entry.name.startswith(".") and _holds_ours(Path(entry.path))


def _holds_ours(path: Path) -> bool:
    try:
        stated = read_object(path / ROOT, follow=False)["attributes"]["format"]
    except (OSError, ValueError, LookupError, TypeError):
        # Of a recording, a copy lies next to the lines; `recover` makes another root of it.
        return os.path.lexists(path / ARMS[0] / "lines" / COPY)
    return isinstance(stated, str) and stated.startswith(_OURS)
