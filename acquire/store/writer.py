"""The writer of a recording. Lines that it has acknowledged can be read, whatever happens to its process.

The order of a commit, each step complete before the next begins::

    chunks → shard indices → (forced to the medium, if so configured) → arrays' zarr.json → groups'
           → root zarr.json with the metadata of everything: the commit record

A reader that starts at the root therefore sees one consistent, slightly older recording; no length ever
covers a line that is not on disk, in both arms. The metadata of arrays and groups, for readers that open one
of them directly, are rewritten only once a second: at ten commits a second they cost more than the lines.
"""

from __future__ import annotations

import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

from acquire.errors import AcquireError, DataError, StoreError, UsageError
from acquire.lines import ARMS
from acquire.store import layout
from acquire.store.arm_writer import ArmWriter
from acquire.store.codecs import EncodeOnce
from acquire.store.files import DISK, SCRATCH, Publisher, check_new_path, lock
from acquire.store.mount import mount_above
from acquire.store.overview import PassingOverview, withdraw_overview, write_overview
from acquire.store.pages import keep_freed_memory
from acquire.store.plugin_codecs import EncodingError
from acquire.store.rebuild import write_copy
from acquire.store.refusals import CURES, refusal
from acquire.store.removal import RESERVE, Unborn, remove
from acquire.store.reserve import EndReserve
from acquire.store.resume import list_segment
from acquire.store.retention import Keeper, release
from acquire.store.room import RoomWatch
from acquire.store.spec import Ending, RunCondition, root_attributes
from acquire.store.table import event_table, gap_table
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from acquire.lines import TaggedBlock
    from acquire.store.files import Disk
    from acquire.store.room import Room
    from acquire.store.spec import RecordingSpec

OWN_INTERVAL_S = 1.0
"""How much older than the root the own metadata of a group or an array may be."""
_DISK_HINT = "check that the directory still exists and the kernel's log for errors of the disk"


