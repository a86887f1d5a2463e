"""The files of `retention.hold`: lines of a recording that must not be deleted, and why.

The writer of an endless recording looks at all of them at every commit, of which there are ten a second, and
there may be thousands. `HoldFiles` reads a file again only if it has changed.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.lines import ARMS
from acquire.reading import read_object
from acquire.store.layout import PARSE_ERRORS
from acquire.store.terms import ALL_LINES
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

HOLDS = ".holds"
"""Directory of the files, placed where no Zarr reader lists names."""
SETTLED_S = 3.0
"""A file that has not changed for so long is not read again; some file systems keep times in steps of 2 s."""


@dataclass(frozen=True, slots=True)
class Hold:
    """Lines that must not be deleted, and why."""

    first_line: int
    count: int
    why: str = ""

    @property
    def lines(self) -> range:
        return range(self.first_line, self.first_line + self.count)


@dataclass(frozen=True, slots=True)
class _Known:
    """A file that was read: what tells whether it has changed, since when it has not, and its hold."""

    identity: tuple[int, ...]
    since_s: float
    settled: bool
    hold: Hold


class HoldFiles:
    """The holds of one recording that is being written. One thread at a time."""

    def __init__(self, path: Path, now_s: Callable[[], float] = time.monotonic) -> None:
        self._directory = directory_of_holds(path)
        self._now_s = now_s
        self._known: dict[str, _Known] = {}

    def read(self) -> list[Hold]:
        """Return all holds, by name. A file that cannot be read may stand for any lines: it holds all."""
        known, self._known = self._known, {}
        try:
            with os.scandir(self._directory) as entries:
                files = [one for one in entries if one.name[0].isdecimal() and one.name.endswith(".json")]
        except FileNotFoundError:
            return []
        except OSError as error:
            return [Hold(0, ALL_LINES, f"{HOLDS} cannot be read: {error.strerror}")]
        found = []
        for entry in sorted(files, key=lambda entry: entry.name):
            try:
                found.append(self._hold(entry, known.get(entry.name)))
            except FileNotFoundError:
                continue  # replaced by a wider one, or released, in the meantime
            except (*PARSE_ERRORS, OSError) as error:
                # Not kept: the error may pass, such as no descriptor left.
                why = f"{entry.name} is not a valid hold, remove it: {error}"
                found.append(Hold(0, ALL_LINES, why))
        return found

    def _hold(self, entry: os.DirEntry[str], known: _Known | None) -> Hold:
        now_s, facts = self._now_s(), entry.stat(follow_symlinks=False)
        identity = facts.st_dev, facts.st_ino, facts.st_size, facts.st_mtime_ns, facts.st_ctime_ns
        if known is None or known.identity != identity:
            known = None
        elif known.settled:
            self._known[entry.name] = known
            return known.hold
        # Changed twice within one step of the file system's clock, it looks as if it had not changed: so it
        # is read until it has not changed for longer, by our clock.
        since_s = now_s if known is None else known.since_s
        hold = _read(self._directory / entry.name)
        self._known[entry.name] = _Known(identity, since_s, now_s - since_s > SETTLED_S, hold)
        return hold


def holds_of(path: Path) -> list[Hold]:
    """Return the holds of a recording that is being written."""
    return HoldFiles(path).read()


def directory_of_holds(path: Path) -> Path:
    """Return the directory of the files of the recording at ``path``."""
    return path / ARMS[0] / "lines" / HOLDS


def _read(file: Path) -> Hold:
    """Raises `PARSE_ERRORS`, or OSError, for a file that is no hold."""
    facts = read_object(file, follow=False)
    held = Hold(int(facts["first_line"]), int(facts["count"]), str(facts["why"]))
    if min(held.first_line, held.count) < 0:  # listed in the root, it would make that invalid
        raise ValueError(f"it is for {counted(held.count, 'line')} from line {held.first_line}")
    return held
