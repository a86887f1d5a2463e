"""The only way to delete parts of a recording: with a proof that no line is lost by it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.errors import DataError
from acquire.lines import ARMS
from acquire.store.files import SCRATCH
from acquire.store.layout import line_columns
from acquire.store.links import refuse_link, refuse_links
from acquire.store.listing import COPY, ROOT
from acquire.store.shape import shard_key
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from acquire.store.files import Disk

RESERVE = ".reserve"
"""File that keeps room for a recording's end while it is written, next to the shards of the first array."""
_MADE_FIRST = {ROOT, SCRATCH, RESERVE, COPY}
"""Files that exist before the first line; all others hold lines, or belong to somebody else."""


@dataclass(frozen=True, slots=True)
class Unborn:
    """Proof for a whole directory: no line of it was ever committed."""

    committed_lines: int


@dataclass(frozen=True, slots=True)
class Dropped:
    """Proof for one shard: the recording's root lists these shards as dropped by retention."""

    shard: int
    listed: Sequence[range]


def remove(disk: Disk, path: Path, proof: Unborn | Dropped) -> None:
    """Delete the proof's object from the recording at ``path``; parts of it may be gone already.

    Raises DataError, and deletes nothing, if the proof does not hold, or a link leads elsewhere.
    """
    match proof:
        case Unborn(committed_lines):
            if committed_lines:
                raise DataError(
                    f"{path} is not removed: {counted(committed_lines, 'line of it', 'was')} committed",
                    hint="acquire recover, which seals it with these lines",
                )
            refuse_links(path)
            _refuse_lines(path)
            disk.remove_tree(path)
        case Dropped(shard, listed):
            if not any(shard in shards for shards in listed):
                raise DataError(
                    f"{path}: shard {shard} is not deleted: it is not listed as dropped",
                    hint="acquire verify, which lists the lines that are there",
                )
            files = shard_files(path, shard)
            for file in files:
                refuse_link(path, file)
            # Not before all of them are known to be ours: a shard goes from every array, or from none.
            for file in files:
                disk.remove(file)
            for arm in ARMS:
                disk.remove_directory(path / arm / "lines" / "c" / str(shard))


def _refuse_lines(path: Path) -> None:
    """Raise DataError if a directory holds, or may hold, what came after a recording's preparation."""

    def unknown(error: OSError) -> None:
        raise DataError(
            f"{path} is not removed: what it holds cannot be listed: {error.strerror}",
            hint="the permissions of its directories, or the disk",
        )

    # Without `unknown`, a directory that cannot be listed now would count as an empty one.
    for directory, _, names in os.walk(path, onerror=unknown):
        if odd := sorted(set(names) - _MADE_FIRST):
            held = f"{os.path.relpath(directory, path)}/{odd[0]}"
            raise DataError(
                f"{path} is not removed: it holds {held}",
                hint="look at what it holds, and delete it yourself if it is not needed",
            )


def shard_files(path: Path, shard: int) -> list[Path]:
    """Return the existing files of a shard in all arrays of both arms."""
    files = [
        path / arm / column.name / shard_key(shard, 2 if column.name == "lines" else 1)
        for arm in ARMS
        for column in line_columns("any")
    ]
    return [file for file in files if file.exists()]


def shards_on_disk(path: Path) -> list[int]:
    """Return the numbers of the shards of which any array has a file, in order."""
    found: set[int] = set()
    for arm in ARMS:
        for column in line_columns("any"):
            found.update(shard_numbers(path / arm / column.name))
    return sorted(found)


def shard_numbers(array: Path) -> list[int]:
    """Return the numbers of the shards in the directory of one array, in order; other names are skipped."""
    try:
        names = [entry.name for entry in (array / "c").iterdir()]
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise DataError(
            f"{array} cannot be listed: {error.strerror}",
            hint="the permissions of its directories, or the disk",
        ) from error
    # Zarr writes plain decimal numbers: `007`, `²` and numbers beyond 64 bits are names of somebody else's.
    short = (name for name in names if name.isascii() and name.isdecimal() and len(name) < 19)
    return sorted(int(name) for name in short if str(int(name)) == name)
