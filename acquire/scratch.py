"""A temporary directory for what libraries keep between runs, if this user's home takes nothing."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path

from acquire.place import home

PREFIX = "acquire-scratch-"


@cache
def scratch_directory() -> str:
    """Return a directory of this process and its children, which is removed when this process ends."""
    # It has no fixed name: whoever could make it first would have their compiled code run here.
    path = tempfile.mkdtemp(prefix=PREFIX)
    atexit.register(shutil.rmtree, path, ignore_errors=True)
    return path


def prepare_matplotlib() -> None:
    """Give matplotlib, before it is imported, a directory where it would print that it has made one."""
    if not os.environ.get("MPLCONFIGDIR") and not _has_place_for_matplotlib():
        os.environ["MPLCONFIGDIR"] = scratch_directory()


def _has_place_for_matplotlib() -> bool:
    """Whether this user can write, or make, the directories that matplotlib chooses."""
    places = [
        Path(os.environ.get(variable) or home() / usual) / "matplotlib"
        for variable, usual in (("XDG_CONFIG_HOME", ".config"), ("XDG_CACHE_HOME", ".cache"))
    ]
    try:
        there = [next(each for each in (place, *place.parents) if each.exists()) for place in places]
    except OSError:  # this user may not look at it
        return False
    return all(os.access(each, os.W_OK | os.X_OK) for each in there)
