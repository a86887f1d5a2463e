"""The one way in which anything of a recording is deleted: with a proof that no line is lost by it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.errors import DataError
from acquire.lines import ARMS
from acquire.store.files import SCRATCH
from acquire.store.layout import line_columns
from acquire.store.links import refuse_link, refuse_links
from acquire.store.shape import shard_key

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from acquire.store.files import Disk

ROOT = "zarr.json"
RESERVE = ".reserve"
"""Of a recording that is being written, beside the shards of the first array: room for its end."""
COPY = ".attributes"
"""The root's attributes once more, beside the shards of the first array; see `acquire.store.rebuild`."""
_MADE_FIRST = {ROOT, SCRATCH, RESERVE, COPY}
"""Files that are there before the first line; everything else holds lines, or is somebody else's."""


@dataclass(frozen=True, slots=True)
class Unborn:
    """Proof for a whole directory: nobody has ever counted a line of it as committed."""

    committed_lines: int


@dataclass(frozen=True, slots=True)
class Dropped:
    """Proof for one shard: retention has told, in the recording's root, that these shards are dropped."""

    shard: int
    told: Sequence[range]


def remove(disk: Disk, path: Path, proof: Unborn | Dropped) -> None:
    """Delete what the proof is for, of the recording at ``path``; no matter if parts of it are gone.

    Raises DataError, and deletes nothing, where the proof does not hold, or a link leads elsewhere.
    """
    match proof:
        case Unborn(committed_lines):
            _check_unborn(path, committed_lines)
            disk.remove_tree(path)
        case Dropped(shard, told):
            if not any(shard in shards for shards in told):
                raise DataError(f"{path}: shard {shard} is not deleted: retention has not told of it")
            files = shard_files(path, shard)
            for file in files:
                refuse_link(path, file)
            for file in files:
                disk.remove(file)
            for arm in ARMS:
                disk.remove_directory(path / arm / "lines" / "c" / str(shard))


def shard_files(path: Path, shard: int) -> list[Path]:
    """The files of a shard in all arrays of both arms, that there are."""
    files = [
        path / arm / column.name / shard_key(shard, 2 if column.name == "lines" else 1)
        for arm in ARMS
        for column in line_columns("any")
    ]
    return [file for file in files if file.exists()]


def shards_on_disk(path: Path) -> list[int]:
    """Numbers of the shards of which any array has something, in order."""
    found: set[int] = set()
    for arm in ARMS:
        for column in line_columns("any"):
            found.update(shard_numbers(path / arm / column.name))
    return sorted(found)


def shard_numbers(array: Path) -> list[int]:
    """Numbers of the shards in the directory of one array, in order; other names are passed over."""
    try:
        names = [entry.name for entry in (array / "c").iterdir()]
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise DataError(f"{array} cannot be looked through: {error.strerror}") from error
    short = (name for name in names if name.isascii() and name.isdecimal() and len(name) < 19)
    return sorted(int(name) for name in short if str(int(name)) == name)


def _check_unborn(path: Path, committed_lines: int) -> None:
    if committed_lines:
        raise DataError(f"{path} is not removed: {committed_lines} lines of it were committed")
    refuse_links(path)
    for directory, _, names in os.walk(path):
        if odd := sorted(set(names) - _MADE_FIRST):
            held = f"{os.path.relpath(directory, path)}/{odd[0]}"
            raise DataError(f"{path} is not removed: it holds {held}")