class RecordingWriter:
    """Writes one recording; one thread at a time.

    Lines go to disk in whole chunks of ``spec.chunk_lines``. Lines of the last, incomplete chunk are held in
    memory and become readable at `seal` only: ``kill -9`` can lose them, but no line acknowledged by
    `committed_lines`. (With ``fsync="seal"`` a power failure can; with ``"commit"`` it cannot, for a reader
    that starts at the root.) The possible loss is bounded, see `spec.Durability`: the writer commits on its
    own when as many lines wait for a commit as the specification allows.

    A row is committed when both arms have it. Lines of an arm that is ahead are written but not visible; the
    caller limits how far it may be ahead.

    After a disk error the writer takes no more lines; `seal` then ends the recording with the whole chunks
    that are on disk (a little room is reserved for that, should the disk be full), and `close` leaves it as
    of the last commit.
    """

    def __init__(self, path: Path, spec: RecordingSpec, disk: Disk) -> None:
        """Use `create`."""
        self.path = path
        self.spec = spec
        self.mount = mount_above(path)
        self._disk = disk
        self._lock = -1
        threads = 0 if spec.codec == "none" else spec.encoders
        if threads:
            keep_freed_memory()
        self._pool = ThreadPoolExecutor(threads, "encoder") if threads else None
        # One thread for both arms: a disk takes large writes one after the other as fast as two at once.
        self._behind = ThreadPoolExecutor(1, "disk")
        once = {name: EncodeOnce() for name in layout.SAME_IN_BOTH_ARMS}
        self._arms = {arm: ArmWriter(path / arm, spec, disk, self._pool, once) for arm in ARMS}
        self._gaps = gap_table(path)
        self._events = event_table(path)
        self._tables = (self._gaps, self._events)
        # Zarr readers do not list the contents of an array's directory.
        hidden = path / ARMS[0] / "lines"
        self._publisher = Publisher(hidden / SCRATCH, disk)
        self._reserve = EndReserve(disk, hidden / RESERVE)
        self._keeper: Keeper | None = None
        self._watch = RoomWatch(disk, path, spec.reserve_bytes)
        self._looked = self._watch.room
        self._stuck = False
        self._overview: dict[str, PassingOverview] = {arm: PassingOverview(spec.pixels) for arm in ARMS}
        self._no_overview: str | None = None
        self._committed = 0
        self._own_due_s = 0.0
        self._failure: str | None = None
        self._closed = False

    @classmethod
    def create(cls, path: Path, spec: RecordingSpec, disk: Disk = DISK) -> RecordingWriter:
        """Create an empty recording at ``path`` from line ``spec.first_line`` on: `prepare`, then `begin`."""
        writer = cls.prepare(path, spec, disk)
        writer.begin(spec.first_line)
        return writer

    @classmethod
    def prepare(cls, path: Path, spec: RecordingSpec, disk: Disk = DISK) -> RecordingWriter:
        """Do everything that takes time; `begin` then makes ``path`` a recording that takes lines.

        Raises UsageError if ``path`` exists or cannot be created, before anything is changed, and StoreError
        if the disk refuses; then nothing is left behind.
        """
        check_new_path(path)
        # Created here or refused, so that of two recorders with the same path one is refused.
        try:
            disk.make_directory(path)
        except FileExistsError as error:  # somebody was faster
            raise UsageError(f"{path} exists already", hint="another name") from error
        except OSError as error:
            raise refusal(path, error, "created") from error
        writer = None
        try:
            writer = cls(path, spec, disk)
            writer._create_parts()
        except (AcquireError, MemoryError):  # the buffers of the chunks are allocated here
            if writer is not None:
                writer.close()
            remove(disk, path, Unborn(0))
            raise
        return writer

    def begin(self, first_line: int) -> None:
        """Make it a recording whose row 0 is line ``first_line``; takes as long as a commit.

        Raises StoreError if the disk refuses; then nothing is left behind.
        """
        # Chosen only now, since the lines go on while the parts are created.
        self.spec = replace(self.spec, first_line=first_line)
        for arm in self._arms.values():
            arm.begin(first_line)
        if self.spec.retention is not None:
            shard_lines = self.spec.chunk_lines * self.spec.shard_chunks
            self._keeper = Keeper(self.path, self.spec.retention, shard_lines, first_line, self._disk)
        try:
            with self._failing("creating the recording", StoreError):
                self._publish_copy()
                self._publish_root(0, self._publish_parts(0, own=False))  # `prepare` did the slow part
                # After the root: the first recording must not list a segment that does not exist.
                if self.spec.continues is not None and self.spec.continues.listed:
                    list_segment(self.path, self.spec.continues, self._disk)
        except AcquireError:
            self.abandon()
            raise

    def abandon(self) -> None:
        """Give up the preparations, before `begin`: nothing is left behind."""
        self.close()
        remove(self._disk, self.path, Unborn(self._committed))

    def _create_parts(self) -> None:
        with self._failing("creating the recording", StoreError):
            # Before there are parts: with them, and without a root, it looks like one whose root was lost.
            self._lock = lock(self.path, "recording to")
            for arm in self._arms.values():
                arm.create()
            for table in self._tables:
                table.create(self._disk)
            self._publish_parts(0, own=True)
            self._reserve.create()
            if self._durable:
                self._disk.sync_tree(self.path)
                self._disk.sync_directory(self.path.parent)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def next_line(self, arm: str) -> int:
        """Return the line with which the next block of ``arm`` must begin."""
        return self._arms[arm].next_line

    @property
    def committed_lines(self) -> int:
        """Rows that a reader finds in both arms, counted from ``spec.first_line``."""
        return self._committed

    @property
    def bytes_written(self) -> int:
        """Bytes of chunks on disk, as encoded, both arms."""
        return sum(arm.bytes_written for arm in self._arms.values())

    def append(self, block: TaggedBlock, *, lent: bool = False) -> None:
        """Take the next lines of one arm; its arrays may be reused afterwards.

        Arrays that are ``lent`` must not change until `give_back`, which raises an error of the disk: the
        lines may still be on their way there, so that the other arm can be served. Until then ``kill -9``
        loses them as well. Raises DataError if the block does not begin with the next line of its arm, or the
        disk fails.
        """
        self._check_alive()
        with self._failing(f"writing lines of arm {block.arm}"):
            self._arms[block.arm].append(block, self._behind if lent else None)
        # After the arrays, which refuse a block that does not fit.
        self._overview[block.arm].add(block, self.spec.first_line)
        # Of both arms, so that an arm that is ahead does not cause commits without a new row.
        written = min(arm.written_rows for arm in self._arms.values())
        if written - self._committed >= self.spec.commit_lines:
            self.commit()

    @property
    def packs(self) -> bool:
        """Whether lines are packed, in other threads: lent lines need not be copied."""
        return self._pool is not None

    def give_back(self, arm: str) -> None:
        """Wait until the arrays that the arm has lent may be reused. Raises DataError if the disk failed."""
        with self._failing(f"writing lines of arm {arm}"):
            self._arms[arm].pixels.give_back()

    def add_gap(self, arm: str, first_line: int, count: int, cause: str) -> None:
        """List ``count`` lines of ``arm`` as lost because of ``cause``, a short name.

        Visible at the next commit. Their rows are appended like any others, flagged as missing.
        """
        if count < 1 or first_line < 0:
            raise UsageError(
                f"a gap cannot have {count} lines from line {first_line}",
                possible="1 or more, from line 0 or later",
            )
        self._gaps.add({"first_line": first_line, "count": count, "cause": cause, "arm": ARMS.index(arm)})

    def add_event(self, kind: str, tick: int, line: int, text: str = "") -> None:
        """List an event on the trigger's clock; visible at the next commit."""
        if tick < 0 or line < 0:
            raise UsageError(f"event {kind!r} cannot be at tick {tick}, line {line}", possible="0 or more")
        self._events.add({"tick": tick, "line": line, "kind": kind, "text": text})
        if self._keeper is not None:
            self._keeper.note(kind, line)

    def commit(self) -> None:
        """Make every row that both arms have in whole chunks visible, and all gaps and events.

        Cheap if there is nothing new. Raises DataError if the disk fails; `committed_lines` is then
        unchanged.
        """
        self._check_alive()
        with self._failing("committing"):
            for arm in self._arms.values():
                # Rows count once they are on disk, so wait for those on their way.
                arm.settle()
            rows = self._whole_rows()
            room = self._watch.look(self.bytes_written)  # always: others may fill the disk in the meantime
            if rows == self._committed and not any(table.dirty for table in self._tables):
                return
            if self._durable:
                for arm in self._arms.values():
                    arm.sync()
            if own := time.monotonic() >= self._own_due_s:
                self._own_due_s = time.monotonic() + OWN_INTERVAL_S
            nodes = self._publish_parts(rows, own=own)
            # The lines that retention drops are not committed any more; only then are their files deleted.
            # A new object is a new query: a shortage is made up for once, and not again at each commit until
            # the next.
            looked, self._looked = self._looked is not room, room
            going = self._keeper.choose(rows, room.missing_bytes if looked else 0) if self._keeper else []
            if looked:
                self._stuck = room.full and not going
            # Before the root, so that one that is rebuilt from the copy never claims lines that are deleted.
            if going:
                self._publish_copy()
            self._publish_root(rows, nodes)
            # Shards that could not be deleted, or were held in the meantime, are listed again.
            if self._keeper and self._keeper.delete(going):
                self._publish_root(rows, nodes)

    @property
    def room(self) -> Room:
        """The disk's room at the latest commit, and for how long it lasts."""
        return self._watch.room

    @property
    def nearly_full(self) -> str | None:
        """Reason to seal the recording now, while there is room for that, or None.

        With retention the oldest lines are dropped first: there is a reason only when none are left to drop.
        """
        if not self._stuck:
            return None
        return f"disk nearly full: {self.spec.reserve_bytes} bytes are kept free"

    @property
    def beyond_bytes(self) -> int:
        """Bytes by which held lines exceed the limit of retention, as of the latest commit."""
        return self._keeper.beyond_bytes if self._keeper else 0

    @property
    def events_not_listed(self) -> int:
        """Number of events that found no room in their table."""
        return self._events.not_listed

    def seal(self, condition: RunCondition, end_reason: str, ledger: dict[str, Any]) -> None:
        """Write the waiting lines, pad their chunk with 0, end the recording, and force it to the medium.

        The recording ends with the last line that both arms have; further lines are counted in
        ``ledger["store"]``. Raises DataError if the disk fails; a second call then seals what is on disk.
        """
        self._check_open()
        try:
            json.dumps(ledger, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise UsageError(f"the ledger of a recording is not JSON: {error}") from error
        with self._failing("sealing"):
            if self._failure:
                rows = self._rescue()
            else:
                rows = min(arm.next_line for arm in self._arms.values()) - self.spec.first_line
                for arm in self._arms.values():
                    arm.pad()
            self._reserve.release()  # its room is for what follows: the disk may be full
            self._disk.sync_tree(self.path)  # lines before their metadata
            nodes = self._publish_parts(rows, own=True) | self._publish_overview(rows)
            self._disk.sync_tree(self.path)  # metadata before the root
            ending = Ending(condition, end_reason, {**ledger, "store": self._ledger(rows)})
            self._publish_copy(ending)
            self._publish_root(rows, nodes, ending)
            if self._keeper is not None:
                release(self.path, self._disk)
            self._disk.sync_directory(self.path.parent)
        self.close()

    def rescue(self) -> int:
        """Return the rows that `seal` will keep: those of both arms, or, after a disk error, those on disk.

        Raises DataError if the disk fails once more.
        """
        self._check_open()
        if not self._failure:
            return min(arm.next_line for arm in self._arms.values()) - self.spec.first_line
        with self._failing("sealing"):
            return self._rescue()

    def close(self) -> None:
        """Close all files; uncommitted lines are dropped. Idempotent."""
        self._closed = True
        # The threads first: they write to the files that are closed next.
        for threads in (self._pool, self._behind):
            if threads is not None:
                threads.shutdown(cancel_futures=True)
        # From the last callback to the first, even if some fail. The lock last: whoever gets it may recover
        # the recording, which must not be written any more.
        with self._failing("closing files"), ExitStack() as closing:
            if self._lock >= 0:
                closing.callback(os.close, self._lock)
                self._lock = -1
            for arm in self._arms.values():
                closing.callback(arm.close)

    @property
    def _durable(self) -> bool:
        return self.spec.fsync == "commit"

    def _whole_rows(self) -> int:
        return min(arm.whole_rows for arm in self._arms.values())

    def _rescue(self) -> int:
        """Return the rows that are whole on disk, after a failure."""
        for arm in self._arms.values():
            arm.publish_chunks()
        return self._whole_rows()

    def _publish_parts(self, rows: int, *, own: bool) -> dict[str, layout.Document]:
        """Replace all metadata except the root's; return it by path below the recording.

        Without ``own``, the arms' metadata are returned only, and not written.
        """
        nodes: dict[str, layout.Document] = {}
        for arm in self._arms.values():
            nodes |= arm.publish(self._publisher, rows, own=own)
        for table in self._tables:
            table.publish(self._publisher, durable=self._durable)
            nodes |= table.nodes()
        return nodes

    def _publish_overview(self, rows: int) -> dict[str, layout.Document]:
        """Write the overview, if possible: a recording is complete without one."""
        try:
            return write_overview(self._publisher, self.path, self._overview, self.spec, rows)
        except (OSError, MemoryError) as error:
            self._no_overview = str(error) or "no memory"
            withdraw_overview(self._disk, self.path)
            return {}

    def _publish_root(
        self, rows: int, nodes: dict[str, layout.Document], ending: Ending | None = None
    ) -> None:
        """Replace the root, which is the commit itself."""
        root = layout.group_document(self._attributes(ending), nodes)
        durable, text = self._durable or ending is not None, layout.to_json(root)
        self._publisher.replace(self.path / "zarr.json", text, durable=durable)
        if ending is None:
            self._reserve.fit(len(text))
        self._committed = rows  # only now: nothing is acknowledged that a reader would not find

    def _publish_copy(self, ending: Ending | None = None) -> None:
        """Write the copy of the root's attributes, in case the root is lost; always before the root."""
        durable = self._durable or ending is not None
        write_copy(self._publisher, self.path, self._attributes(ending), durable=durable)

    def _attributes(self, ending: Ending | None) -> dict[str, Any]:
        kept = self._keeper.attributes() if self._keeper else {}
        return {**root_attributes(self.spec, ending), **kept}

    def _ledger(self, rows: int) -> dict[str, Any]:
        end = self.spec.first_line + rows
        return {
            "lines": rows,
            "direct_io": any(arm.direct for arm in self._arms.values()),
            "lines_left_out": {name: arm.next_line - end for name, arm in self._arms.items()},
            "bytes_written": self.bytes_written,
            "gaps_not_listed": self._gaps.not_listed,
            "events_not_listed": self._events.not_listed,
            "disk_error": self._failure,
            **({"no_overview": self._no_overview} if self._no_overview else {}),
        }

    def _check_open(self) -> None:
        if self._closed:
            raise UsageError(f"{self.path} is closed for writing")

    def _check_alive(self) -> None:
        self._check_open()
        if self._failure:
            raise DataError(
                f"{self.path} takes no more lines after a disk error ({self._failure})", possible=self._safe()
            )

    def _safe(self) -> str:
        return f"{counted(self._committed, 'line of each arm', 'is')} committed and can be read"

    @contextmanager
    def _failing(self, doing: str, kind: type[AcquireError] = DataError) -> Iterator[None]:
        """Turn an OSError into a ``kind``, and remember it: nothing after it is acknowledged.

        ``kind`` is StoreError as long as there is no line that could be lost.
        """
        try:
            yield
        except OSError as error:
            what = f"{doing}: {error.strerror or error}"
            self._failure = self._failure or what  # the first: others follow from it
            failed, hint = "disk", CURES.get(error.errno or 0, _DISK_HINT)
            if isinstance(error, EncodingError):
                failed, hint = "codec", "another recording.codec: lz4 and zstd are ours"
            raise kind(
                f"{self.path}: the {failed} failed while {what}", possible=self._safe(), hint=hint
            ) from error
