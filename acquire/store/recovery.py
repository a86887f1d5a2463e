"""Recovery of a recording whose writer did not end it: everything on disk is kept, and the end is sealed.

::

    mend indices ─▶ scan every chunk ─▶ flag lost rows ─▶ tables ─▶ lengths ─▶ root: sealed, INTERRUPTED

No committed line is cut off: lines of which a part is not on disk stay, flagged as missing and listed in
gaps. Whole chunks that were written after the last commit are added; pixels without tags are no lines, and
stay where they are, after the last line. Gaps of a table that cannot be read are listed anew from the flags,
without their causes; events of which a column cannot be read lose what was in it. A second run finds nothing
to do; an interrupted one is simply repeated, since the root is written last.

If the machine has kept running, committed lines are certainly on disk: then only the chunks after the last
commit are checked, which takes a moment however long the recording is.
"""

from __future__ import annotations

import contextlib
import copy
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from acquire.errors import AcquireError, StateError
from acquire.lines import ARMS, LineFlag
from acquire.reading import path_of
from acquire.store import layout
from acquire.store.array_files import COLUMNS
from acquire.store.chunks import AbsentChunkError, DamagedChunkError
from acquire.store.files import DISK, SCRATCH, Publisher, locked
from acquire.store.links import refuse_links
from acquire.store.mend import mend_index, rewrite_chunk
from acquire.store.reader import open_recording
from acquire.store.rebuild import rebuild_root, root_is_lost, write_copy
from acquire.store.refusals import refused
from acquire.store.removal import RESERVE, Dropped, remove, shard_numbers, shards_on_disk
from acquire.store.resume import list_segments
from acquire.store.retention import release
from acquire.store.scan import (
    ArmScan,
    chunks_of,
    covered,
    grown_rows,
    missing_rows,
    runs,
    scan,
    tag_rows,
)
from acquire.store.shortfall import Damage
from acquire.store.spec import RunCondition
from acquire.store.table import event_table, gap_table
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from acquire.store.files import Disk
    from acquire.store.reader import Recording

REASON = "recovered: its writer ended without sealing it"


@dataclass(frozen=True, slots=True)
class Circumstances:
    """What is known about the writer's end.

    Attributes
    ----------
    reason : why the recording ended
    committed_intact : the machine has kept running, and committed lines are certainly intact
    alone : nobody else can be writing it, even if the file system has no locks to prove it
    notes : line, kind and text of events that were sent to the writer, which may not have listed them
    """

    reason: str = REASON
    committed_intact: bool = False
    alone: bool = True
    notes: tuple[tuple[int, str, str], ...] = ()


