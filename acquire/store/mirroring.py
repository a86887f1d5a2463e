"""Copies a recording to a remote store while it grows; the local disk is the spool.

::

    writer ─▶ run.zarr (local) ─▶ whole shards ─▶ tables ─▶ metadata of arrays ─▶ root ─▶ s3://…/run.zarr

The order is the writer's: the root comes last, and describes only files that are there already. An
interrupted copy continues where it stopped. Lines that are not copied yet are held, so that retention can
bound the spool without losing lines: if the store is too slow, the recording ends in good order when the disk
is full. One process at a time copies a recording.
"""

from __future__ import annotations

import copy
import os
import time
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from acquire.errors import DataError, StateError, UsageError
from acquire.lines import ARMS
from acquire.reading import parse_object, path_of, read_regular
from acquire.store import overview
from acquire.store.array_files import COLUMNS
from acquire.store.attributes import segment_of
from acquire.store.files import DISK, SCRATCH, locked
from acquire.store.layout import PARSE_ERRORS, group_document, to_json
from acquire.store.links import refuse_link, refuse_links
from acquire.store.listing import ROOT
from acquire.store.reader import open_recording
from acquire.store.refusals import refusal
from acquire.store.remote import RemoteSource
from acquire.store.removal import shard_files
from acquire.store.retention import keep_from, release
from acquire.store.shortfall import first_shortfall
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from acquire.store.files import Disk
    from acquire.store.layout import Document
    from acquire.store.reader import Recording

LOOK_S = 0.5
"""How often a growing recording is checked."""
MARK = "a/lines/.copy-of"
"""File at the target that identifies the recording until there is a root."""
_OURS = (*ARMS, "gaps", "events", overview.NAME, ROOT, SCRATCH)
"""First parts of a recording's keys."""
_ELSEWHERE = "another name there: acquire upload RECORDING URL"
AGAIN = "then repeat the command, which continues with what is there already"


@dataclass(frozen=True, slots=True)
class Mirrored:
    """Progress of a copy.

    Attributes
    ----------
    lines, waiting_lines : lines at the target; lines that a reader finds here, but not there yet
    shards, bytes : copied since the copy was begun or continued
    sealed : the copy is complete and sealed
    """

    url: str
    lines: int
    shards: int
    bytes: int
    sealed: bool
    waiting_lines: int = 0

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def mirror(
    path: Path | str,
    url: str,
    *,
    follow: bool = False,
    idle_s: float = 60.0,
    report: Callable[[Mirrored], None] = lambda _: None,
    progress: Callable[[int, int], object] = lambda _done, _total: None,
) -> Mirrored:
    """Copy the recording at ``path`` to ``url``; with ``follow`` until it is sealed.

    Raises UsageError if ``url`` holds something else, StateError while another process copies it,
    StoreError and PlaceError if the store fails or refuses, and DataError if a recording that is followed
    has not grown for ``idle_s``: its writer is gone.
    """
    path = path_of(path)
    refuse_link(path, path)
    open_recording(path)  # raises if it is not a recording
    with only_copy(path):
        copying = _Steps(Mirror(path, url), progress)
        done = copying.step()
        moved = time.monotonic()
        while follow and not done.sealed:
            time.sleep(LOOK_S)
            before, done = done, copying.step()
            if done != before:
                moved = time.monotonic()
            if done.bytes != before.bytes:
                report(done)
            # Its writer may be gone; one that lives commits ten times a second.
            if time.monotonic() - moved > idle_s:
                raise DataError(
                    f"{path} has not grown for {idle_s:g} s and is not sealed",
                    possible=f"{counted(done.lines, 'line', 'is')} in {copying.target}",
                    hint=f"acquire recover {path}, then copy again",
                )
        return done


class _Steps:
    """A copy, shard by shard; after each, ``progress`` gets the lines copied, and their total."""

    def __init__(self, copying: Mirror, progress: Callable[[int, int], object]) -> None:
        self._copying, self._progress = copying, progress
        self.target = copying.target

    def step(self) -> Mirrored:
        """Copy everything new; see `Mirror.step`."""
        done = self._copying.step(most_shards=1)
        # One file of lines at a time: after each, the root there names it, and the hold here moves on.
        before = -1
        while not done.sealed and done.shards != before:
            self._progress(done.lines, done.lines + done.waiting_lines)
            before, done = done.shards, self._copying.step(most_shards=1)
        return done


@contextmanager
def only_copy(path: Path) -> Iterator[None]:
    """Keep other processes from copying the recording at ``path``. Raises StateError while one does."""
    with ExitStack() as held:
        try:
            # Lock an arm's directory: the lock of the recording's directory belongs to the writer.
            held.enter_context(locked(path / ARMS[0], "copying"))
        except StateError as error:
            raise StateError(f"{path} is being copied by another process", hint="acquire status") from error
        except OSError as error:
            raise refusal(path, error, "copied") from error
        yield


