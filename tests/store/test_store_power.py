"""The power fails at every step of the writer's, and what the disk has then is every state that it may have.

The writer runs on a disk that notes what it is asked. A power cut after step k leaves what was forced to the
medium before, and of everything else any part: bytes by sectors, names by directories, in no order.
"""

from __future__ import annotations

import errno
import os
import random
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import zarr
from store_helpers import Truth, check_rows, fill, make_spec

from acquire.errors import DataError, StoreError, UsageError
from acquire.store import RecordingWriter, RunCondition, open_recording, recover, verify
from acquire.store.files import Disk, ShardFile

SECTOR = 512
MEMORY = Path("/dev/shm")


@pytest.fixture
def tmp_path(tmp_path):
    """In memory, if possible: most of the time went into removing thousands of small trees from a disk."""
    parent = MEMORY if MEMORY.is_dir() and os.access(MEMORY, os.W_OK | os.X_OK) else tmp_path
    with tempfile.TemporaryDirectory(dir=parent, prefix="acquire-test-") as place:
        yield Path(place)


class QuickDisk(Disk):
    """Forces nothing to a medium that will not lose its power."""

    def write_file(self, path, data, *, durable):
        super().write_file(path, data, durable=False)

    def sync_directory(self, path):
        """Nothing."""

    def sync_tree(self, path):
        """Nothing."""


@dataclass
class Trace:
    """What a disk was asked, in order; (operation, inode or path, ...)."""

    steps: list[tuple] = field(default_factory=list)
    inodes: int = 0
    by_path: dict[Path, int] = field(default_factory=dict)

    def new_file(self, path: Path) -> int:
        self.inodes += 1
        self.by_path[path] = self.inodes
        self.steps.append(("link", path, self.inodes))
        return self.inodes


class TracedFile(ShardFile):
    def __init__(self, path: Path, *, direct: bool, trace: Trace) -> None:
        super().__init__(path, direct=direct)
        self._trace, self._inode = trace, trace.new_file(path)

    def write(self, parts, offset):
        data = b"".join(bytes(part) for part in parts)
        self._trace.steps.append(("write", self._inode, offset, data))
        super().write(parts, offset)

    def write_pages(self, parts, offset):
        self.write(parts, offset)

    def sync(self):
        self._trace.steps.append(("sync", self._inode))


class TracedDisk(QuickDisk):
    """Does what is asked, and notes it."""

    def __init__(self) -> None:
        self.trace = Trace()

    def make_directory(self, path, *, parents=False):
        for directory in reversed([path, *path.parents]):
            if not directory.exists():
                super().make_directory(directory)
                self.trace.steps.append(("mkdir", directory))

    def create(self, path, *, direct):
        return TracedFile(path, direct=direct, trace=self.trace)

    def write_file(self, path, data, *, durable):
        super().write_file(path, data, durable=durable)
        inode = self.trace.new_file(path)
        self.trace.steps.append(("write", inode, 0, bytes(data)))
        if durable:
            self.trace.steps.append(("sync", inode))

    def reserve(self, path, size):
        self.write_file(path, b"", durable=False)

    def rename(self, source, target):
        super().rename(source, target)
        inode = self.trace.by_path.pop(source)
        self.trace.by_path[target] = inode
        self.trace.steps.append(("rename", source, target, inode))

    def remove(self, path):
        super().remove(path)
        self.trace.steps.append(("unlink", path))

    def sync_directory(self, path):
        self.trace.steps.append(("syncdir", path))

    def sync_tree(self, path):
        for directory, _, names in os.walk(path, topdown=False):
            for name in names:
                self.trace.steps.append(("sync", self.trace.by_path[Path(directory) / name]))
            self.sync_directory(Path(directory))


