"""What Tab offers for the words of commands: configurations, states of the daemon, recordings.

The functions are called by the completion of bash, zsh and fish while a word is being typed: they import
little, and what they cannot find out they leave out.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

STATES = ("idle", "armed", "recording", "draining", "faulted", "sealed")


def states(incomplete: str) -> list[str]:
    """Of the daemon, and ``sealed``: see `acquire.daemon.states`."""
    return [state for state in STATES if state.startswith(incomplete)]


def recordings(incomplete: str) -> list[str]:
    """Recordings and videos (NAME.zarr), and directories on the way to them."""
    return _paths(incomplete, (".zarr",))


def rigs(incomplete: str) -> list[str]:
    """Built-in rigs, and TOML files."""
    return _configurations(incomplete, "rig-")


def scenes(incomplete: str) -> list[str]:
    """Built-in scenes, TOML files, and what else a scene can be made of."""
    return [*_built_in(incomplete, "scene-"), *_paths(incomplete, (".toml", ".npy", ".png", ".mp4"))]


def plans(incomplete: str) -> list[str]:
    """Built-in plans, and TOML files."""
    return _configurations(incomplete, "plan-")


def configurations(incomplete: str) -> list[str]:
    """Built-in rigs, scenes and plans, and TOML files."""
    return _configurations(incomplete, "")


def _configurations(incomplete: str, kind: str) -> list[str]:
    return [*_built_in(incomplete, kind), *_paths(incomplete, (".toml",))]


def _built_in(incomplete: str, kind: str) -> list[str]:
    from acquire.place import builtin_names

    return [name for name in builtin_names(kind) if name.startswith(incomplete)]


def _paths(incomplete: str, suffixes: Iterable[str]) -> list[str]:
    """Files and directories that begin so and end so, and directories, which may hold more."""
    parent, _, begun = incomplete.rpartition("/")
    base = Path(f"{parent}/" if incomplete.startswith("/") or parent else ".")
    found = []
    with suppress(OSError):
        for path in sorted(base.iterdir()):
            if not path.name.startswith(begun) or (path.name.startswith(".") and not begun):
                continue
            word = f"{parent}/{path.name}" if "/" in incomplete else path.name
            if path.name.endswith(tuple(suffixes)):
                found.append(word)
            elif path.is_dir():
                found.append(f"{word}/")
    return found
