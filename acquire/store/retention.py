"""Endless recordings: the oldest shards are dropped by size, age and when the disk is full, unless held.

::

    ├ dropped ┤├ held ┤├ dropped ┤├────────── kept: max_bytes, max_age_lines ──────────┤├ margin ┤ newest line

A shard is dropped from all arrays of both arms at once. It is first listed in the recording's root and then
deleted, so that the root never claims lines that are gone. Lines are held by an event, by the writer's owner,
or by any process with `hold`: a small file that the writer checks before it deletes. A held range is widened
by a margin on both sides, which reconstruction needs to cut a segment there.
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from zlib import crc32

from acquire.errors import DataError, UsageError
from acquire.store.files import DISK, Publisher
from acquire.store.holds import Hold, HoldFiles, directory_of_holds
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

LONGEST_WHY = 200
"""Longest reason for a hold, in characters: the recording's root lists them all."""


def hold(path: Path, first_line: int, count: int, why: str = "", disk: Disk = DISK) -> Hold:
    """Keep lines of the recording at ``path``, which may be growing in another process, from being deleted.

    Future lines can be held, too. Raises DataError if some of the lines are gone already, and UsageError for
    an impossible range.
    """
    if first_line < 0 or count < 1:
        raise UsageError(f"{count} lines from line {first_line} on cannot be held", possible="1 line or more")
    if len(why) > LONGEST_WHY:
        raise UsageError(
            f"a hold cannot have a reason of {len(why)} characters", possible=f"up to {LONGEST_WHY}"
        )
    recording = open_recording(path)
    if recording.state == "sealed":
        raise UsageError(
            f"{path} is sealed: it drops no lines, so that none need to be held",
            hint="acquire hold is for an endless recording that is still being written",
        )
    if first_line + count <= recording.first_line:
        raise UsageError(
            f"lines {first_line} to {first_line + count - 1} cannot be held: they came before the recording",
            possible=f"lines from {recording.first_line} on",
        )
    held = Hold(first_line, count, why)
    directory = directory_of_holds(path)
    refuse_link(path, directory)
    text = json.dumps({"first_line": first_line, "count": count, "why": why}).encode()
    try:
        _make(directory, disk)
        name = f"{first_line}-{count}.json"  # the same lines, held again, replace their file
        Publisher(directory / f".{name}", disk).replace(directory / name, text, durable=True)
    except OSError as error:
        with suppress(OSError):  # only if it is empty
            disk.remove_directory(directory)
        raise refusal(f"{path}: lines {first_line} to {first_line + count - 1}", error, "held") from error
    # Checked after writing the hold: the writer reads holds before it drops a shard, and again before it
    # deletes the shard.
    for first, gone in open_recording(path).dropped:
        if first < first_line + count and first_line < first + gone:
            last = min(first + gone, first_line + count) - 1
            raise DataError(
                f"{path}: lines {max(first, first_line)} to {last} are gone already",
                possible="the others are held",
            )
    return held


def keep_from(path: Path, line: int, url: str, disk: Disk = DISK) -> None:
    """Hold every line from ``line`` on, including future ones, for a copy to ``url``.

    A later call for the same URL replaces an earlier one.
    """
    text = json.dumps({"first_line": line, "count": ALL_LINES, "why": _NOT_COPIED}).encode()
    refuse_link(path, directory_of_holds(path))
    try:
        _make(directory_of_holds(path), disk)
        # A scratch file of its own, beside that of `hold`: the two are different processes.
        Publisher(directory_of_holds(path) / ".copy", disk).replace(_copy_hold(path, url), text, durable=True)
    except OSError as error:
        raise refusal(f"{path}: lines from {line} on", error, "held") from error


def release(path: Path, disk: Disk = DISK) -> None:
    """Remove all holds of a sealed recording: nothing of it is deleted any more."""
    disk.remove_tree(directory_of_holds(path))