class Medium:
    """What is on the disk after a cut: ``keep()`` says of everything that was not forced there if it is."""

    def __init__(self, steps: list[tuple], keep, *, published: bool = False) -> None:
        """``published``: files that replace others land surely, as on file systems that flush at a rename."""
        renamed = {step[-1] for step in steps if published and step[0] == "rename"}
        self.data: dict[int, bytearray] = {}
        self.names: dict[Path, int | None] = {}
        waiting_data: list[tuple] = []
        waiting_names: list[tuple[Path, Path, int | None]] = []
        for operation, *what in steps:
            if operation == "write":
                waiting_data += self._sectors(*what)
            elif operation == "sync":
                self._land([w for w in waiting_data if w[0] == what[0]])
                waiting_data = [w for w in waiting_data if w[0] != what[0]]
            elif operation == "syncdir":
                self._name([n for n in waiting_names if n[0] == what[0]])
                waiting_names = [n for n in waiting_names if n[0] != what[0]]
            else:
                waiting_names += self._entries(operation, what)
        self._land([w for w in waiting_data if w[0] in renamed or keep()])
        self._name([n for n in waiting_names if published or keep()])

    @staticmethod
    def _sectors(inode: int, offset: int, data: bytes) -> list[tuple]:
        cuts = range(0, len(data), SECTOR)
        return [(inode, offset + at, data[at : at + SECTOR]) for at in cuts]

    @staticmethod
    def _entries(operation: str, what: list) -> list[tuple]:
        if operation == "rename":  # of a file within one file system: atomic, in both directories
            _, target, inode = what
            return [(target.parent, target, inode)]
        path = what[0]
        value = {"mkdir": 0, "link": what[-1], "unlink": None}[operation]
        return [(path.parent, path, value)]

    def _land(self, writes: list[tuple]) -> None:
        for inode, offset, data in writes:
            file = self.data.setdefault(inode, bytearray())
            file.extend(bytes(max(0, offset + len(data) - len(file))))
            file[offset : offset + len(data)] = data

    def _name(self, entries: list[tuple]) -> None:
        for _, path, value in entries:
            self.names[path] = value

    def lay_out(self, root: Path, at: Path) -> None:
        """Make the files below ``at`` as they would be found again below ``root``."""
        for path, value in sorted(self.names.items()):
            place = at / path.relative_to(root)
            if value is None or not place.parent.is_dir():
                continue
            if value == 0:
                place.mkdir()
            else:
                place.write_bytes(self.data.get(value, b""))


def record(path: Path, disk: TracedDisk, spec, steps: int = 1) -> list[tuple[int, int]]:
    """A recording with commits, gaps, an unfinished chunk and a seal; (steps traced, lines acknowledged)."""
    acknowledged = [(0, 0)]
    with RecordingWriter.create(path, spec, disk) as writer:
        acknowledged.append((len(disk.trace.steps), 0))
        for step in range(steps):
            fill(writer, 21, block_lines=21)
            writer.add_event("mark", step, spec.first_line, "x")
            writer.commit()
            acknowledged.append((len(disk.trace.steps), writer.committed_lines))
        writer.seal(RunCondition.GOOD, "done", {})
        acknowledged.append((len(disk.trace.steps), writer.committed_lines))
    return acknowledged


def keeper(step: int):
    """By turns nothing, everything, or any part of what was not forced to the medium is there."""
    chance = random.Random(step)
    share = chance.choice((0.0, 1.0, chance.random()))
    return lambda: chance.random() < share


@pytest.mark.parametrize(
    ("codec", "tag_chunks", "first", "stride"),
    [
        *(("none", 1, 0, 4), ("none", 1, 1, 4), ("none", 1, 2, 4), ("none", 1, 3, 4), ("lz4", 1, 0, 13)),
        *(("none", 2, 0, 7), ("none", 2, 3, 7), ("lz4", 2, 0, 17)),
    ],
)
def test_power_cut_at_every_step_loses_nothing_that_was_acknowledged(
    tmp_path, codec, tag_chunks, first, stride
):
    spec = make_spec(fsync="commit", codec=codec, shard_chunks=2, tag_chunks=tag_chunks)
    disk = TracedDisk()
    acknowledged = record(tmp_path / "r.zarr", disk, spec, steps=tag_chunks)
    steps = disk.trace.steps
    created = acknowledged[1][0]
    for cut in range(created + first, len(steps) + 1, stride):
        committed = max(lines for at, lines in acknowledged if at <= cut)
        place = tmp_path / "cut"
        place.mkdir()
        Medium(steps[:cut], keeper(cut)).lay_out(tmp_path, place)
        check(place / "r.zarr", spec, committed, thorough=cut % 50 == 0)
        Disk().remove_tree(place)


def check(path: Path, spec, committed: int, thorough: bool) -> None:
    """Readable from the root at once; and by everybody, in every array, once it is recovered."""
    recording = open_recording(path)
    assert recording.lines >= committed
    if committed:
        np.testing.assert_array_equal(
            recording.arms["b"].read("lines", 0, committed),
            Truth(spec).block("b", spec.first_line, committed).pixels,
        )
    recovered = recover(path, QuickDisk())
    assert recovered.lines >= committed
    assert not recovered.damage
    check_arms(path, spec, recovered.lines)
    found = verify(path)
    assert found.intact, found
    if thorough:
        check_rows(zarr.open_group(path, mode="r"), spec, recovered.lines)
        for name in ("a/lines", "b/flags"):
            assert zarr.open_array(path / name, mode="r").shape[0] == recovered.lines
        assert not recover(path, QuickDisk()).changed


def check_arms(path: Path, spec, rows: int) -> None:
    """Every line is the truth, by the reader of ours."""
    for arm, stream in open_recording(path).arms.items():
        assert len(stream) == rows
        for name, values in Truth(spec).arrays(arm, spec.first_line, rows).items():
            np.testing.assert_array_equal(stream.read(name, 0, rows), values)