UNKNOWN = Circumstances()
"""An operator says that the recording is over; all of it is checked."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """Result of a recovery.

    Attributes
    ----------
    changed : whether anything was changed
    lines, lines_before : rows of each arm that a reader finds, after and before
    indices_mended : number of files whose index was torn, or lacked chunks
    damage : lost lines, of which array and why
    root_rebuilt : the root's zarr.json was lost, and rebuilt from the metadata of the parts below it
    tables_lost : table, ``gaps`` or ``events``, that could not be read → what of it is lost
    not_listed : why the segments of the run could not be listed in its first recording; "" if they could
    """

    path: str
    changed: bool
    lines: int
    lines_before: int
    indices_mended: int
    damage: tuple[Damage, ...]
    root_rebuilt: bool = False
    not_listed: str = ""
    tables_lost: dict[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def recover(
    path: Path | str,
    disk: Disk = DISK,
    progress: Callable[[int, int], None] | None = None,
    known: Circumstances = UNKNOWN,
) -> Recovery:
    """Recover the recording at ``path``, and list the segments of its run; idempotent.

    ``progress`` gets the chunks checked and their total; it may raise to end the recovery, which can be
    repeated at any time. Raises PlaceError if there is no recording, DataError if it holds links, StoreError
    if the disk refuses, StateError while it is being written.
    """
    path = path_of(path)
    refuse_links(path)
    if not root_is_lost(path):
        open_recording(path)  # refuse anything but a recording before it is locked
    with refused(path, "recovered"), locked(path, "recovering", surely=not known.alone):
        if lost := root_is_lost(path):
            rebuild_root(path, disk)
        recording = open_recording(path)  # once more, now that nobody writes it
        done = _Recoverer(recording, path, disk, known, rebuilt=lost).run(progress)
    not_listed = ""
    # Without the lock: `list_segments` takes that of the run's first recording, which this may be.
    try:
        with contextlib.suppress(StateError):  # another recovery has the first recording, and lists them
            list_segments(path, disk)
    except (AcquireError, OSError) as error:
        not_listed = str(error)
    return replace(done, changed=done.changed or lost, root_rebuilt=lost, not_listed=not_listed)


class FoundGap(NamedTuple):
    """Lost lines of an arm that no table lists yet."""

    first_line: int
    lines: int
    cause: str

    @property
    def end_line(self) -> int:
        return self.first_line + self.lines


class _Recoverer:
    """One recovery, with the recording locked."""

    def __init__(
        self, recording: Recording, path: Path, disk: Disk, known: Circumstances, *, rebuilt: bool
    ) -> None:
        self.recording = recording
        self.path = path
        self.disk = disk
        self.reason = known.reason
        self.notes = known.notes
        self.sealed = recording.state == "sealed"
        self.rows = recording.lines
        self.flags_changed = 0
        self.shape = recording.arms[ARMS[0]].reader("lines").shape
        self.tag_rows = tag_rows(recording)
        self.events = () if "events" in recording.unreadable else recording.events
        self.gaps = () if "gaps" in recording.unreadable else recording.gaps
        # What an unsealed one has lost already is from a rebuilding of its root, whose recovery may have been
        # interrupted.
        noted = recording.tables_lost if rebuilt or not self.sealed else {}
        self.tables_lost = {**noted, **recording.unreadable}
        self.gaps_lost = "gaps" in self.tables_lost
        # Gaps that cannot be read are listed from the flags of all rows.
        trusted = known.committed_intact and not self.sealed and not self.gaps_lost
        self.first_row = recording.lines // self.tag_rows * self.tag_rows if trusted else 0
        """Rows before this one are known to be intact."""
        kept = [range(max(rows.start, self.first_row), rows.stop) for rows in recording.kept_rows()]
        self.kept = [rows for rows in kept if rows]

    def run(self, progress: Callable[[int, int], None] | None) -> Recovery:
        recording = self.recording
        if not self.sealed:  # its room is for what follows: the disk may be full
            self.disk.remove(self.path / ARMS[0] / "lines" / RESERVE)
        # Indices first, since chunks are found by them. Then committed rows, and only then the rows after
        # them, which count only if every array of both arms has them.
        mended, first_shard = 0, self.first_row // self.shape.shard_rows
        for arm, name in product(ARMS, COLUMNS):
            reader = recording.arms[arm].reader(name)
            mended += sum(
                mend_index(self.disk, self.path, reader, shard, grow=not self.sealed)
                for shard in shard_numbers(self.path / reader.key)
                if shard >= first_shard
            )
        scans = scan(recording, self.kept, progress)
        if not self.sealed:
            # Chunk after chunk of the tag arrays: the first one that is not whole, in any array of either
            # arm, is where the writer was.
            grown = self.tag_rows
            while self.rows % self.tag_rows == 0 and grown:
                beyond = range(self.rows, self.rows + self.tag_rows)
                grown = min(grown_rows(found, beyond) for found in scan(recording, [beyond]).values())
                self.rows += grown
        damage = tuple(found for arm in scans.values() for found in arm.damages(recording.lines))
        new_gaps = {arm: self._flag(found) for arm, found in scans.items()}
        if self.tables_lost:
            self._salvage_tables(new_gaps)
        repaired = mended or self.flags_changed or any(new_gaps.values()) or self.tables_lost
        changed = bool(not self.sealed or repaired)
        if changed:
            self._publish(new_gaps)
        lines = open_recording(self.path).lines
        return Recovery(
            path=str(self.path),
            changed=changed,
            lines=lines,
            lines_before=recording.lines,
            indices_mended=mended,
            damage=damage,
            tables_lost=self.tables_lost,
        )

    def _salvage_tables(self, new_gaps: dict[str, list[FoundGap]]) -> None:
        """Take from the tables that cannot be read what is whole, and note what is lost."""
        if "events" in self.recording.unreadable:
            self.events, wrong = self.recording.salvaged_events()
            count = len(self.events)
            kept = f"{counted(count, 'event', 'was')} kept without it" if count else "no event was kept"
            self.tables_lost["events"] = f"{'; '.join(wrong)}; {kept}"
        if self.gaps_lost:
            count = sum(map(len, new_gaps.values()))
            lost = f"; {counted(count, 'gap', 'was')} listed from the flags, without the cause"
            if self.recording.dropped:
                lost += ", and so are the gaps among the lines that retention had dropped"
            self.tables_lost["gaps"] += lost

    def _flag(self, found: ArmScan) -> list[FoundGap]:
        """Flag the lost rows of one arm; return the gaps to be listed."""
        size, reader = self.tag_rows, found.stream.reader("flags")
        listed: list[range] = []
        if not self.gaps_lost:
            lost_rows = self.recording.lost_rows(found.stream.arm, self.rows)
            listed = sorted(lost_rows, key=lambda rows: rows.start)
        gaps: dict[str, list[FoundGap]] = {"damaged": [], "unlisted": []}
        for chunk in chunks_of(size, [*self.kept, range(self.recording.lines, self.rows)]):
            here = range(chunk * size, min(self.rows, (chunk + 1) * size))
            lost = found.lost(range(here.start, here.start + size))  # a whole chunk, as it is rewritten
            damaged = chunk in found.troubles["flags"]
            flags = np.zeros(size, reader.shape.dtype) if damaged else reader.chunk(chunk).copy()
            if damaged or (lost & ~missing_rows(flags)).any():
                flags[lost] |= np.uint16(LineFlag.MISSING)
                rewrite_chunk(self.disk, self.path, reader, chunk, flags)
                self.flags_changed += 1
            missing, lost = missing_rows(flags)[: len(here)] & ~covered(listed, here), lost[: len(here)]
            for cause, rows in (("damaged", missing & lost), ("unlisted", missing & ~lost)):
                known = gaps[cause]
                for first, count in runs(rows, self.recording.first_line + here.start):
                    # A gap that reaches the end of a chunk continues in the next one.
                    joins = bool(known) and known[-1].end_line == first
                    begin = known.pop().first_line if joins else first
                    known.append(FoundGap(begin, first + count - begin, cause))
        return sorted(gap for of_cause in gaps.values() for gap in of_cause)

    def _publish(self, new_gaps: dict[str, list[FoundGap]]) -> None:
        hidden = self.path / ARMS[0] / "lines"
        publisher = Publisher(hidden / SCRATCH, self.disk)
        document = copy.deepcopy(self.recording.document)
        nodes: dict[str, layout.Document] = document["consolidated_metadata"]["metadata"]
        # Directories that are gone, as of a whole arm, are made anew for the metadata that is written below.
        for place in (*nodes, f"{ARMS[0]}/lines"):
            if not (self.path / place).is_dir():
                self.disk.make_directory(self.path / place, parents=True)
        nodes |= self._tables(publisher, new_gaps)
        # Also into the arms' own metadata, for readers that begin below the root.
        for arm in ARMS:
            arrays = {name: nodes[f"{arm}/{name}"] for name in COLUMNS}
            for name, array in arrays.items():
                array["shape"] = [self.rows, *array["shape"][1:]]
                publisher.replace(self.path / arm / name / "zarr.json", layout.to_json(array))
            group = layout.group_document(nodes[arm]["attributes"], arrays)
            publisher.replace(self.path / arm / "zarr.json", layout.to_json(group))
        document["attributes"] = self._attributes(new_gaps)
        self.disk.sync_tree(self.path)  # everything that the root is going to describe
        write_copy(publisher, self.path, document["attributes"], durable=True)
        publisher.replace(self.path / "zarr.json", layout.to_json(document), durable=True)
        for leftover in (SCRATCH, RESERVE):
            self.disk.remove(hidden / leftover)
        release(self.path, self.disk)
        # Shards that the root lists as dropped, and that retention may have had no time to delete.
        size = self.shape.shard_rows
        listed = [range(-(-rows.start // size), rows.stop // size) for rows in self.recording.dropped_rows()]
        for shard in shards_on_disk(self.path):
            if any(shard in shards for shards in listed):
                remove(self.disk, self.path, Dropped(shard, listed))
        self.disk.sync_directory(self.path.parent)

    def _tables(
        self, publisher: Publisher, new_gaps: dict[str, list[FoundGap]]
    ) -> dict[str, layout.Document]:
        """Write gaps and events as they were, with the new ones; return their metadata."""
        recording = self.recording
        gaps, events = gap_table(self.path), event_table(self.path)
        end = recording.first_line + self.rows
        known = [(gap.arm, gap.first_line, gap.count, gap.cause) for gap in self.gaps]
        found = [(arm, *gap) for arm, gaps_found in new_gaps.items() for gap in gaps_found]
        for arm, first, count, cause in [*known, *found]:
            # A gap is listed as a whole: the lines at its end may never have reached the disk.
            kept = min(count, end - first)
            if kept > 0:
                gaps.add({"first_line": first, "count": kept, "cause": cause, "arm": ARMS.index(arm)})
        if not self.gaps_lost:
            gaps.not_listed += recording.gaps_not_listed
        elif recording.dropped:
            gaps.not_listed += 1  # those among dropped lines, however many: the list is not complete
        events.not_listed += recording.events_not_listed
        for event in self.events:
            events.add({"tick": event.tick, "line": event.line, "kind": event.kind, "text": event.text})
        # A writer that dies between a line's commit and that of its event leaves a line without its mark.
        listed = {(event.line, event.kind, event.text) for event in self.events}
        for line, kind, note in self.notes:
            if recording.first_line <= line < end and (line, kind, note) not in listed:
                events.add({"tick": self._tick(line), "line": line, "kind": kind, "text": note})
                listed.add((line, kind, note))
        texts = [f"{counted(self.rows, 'line')}, of which {recording.lines} committed"]
        for text in (*texts, *self.tables_lost.values()):
            events.add({"tick": 0, "line": end, "kind": "recovered", "text": text})
        for table in (gaps, events):
            table.publish(publisher, durable=True)
        return gaps.nodes() | events.nodes()

    def _tick(self, line: int) -> int:
        """Return the trigger's tick at a line; 0 if it cannot be read."""
        chunk, row = divmod(line - self.recording.first_line, self.tag_rows)
        for arm in ARMS:
            with contextlib.suppress(AbsentChunkError, DamagedChunkError, OSError):
                return int(self.recording.arms[arm].reader("tick").chunk(chunk)[row])
        return 0

    def _attributes(self, new_gaps: dict[str, list[FoundGap]]) -> dict[str, Any]:
        attributes = dict(self.recording.attrs)
        if self.tables_lost:
            attributes["tables_lost"] = {**self.recording.tables_lost, **self.tables_lost}
        lost = {arm: sum(gap.lines for gap in found) for arm, found in new_gaps.items()}
        if self.sealed:
            attributes["ledger"] = ledger = copy.deepcopy(attributes["ledger"])
            for arm, book in ledger.items():
                if lost.get(arm) and isinstance(book, dict) and book.get("stored") is not None:
                    missing = book.setdefault("missing", {})
                    if self.gaps_lost:
                        # The gaps listed anew include the lines that were missing before. Without those that
                        # retention dropped, the difference says nothing.
                        before = sum(missing.values())
                        lost[arm] = 0 if self.recording.dropped else max(0, lost[arm] - before)
                    book["stored"] -= lost[arm]
                    if lost[arm]:
                        missing["damaged"] = missing.get("damaged", 0) + lost[arm]
            if any(lost.values()) and attributes["run_condition"] in (
                RunCondition.GOOD,
                RunCondition.TAINTED,
            ):
                attributes["run_condition"] = str(RunCondition.INCOMPLETE)
            return attributes
        arms = {arm: self._book(arm, new_gaps[arm]) for arm in ARMS}
        store = {"lines": self.rows, "lines_committed": self.recording.lines}
        return {
            **attributes,
            "state": "sealed",
            "run_condition": str(RunCondition.INTERRUPTED),
            "end_reason": self.reason,
            "ledger": {"pulses": self.rows, **arms, "store": store},
        }

    def _book(self, arm: str, new_gaps: list[FoundGap]) -> dict[str, Any]:
        """Return an arm's ledger, lines = stored + missing by cause, from the listed gaps."""
        missing: dict[str, int] = {}
        end = self.recording.first_line + self.rows
        listed = [(g.first_line, g.count, g.cause) for g in self.gaps if g.arm == arm]
        for first, count, cause in [*listed, *new_gaps]:
            kept = min(count, end - first)
            if kept > 0:
                missing[cause] = missing.get(cause, 0) + kept
        # No other count is left to compare with: the recorder's own has died with it.
        stored = self.rows - sum(missing.values())
        return {"stored": stored, "missing": missing, "balanced": True}
