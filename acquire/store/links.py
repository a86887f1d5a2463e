"""Links in recordings: readers follow them; repair, copy, hold and deletion refuse them.

Through a link these would reach files that do not belong to the recording: the originals of an archive that
keeps its files elsewhere (git-annex), another recording, or any file of the system.
"""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from typing import TYPE_CHECKING

from acquire.errors import DataError
from acquire.lines import ARMS
from acquire.reading import kind_of
from acquire.store.refusals import refusal, refused

if TYPE_CHECKING:
    from pathlib import Path


def refuse_links(root: Path) -> None:
    """Raise DataError unless ``root`` and everything below it are directories and regular files.

    A directory without any part of a recording passes: opening it reports that it is not a recording. Raises
    the error of `refusals.refusal` if the entries cannot be read.
    """
    refuse_link(root, root)
    if not any(os.path.lexists(root / part) for part in ("zarr.json", *ARMS)):
        return
    # A list and not `os.walk`, which would pass over a directory that cannot be read.
    waiting = [str(root)]
    while waiting:
        try:
            with os.scandir(waiting.pop()) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        waiting.append(entry.path)
                    elif (kind := kind_of(entry.stat(follow_symlinks=False).st_mode)) is not None:
                        raise _odd(root, entry.path, kind)
        except FileNotFoundError:
            continue  # retention or a commit has removed it in the meantime
        except OSError as error:
            raise refusal(root, error, "read") from error


def refuse_link(root: Path, path: Path) -> None:
    """Raise DataError if ``root``, ``path`` or a directory between them is a link or a special file."""
    below = path.relative_to(root)
    for part in (*reversed(below.parents), below):
        # What is not there yet, such as the directory of the holds, leads nowhere.
        with refused(root, "read"), suppress(FileNotFoundError, NotADirectoryError):
            mode = os.lstat(root / part).st_mode
            if (kind := kind_of(mode)) is not None and not stat.S_ISDIR(mode):
                raise _odd(root, str(root / part), kind)


def _odd(root: Path, path: str, kind: str) -> DataError:
    where = os.path.relpath(path, root)
    what = f"is {kind}, not touched" if where == "." else f"holds {kind}, not touched: {where}"
    hint = f"a copy of the recording without {kind}"
    if kind == "a link":
        hint = "the target of the link, or a copy with files in place of links: cp -rL, git annex unlock"
    return DataError(f"{root} {what}", possible="directories and regular files", hint=hint)