@dataclass(slots=True)
class Keeper:
    """Chooses and deletes the shards to be dropped of one recording that is being written.

    ``shard_rows``: lines per shard; ``first_line``: the line of row 0.
    """

    path: Path
    policy: Retention
    shard_rows: int
    first_line: int
    disk: Disk
    holds: list[Hold] = field(default_factory=list)
    """Holds by events."""
    marked: list[Hold] = field(default_factory=list)
    """Holds by `hold`, as found at the latest commit."""
    gone: list[range] = field(default_factory=list)
    """Dropped shards, as ranges."""
    sizes: dict[int, int] = field(default_factory=dict)
    """Existing whole shard → bytes in all its arrays."""
    beyond_bytes: int = 0
    """Bytes above the policy's limit that remain because lines are held."""
    odd: set[int] = field(default_factory=set)
    """Shards that have become links: they are not deleted, and count as kept."""
    _files: HoldFiles = field(init=False)

    def __post_init__(self) -> None:
        self._files = HoldFiles(self.path)

    def note(self, kind: str, line: int) -> None:
        """Hold the lines around an event at ``line``, if the policy asks for it."""
        if kind in self.policy.hold_events:
            before, after = self.policy.hold_lines
            first, end = max(self.first_line, line - before), line + after + 1
            last = self.holds[-1] if self.holds else None
            # One hold for events in close succession, since all holds are listed in the recording's root.
            if last and last.why == kind and last.first_line <= first <= last.lines.stop:
                self.holds.pop()
                first, end = last.first_line, max(end, last.lines.stop)
            self.holds.append(Hold(first, end - first, kind))

    def choose(self, rows: int, missing_bytes: int = 0) -> list[int]:
        """Return the shards to be dropped now that ``rows`` rows are committed, the oldest first.

        They count as dropped from now on. If the disk is nearly full, at least ``missing_bytes`` are dropped
        whatever the limits.
        """
        # A whole shard does not change any more, so each is measured once.
        known = max([-1, *self.sizes, *(stretch.stop - 1 for stretch in self.gone)])
        for shard in range(known + 1, rows // self.shard_rows):
            self.sizes[shard] = shard_bytes(self.path, shard)
        self.marked = self._marks()
        held = [hold.lines for hold in (*self.holds, *self.marked)]
        newest = self.first_line + rows
        # The size of the shard being written is known at its end only: assume the largest so far.
        partly = max(self.sizes.values(), default=0)
        excess = missing_bytes
        if self.policy.max_bytes is not None:
            excess = max(excess, sum(self.sizes.values()) + partly - self.policy.max_bytes)
        going, kept = [], False
        age = self.policy.max_age_lines
        for shard in sorted(self.sizes):
            # What a segment around the newest line needs is kept, even if the disk is nearly full.
            if self._lines(shard).stop > newest - self.policy.margin_lines:
                break
            if shard in self.odd or self._held(shard, held):
                kept = True
                continue
            if excess > 0 or (age is not None and self._lines(shard).stop <= newest - age):
                going.append(shard)
                excess -= self.sizes.pop(shard)
                self.gone = _with(self.gone, shard)
        most = self.policy.max_bytes
        self.beyond_bytes = max(0, sum(self.sizes.values()) - most) if kept and most is not None else 0
        return going

    def delete(self, shards: list[int]) -> list[int]:
        """Delete the files of shards that the root lists as dropped, except those held in the meantime.

        Return the latter, which count as kept again.
        """
        # Read the holds again: shards may have been held since they were chosen.
        held = [hold.lines for hold in self._marks()]
        saved = []
        for shard in shards:
            if not self._held(shard, held):
                try:
                    remove(self.disk, self.path, Dropped(shard, self.gone))
                    continue
                except DataError:  # its files are links by now, and stay
                    self.odd.add(shard)
            saved.append(shard)
            self.gone = _without(self.gone, shard)
            self.sizes[shard] = shard_bytes(self.path, shard)
        return saved

    def attributes(self) -> dict[str, Any]:
        """Return the attributes ``dropped`` and ``holds`` for the recording's root."""
        stretches = [
            [self.first_line + rows.start * self.shard_rows, len(rows) * self.shard_rows]
            for rows in self.gone
        ]
        holds = [[hold.first_line, hold.count, hold.why] for hold in (*self.holds, *self.marked)]
        return {"dropped": stretches, "holds": holds}

    def _marks(self) -> list[Hold]:
        """Return the holds by `hold`, and one for all lines if a copy is configured and has not begun."""
        marks = self._files.read()
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
    """Return the bytes of a shard in all arrays of both arms."""
    return sum(file.stat().st_size for file in shard_files(path, shard))


def _make(directory: Path, disk: Disk) -> None:
    # Without those above: of a recording that was moved they would be a new one that holds nothing.
    with suppress(FileExistsError):
        disk.make_directory(directory)


def _copy_hold(path: Path, url: str) -> Path:
    """Return the path of the hold for the lines that a copy has not reached yet."""
    # One for each URL: a copy to one place must not free lines that another has not got yet.
    return directory_of_holds(path) / f"0-copy-{crc32(url.encode()):08x}.json"


def _with(stretches: list[range], number: int) -> list[range]:
    """Return the ranges, in order, with one more number."""
    before = [r for r in stretches if r.stop < number]
    after = [r for r in stretches if r.start > number + 1]
    touching = [r for r in stretches if r.stop >= number and r.start <= number + 1]
    start = min([number, *(r.start for r in touching)])
    stop = max([number + 1, *(r.stop for r in touching)])
    return [*before, range(start, stop), *after]


def _without(stretches: list[range], number: int) -> list[range]:
    """Return the ranges, in order, without a number."""
    below = [range(r.start, min(r.stop, number)) for r in stretches]
    above = [range(max(r.start, number + 1), r.stop) for r in stretches]
    return sorted((part for part in (*below, *above) if part), key=lambda r: r.start)
