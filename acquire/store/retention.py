"""Endless recordings: the oldest shards go, by size, age and when the disk gets full, unless they are held.

::

    ├ dropped ┤├ held ┤├ dropped ┤├────────── kept: max_bytes, max_age_lines ──────────┤├ margin ┤ newest line

A shard goes from all arrays of both arms at once. That is first told in the recording's root and then done,
so that nobody meets lines that are said to be there and are not. Lines are held by an event, by the writer's
owner, or by anybody with `hold`, from any process: a small file that the writer looks for before it deletes.
What is held is widened by a margin on both sides, which reconstruction needs to cut a segment there.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from zlib import crc32

from acquire.errors import DataError, UsageError
from acquire.lines import ARMS
from acquire.reading import read_object
from acquire.store.files import DISK, Publisher
from acquire.store.layout import PARSE_ERRORS
from acquire.store.links import refuse_link
from acquire.store.reader import open_recording
from acquire.store.refusals import refusal
from acquire.store.remote import url_below
from acquire.store.removal import Dropped, remove, shard_files
from acquire.store.terms import ALL_LINES

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.store.files import Disk
    from acquire.store.terms import Retention

_NOT_COPIED = "not copied yet"

HOLDS = ".holds"
"""Directory of the files of `hold`, where no Zarr reader lists names."""


@dataclass(frozen=True, slots=True)
class Hold:
    """Lines that must not be deleted, and why."""

    first_line: int
    count: int
    why: str = ""

    @property
    def lines(self) -> range:
        return range(self.first_line, self.first_line + self.count)


def hold(path: Path, first_line: int, count: int, why: str = "", disk: Disk = DISK) -> Hold:
    """Keep lines of the recording at ``path``, which may be growing in another process, from being deleted.

    Lines that are still to come can be held, too. Raises DataError when some of them are gone already, and
    UsageError for a range that cannot be one.
    """
    if first_line < 0 or count < 1:
        raise UsageError(f"{count} lines from line {first_line} on cannot be held", possible="1 line or more")
    recording = open_recording(path)
    if recording.state == "sealed":
        raise UsageError(
            f"{path} is sealed: no line of it need be held", possible="nothing of it is deleted any more"
        )
    if first_line + count <= recording.first_line:
        raise UsageError(
            f"lines {first_line} to {first_line + count - 1} cannot be held: they came before the recording",
            possible=f"{recording.first_line} on",
        )
    held = Hold(first_line, count, why)
    directory = _holds(path)
    refuse_link(path, directory)
    text = json.dumps({"first_line": first_line, "count": count, "why": why}).encode()
    try:
        disk.make_directory(directory, parents=True)
        name = f"{first_line}-{count}.json"
        Publisher(directory / f".{name}", disk).replace(directory / name, text, durable=True)
    except OSError as error:
        raise refusal(f"{path}: lines {first_line} to {first_line + count - 1}", error, "held") from error
    # Only now: the writer looks for holds before it drops a shard, and once more before it deletes it.
    for first, gone in open_recording(path).dropped:
        if first < first_line + count and first_line < first + gone:
            last = min(first + gone, first_line + count) - 1
            raise DataError(
                f"{path}: lines {max(first, first_line)} to {last} are gone already",
                possible="the others are held",
            )
    return held


def keep_from(path: Path, line: int, url: str, disk: Disk = DISK) -> None:
    """Hold every line from ``line`` on, those to come included, for a copy to ``url``; a later call for the
    same place replaces an earlier one.
    """
    text = json.dumps({"first_line": line, "count": ALL_LINES, "why": _NOT_COPIED}).encode()
    refuse_link(path, _holds(path))
    try:
        disk.make_directory(_holds(path), parents=True)
        Publisher(_holds(path) / ".copy", disk).replace(_copy_hold(path, url), text, durable=True)
    except OSError as error:
        raise refusal(f"{path}: lines from {line} on", error, "held") from error


def holds_of(path: Path) -> list[Hold]:
    """What `hold` was asked for, of a recording that is being written.

    A file that cannot be understood may have meant any lines: it holds all of them until it is removed.
    """
    found = []
    for file in sorted(_holds(path).glob("[0-9]*.json")):
        try:
            said = read_object(file, follow=False)
            found.append(Hold(int(said["first_line"]), int(said["count"]), str(said["why"])))
        except FileNotFoundError:
            continue  # replaced by a wider one, or released, meanwhile
        except (*PARSE_ERRORS, OSError) as error:
            found.append(Hold(0, ALL_LINES, f"{file.name} is no hold, remove it: {error}"))
    return found


def release(path: Path, disk: Disk = DISK) -> None:
    """Forget all holds of a recording that is sealed: nothing of it is deleted any more."""
    disk.remove_tree(_holds(path))


@dataclass(slots=True)
class Keeper:
    """What was dropped of one recording that is being written, and what goes next.

    ``shard_rows`` are the lines of a shard; ``first_line`` is that of row 0.
    """

    path: Path
    policy: Retention
    shard_rows: int
    first_line: int
    disk: Disk
    holds: list[Hold] = field(default_factory=list)
    """By events."""
    marked: list[Hold] = field(default_factory=list)
    """By `hold`, as found at the latest commit."""
    gone: list[range] = field(default_factory=list)
    """Shards that were dropped, as stretches."""
    sizes: dict[int, int] = field(default_factory=dict)
    """Whole shards that are there → bytes in all their arrays."""
    odd: set[int] = field(default_factory=set)
    """Shards that a link leads to by now: they are not deleted, and count as kept."""

    def note(self, kind: str, line: int) -> None:
        """An event happened at ``line``."""
        if kind in self.policy.hold_events:
            before, after = self.policy.hold_lines
            first, end = max(self.first_line, line - before), line + after + 1
            last = self.holds[-1] if self.holds else None
            # One hold for events that follow each other closely: all of them are in the recording's root.
            if last and last.why == kind and last.first_line <= first <= last.lines.stop:
                self.holds.pop()
                first, end = last.first_line, max(end, last.lines.stop)
            self.holds.append(Hold(first, end - first, kind))

    def choose(self, rows: int, missing_bytes: int = 0) -> list[int]:
        """Shards to be dropped now that ``rows`` rows are committed, the oldest first; they count as dropped.

        ``missing_bytes`` more than the limits ask for, where the disk is nearly full.
        """
        # A whole shard does not change any more: each is measured once.
        known = max([-1, *self.sizes, *(stretch.stop - 1 for stretch in self.gone)])
        for shard in range(known + 1, rows // self.shard_rows):
            self.sizes[shard] = shard_bytes(self.path, shard)
        self.marked = self._marks()
        held = [hold.lines for hold in (*self.holds, *self.marked)]
        newest = self.first_line + rows
        # Of the shard that is being written, only the end tells the size: it is taken for the largest.
        partly = max(self.sizes.values(), default=0)
        excess = missing_bytes
        if self.policy.max_bytes is not None:
            excess = max(excess, sum(self.sizes.values()) + partly - self.policy.max_bytes)
        going = []
        age = self.policy.max_age_lines
        for shard in sorted(self.sizes):
            if self._lines(shard).stop > newest - self.policy.margin_lines:
                break
            if shard in self.odd or self._held(shard, held):
                continue
            if excess > 0 or (age is not None and self._lines(shard).stop <= newest - age):
                going.append(shard)
                excess -= self.sizes.pop(shard)
                self.gone = _with(self.gone, shard)
        return going

    def delete(self, shards: list[int]) -> list[int]:
        """Delete the files of shards that the root calls dropped; those that somebody holds meanwhile stay.

        Returns the latter: they count as kept again.
        """
        # Asked once more: somebody may have held them since they were chosen.
        held = [hold.lines for hold in self._marks()]
        saved = [shard for shard in shards if self._held(shard, held) or not self._delete(shard)]
        for shard in saved:
            self.gone = _without(self.gone, shard)
            self.sizes[shard] = shard_bytes(self.path, shard)
        return saved

    def _delete(self, shard: int) -> bool:
        """Says whether it was; what is not the recording's own any more stays."""
        try:
            remove(self.disk, self.path, Dropped(shard, self.gone))
        except DataError:
            self.odd.add(shard)
            return False
        return True

    def attributes(self) -> dict[str, Any]:
        """For the recording's root."""
        stretches = [
            [self.first_line + rows.start * self.shard_rows, len(rows) * self.shard_rows]
            for rows in self.gone
        ]
        holds = [[hold.first_line, hold.count, hold.why] for hold in (*self.holds, *self.marked)]
        return {"dropped": stretches, "holds": holds}

    def _marks(self) -> list[Hold]:
        """By `hold`, and by a copy that is to come and has not begun."""
        marks = holds_of(self.path)
        target = self.policy.copied_to
        if target is not None and not _copy_hold(self.path, url_below(target, self.path)).exists():
            marks.append(Hold(self.first_line, ALL_LINES, _NOT_COPIED))
        return marks

    def _lines(self, shard: int) -> range:
        start = self.first_line + shard * self.shard_rows
        return range(start, start + self.shard_rows)

    def _held(self, shard: int, held: list[range]) -> bool:
        lines, margin = self._lines(shard), self.policy.margin_lines
        return any(h.start - margin < lines.stop and lines.start < h.stop + margin for h in held)


def shard_bytes(path: Path, shard: int) -> int:
    """Bytes of a shard in all arrays of both arms."""
    return sum(file.stat().st_size for file in shard_files(path, shard))


def _holds(path: Path) -> Path:
    return path / ARMS[0] / "lines" / HOLDS


def _copy_hold(path: Path, url: str) -> Path:
    """The file that says how far a copy has come."""
    return _holds(path) / f"0-copy-{crc32(url.encode()):08x}.json"


def _with(stretches: list[range], number: int) -> list[range]:
    """Stretches in order, with one more number."""
    before = [r for r in stretches if r.stop < number]
    after = [r for r in stretches if r.start > number + 1]
    touching = [r for r in stretches if r.stop >= number and r.start <= number + 1]
    start = min([number, *(r.start for r in touching)])
    stop = max([number + 1, *(r.stop for r in touching)])
    return [*before, range(start, stop), *after]


def _without(stretches: list[range], number: int) -> list[range]:
    """Stretches in order, without a number."""
    below = [range(r.start, min(r.stop, number)) for r in stretches]
    above = [range(max(r.start, number + 1), r.stop) for r in stretches]
    return sorted((part for part in (*below, *above) if part), key=lambda r: r.start)