def _identity(attributes: dict[str, Any]) -> tuple[str, int]:
    """Return the run's ID, and the number of the segment."""
    segment = segment_of(attributes)
    number = attributes.get("segment_number", 1) if segment is None else segment[1]
    return str(attributes.get("run_id")), number


def _identity_in(data: bytes) -> tuple[str, int] | None:
    """Return the `_identity` of the recording with this root; None if it cannot be read."""
    try:
        attributes = parse_object(data)["attributes"]
    except PARSE_ERRORS:
        return None
    return _identity(attributes) if isinstance(attributes, dict) else None


class Mirror:
    """One copy; `step` brings it up to date.

    ``pause`` is called before anything is written, with its size in bytes; it may raise to end the copy, to
    be continued later.
    """

    def __init__(
        self, path: Path, url: str, disk: Disk = DISK, pause: Callable[[int], None] = lambda _: None
    ) -> None:
        self.path = path
        self.target = RemoteSource(url)
        self._disk = disk
        self._pause = pause
        refuse_links(path)
        self._identity = _identity(open_recording(path).attrs)
        if (there := self.target.path) is not None and os.path.lexists(there):
            # It would replace the files that are being written by copies of themselves.
            if there.exists() and there.samefile(path):
                raise UsageError(
                    f"{url} is the recording itself, not a place for its copy", hint="another URL"
                )
            # Through a link there, the copy would overwrite something else.
            refuse_links(there)
        self._bytes = 0
        self._shards = 0
        self._directories: set[str] = set()
        self._sent: dict[str, bytes] = {}
        """Key of metadata and tables → bytes at the target."""
        self._root = b""
        self._sealed = False
        self._next = 0
        """The first shard that may not be at the target yet."""
        self._kept_from = -1
        try:
            self._there = self.target.sizes()
            self._check_target()
        except OSError as error:
            raise refusal(url, error, "used", AGAIN) from error

    @property
    def grows(self) -> bool:
        """Whether the recording was not sealed yet at the latest step."""
        return not self._sealed

    def step(self, most_shards: int | None = None) -> Mirrored:
        """Copy new whole shards, at most ``most_shards`` of them, and update the copy's root.

        The root of a sealed recording is copied once all shards are. Raises StoreError if the store fails and
        PlaceError if it refuses; a later step continues.
        """
        recording = open_recording(self.path)
        if _identity(recording.attrs) != self._identity:
            raise DataError(
                f"{self.path} is no longer the same recording: run {recording.attrs['run_id']}",
                hint="acquire upload again, to another place",
            )
        sealed = recording.state == "sealed"
        if sealed and not self._sealed:  # a recovery may have mended files that are copied already
            refuse_links(self.path)
            self._refuse_shortfall(recording, None)
            self._sealed, self._next = True, 0
        # Until the recording is sealed, its last file still changes.
        rows = recording.arms[ARMS[0]].reader("lines").shape.shard_rows
        end = -(-recording.lines // rows) if sealed else recording.lines // rows
        try:
            self._copy_shards(recording, end, most_shards)
            lines = min(self._next * rows, recording.lines)
            whole = sealed and self._next == end
            if whole or not sealed:
                self._publish(recording, lines)
        except OSError as error:
            # Reading here or writing there may have failed: the error's file name tells which.
            here = error.filename is not None and str(error.filename).startswith(str(self.path))
            what = (self.path, error, "read") if here else (self.target, error, "written", AGAIN)
            raise refusal(*what) from error
        # Lines are held until the copy's root names them; nothing of a sealed recording is deleted any more.
        line = None if sealed else recording.first_line + lines
        if line is None:
            release(self.path, self._disk)
        elif line != self._kept_from:
            keep_from(self.path, line, self.target.url, self._disk)
            self._kept_from = line
        waiting = recording.lines - lines
        return Mirrored(
            url=str(self.target),
            lines=lines,
            shards=self._shards,
            bytes=self._bytes,
            sealed=whole,
            waiting_lines=waiting,
        )

    def _copy_shards(self, recording: Recording, end: int, most: int | None) -> None:
        before = self._shards
        size = recording.arms[ARMS[0]].reader("lines").shape.shard_rows
        if self._next < end and not self._root and MARK not in self._there:
            # Identify the copy until there is a root.
            run_id, number = self._identity
            facts = {"run_id": run_id} | ({"segment_number": number} if number > 1 else {})
            self._put(MARK, to_json({"attributes": facts}))
            self._there[MARK] = 0  # only that it is there matters, not its size
        while self._next < end and (most is None or self._shards - before < most):
            # Skip shards that retention has dropped in one go: an endless recording has very many.
            dropped = (rows for rows in recording.dropped_rows() if self._next * size in rows)
            if (kept := max((rows.stop // size for rows in dropped), default=self._next)) != self._next:
                self._next = kept
                continue
            if not self._sealed:
                self._refuse_shortfall(recording, range(self._next, self._next + 1))
            # A file of the right size is the same one: a whole shard is never written again.
            copied = False
            for file in shard_files(self.path, self._next):
                key = file.relative_to(self.path).as_posix()
                length = file.stat().st_size
                if self._there.get(key) != length:
                    self._make_way(key, length)
                    self.target.put_file(key, file)
                    self._there[key] = length
                    self._bytes += length
                    copied = True
            self._shards += copied
            self._next += 1

    def _refuse_shortfall(self, recording: Recording, shards: range | None) -> None:
        """Raise DataError if lines claimed here are not on disk, since the copy must not claim them."""
        if (found := first_shortfall(recording, shards)) is not None:
            raise DataError(
                f"{self.path} is not copied: {found}",
                possible="a recording whose lines are all on disk or flagged as missing",
                hint=f"acquire verify {self.path}; acquire recover flags what is lost, then copy again",
            )

    def _check_target(self) -> None:
        """Raise UsageError unless the target is empty or has a copy of this recording, maybe unpublished."""
        foreign = [key for key in self._there if key.split("/")[0] not in _OURS]
        root = self.target.read(ROOT) if ROOT in self._there else b""
        found = _identity_in(root)
        # A root that cannot be read, beside parts of a recording, was torn by a kill on a store that writes
        # in place: the copy is not published yet. Alone, it is somebody else's file.
        if found is None and (foreign or (root and len(self._there) == 1)):
            what = "something damaged" if root else "something other than a recording"
            raise UsageError(f"{self.target} holds {what}", hint=_ELSEWHERE)
        if found is not None:
            self._root = root
        elif MARK in self._there:
            found = _identity_in(self.target.read(MARK))
        if found is not None and found != self._identity:
            raise UsageError(
                f"{self.target} holds another recording: run {found[0]}, segment {found[1]}", hint=_ELSEWHERE
            )
        if found is None:  # files of an unknown recording are not relied on, but replaced
            self._there = {}

    def _publish(self, recording: Recording, lines: int) -> None:
        """Write tables and metadata of the copied lines, unless the root would stay the same."""
        document = copy.deepcopy(recording.document)
        nodes: dict[str, Document] = document["consolidated_metadata"]["metadata"]
        for arm in ARMS:
            for name in COLUMNS:
                nodes[f"{arm}/{name}"]["shape"][0] = lines
        # Nothing is deleted from a copy, so that it needs no holds.
        document["attributes"] |= {"dropped": self._dropped(recording, lines), "holds": []}
        root = to_json(document)
        if root == self._root:
            return
        for table in ("gaps", "events"):
            for file in sorted((self.path / table).glob("*/c/0")):
                self._put(file.relative_to(self.path).as_posix(), file.read_bytes())
        if overview.NAME in nodes:
            for key in overview.CHUNKS:
                self._put(key, read_regular(self.path / key, follow=False))
        for key, node in nodes.items():
            inner = {name.partition("/")[2]: n for name, n in nodes.items() if name.startswith(f"{key}/")}
            own = group_document(node["attributes"], inner) if node["node_type"] == "group" else node
            self._put(f"{key}/zarr.json", to_json(own))
        self._put("zarr.json", root)  # last, since readers begin with it
        self._root = root  # only now: after a failure, the next step has to publish once more

    def _dropped(self, recording: Recording, lines: int) -> list[list[int]]:
        """Return the ranges of lines that retention deleted here before they could be copied."""
        size = recording.arms[ARMS[0]].reader("lines").shape.shard_rows
        start = "a/tick/c/"
        names = (key[len(start) :] for key in self._there if key.startswith(start))
        there = sorted(int(name) for name in names if name.isascii() and name.isdecimal())
        found = []
        for rows in recording.dropped_rows():
            at, end = rows.start // size, min(rows.stop, lines) // size
            # Dropped here, but already there: these are not missing from the copy.
            for shard in [*(shard for shard in there if at <= shard < end), end]:
                if at < shard:
                    found.append([recording.first_line + at * size, (shard - at) * size])
                at = shard + 1
        return found

    def _put(self, key: str, data: bytes) -> None:
        # Most of these files are the same from one step to the next, and each takes a store some time.
        if self._sent.get(key) == data:
            return
        self._make_way(key, len(data))
        self.target.put(key, data)
        self._sent[key] = data
        self._bytes += len(data)

    def _make_way(self, key: str, size: int) -> None:
        self._pause(size)
        directory = key.rpartition("/")[0]
        if self.target.has_directories and directory not in self._directories:
            self.target.make_directory_of(key)
            self._directories.add(directory)