@pytest.mark.parametrize("tag_chunks", [1, 2])
def test_power_cut_without_forcing_loses_no_line_unreported(tmp_path, tag_chunks):
    """With ``fsync="seal"`` lines may be lost, but each is flagged and listed, and none is invented."""
    spec = make_spec(fsync="seal", codec="none", shard_chunks=2, tag_chunks=tag_chunks)
    disk = TracedDisk()
    (_, (steps_created, _), *_) = record(tmp_path / "r.zarr", disk, spec, steps=tag_chunks)
    steps = disk.trace.steps
    opened = lost = 0
    for cut in range(steps_created, len(steps) + 1, 5):
        place = tmp_path / "cut"
        place.mkdir()
        Medium(steps[:cut], keeper(cut), published=True).lay_out(tmp_path, place)
        opened += check_told(place / "r.zarr", spec)
        lost += bool(open_recording(place / "r.zarr").gaps)
        Disk().remove_tree(place)
    assert opened > 40
    assert lost > 5


def check_told(path: Path, spec) -> bool:
    try:
        recovered = recover(path, QuickDisk())
    except DataError:  # the root itself was not forced to the medium: there is no recording to speak of
        return False
    assert verify(path).contradictions == ()
    root = zarr.open_group(path, mode="r")
    for arm in "ab":
        truth = Truth(spec).arrays(arm, spec.first_line, recovered.lines)
        missing = (root[arm]["flags"][:] & 1) != 0
        gaps = [gap for gap in open_recording(path).gaps if gap.arm == arm]
        assert missing.sum() == sum(gap.count for gap in gaps)
        for chunk in range(-(-recovered.lines // spec.chunk_lines)):
            rows = slice(chunk * spec.chunk_lines, min(recovered.lines, (chunk + 1) * spec.chunk_lines))
            if not missing[rows].any():
                for name, values in truth.items():
                    np.testing.assert_array_equal(root[arm][name][rows], values[rows])
    assert not recover(path, QuickDisk()).changed
    return True


class FailingDisk(QuickDisk):
    """Every change after the first ``allowed`` is refused with ``number``."""

    def __init__(self, allowed: int, number: int) -> None:
        self.left, self.number = allowed, number

    def spend(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise OSError(self.number, os.strerror(self.number))

    def make_directory(self, path, *, parents=False):
        self.spend()
        super().make_directory(path, parents=parents)

    def create(self, path, *, direct):
        self.spend()
        return FailingFile(path, direct=direct, disk=self)

    def write_file(self, path, data, *, durable):
        self.spend()
        super().write_file(path, data, durable=durable)

    def rename(self, source, target):
        self.spend()
        super().rename(source, target)

    def sync_directory(self, path):
        self.spend()


class FailingFile(ShardFile):
    def __init__(self, path, *, direct, disk):
        super().__init__(path, direct=direct)
        self._disk = disk

    def write(self, parts, offset):
        self._disk.spend()
        super().write(parts, offset)

    def write_pages(self, parts, offset):
        self._disk.spend()
        super().write_pages(parts, offset)

    def sync(self):
        self._disk.spend()
        super().sync()


@pytest.mark.parametrize(("number", "tag_chunks"), [(errno.ENOSPC, 1), (errno.EIO, 2), (errno.EROFS, 1)])
def test_a_disk_that_fails_at_any_step_acknowledges_nothing_false(tmp_path, number, tag_chunks):
    spec = make_spec(fsync="commit", codec="none", shard_chunks=2, tag_chunks=tag_chunks)
    outcomes = set()
    for allowed in range(0, 800, 23):
        path = tmp_path / f"{allowed}.zarr"
        outcome, acknowledged = attempt(path, spec, FailingDisk(allowed, number))
        outcomes.add(outcome)
        if outcome == "refused":
            assert not path.exists()
            continue
        recovered = recover(path, QuickDisk())
        assert recovered.lines >= acknowledged
        assert not recovered.damage
        check_arms(path, spec, recovered.lines)
        assert verify(path).intact
    assert {"refused", "failed", "whole"} == outcomes


def attempt(path: Path, spec, disk: Disk) -> tuple[str, int]:
    try:
        writer = RecordingWriter.create(path, spec, disk)
    except (StoreError, UsageError):
        return "refused", 0
    with writer:
        try:
            for _ in range(3):
                fill(writer, 21)
                writer.commit()
            writer.seal(RunCondition.GOOD, "done", {})
        except DataError as error:
            reason = os.strerror(disk.number) in str(error)
            return "failed" if reason else str(error), writer.committed_lines
    return "whole", writer.committed_lines
