"""Endless recordings: what goes, what stays, what is told, and in which order."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import zarr
from store_helpers import Truth, fill, make_spec

from acquire.errors import DataError, PlaceError, UsageError
from acquire.store import (
    RecordingWriter,
    Retention,
    RunCondition,
    hold,
    holds,
    open_recording,
    recover,
    verify,
)
from acquire.store.files import Disk
from acquire.store.removal import COPY, shard_files
from acquire.store.retention import Keeper, keep_from, shard_bytes
from acquire.store.room import RoomWatch

SHARD = 64
"""Lines: 4 chunks of 16."""
AGE = Retention(max_age_lines=2 * SHARD, margin_lines=16)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "r.zarr"


def spec_of(policy, **changes):
    return make_spec(codec="none", retention=policy, **changes)


def grow(writer, lines, step=32):
    for _ in range(lines // step):
        fill(writer, step)
        writer.commit()


def left(path):
    """Shards of which anything is on disk."""
    return [shard for shard in range(40) if shard_files(path, shard)]


def test_lines_that_are_too_old_are_dropped_and_listed(path):
    with RecordingWriter.create(path, spec_of(AGE)) as writer:
        grow(writer, 10 * SHARD)
        recording = open_recording(path)
        assert recording.dropped == ((1000, 8 * SHARD),)
        assert left(path) == [8, 9]
        assert recording.first_available_line == 1000 + 8 * SHARD
        with pytest.raises(DataError, match=r"lines 1000 to 1511 were dropped.*possible: lines 1512 to 1639"):
            recording.cut(1500, 20)
        truth = Truth(writer.spec).block("b", 1600, 30)
        np.testing.assert_array_equal(recording.cut(1600, 30).lines[1], truth.pixels)
        flags = zarr.open_group(path, mode="r")["a/flags"][:]
        assert (flags[: 8 * SHARD] == 1).all(), "to plain Zarr they are missing lines"
        assert verify(path).intact
        writer.seal(RunCondition.GOOD, "done", {})
    recording = open_recording(path)
    assert recording.info()["first_available_line"] == 1512
    assert recording.info()["start_ns"] == Truth(writer.spec).block("a", 1512, 1).tags.time_ns[0]
    assert verify(path).intact
    assert "lines 1000 to 1511 were dropped by retention" in verify(path).notes
    assert not recover(path).changed


def test_the_size_is_bounded(path):
    with RecordingWriter.create(path, spec_of(None)) as writer:
        grow(writer, 2 * SHARD)
        size = shard_bytes(path, 0)
    bounded = path.with_name("bounded.zarr")
    limit = 4 * size
    with RecordingWriter.create(bounded, spec_of(Retention(max_bytes=limit, margin_lines=16))) as writer:
        for _ in range(20):
            grow(writer, SHARD, step=32)
            assert sum(shard_bytes(bounded, shard) for shard in left(bounded)) <= limit
        assert left(bounded)[-2:] == [18, 19]
        assert len(left(bounded)) < 5


def test_by_how_much_held_lines_exceed_the_size_is_known(path):
    with RecordingWriter.create(path, spec_of(None)) as writer:
        grow(writer, 2 * SHARD)
        size = shard_bytes(path, 0)
    bounded = path.with_name("bounded.zarr")
    with RecordingWriter.create(bounded, spec_of(Retention(max_bytes=4 * size, margin_lines=16))) as writer:
        grow(writer, 8 * SHARD)
        assert writer.beyond_bytes == 0
        hold(bounded, 1000 + 7 * SHARD, 2**40)
        grow(writer, 8 * SHARD)
        kept = sum(shard_bytes(bounded, shard) for shard in left(bounded))
        assert kept > 4 * size
        assert writer.beyond_bytes == kept - 4 * size


def test_the_margin_behind_the_newest_line_always_stays(path):
    policy = Retention(max_age_lines=1, margin_lines=3 * SHARD)
    with RecordingWriter.create(path, spec_of(policy)) as writer:
        grow(writer, 10 * SHARD)
        assert left(path) == [7, 8, 9]


def test_events_and_marked_lines_are_held_with_their_margin(path):
    policy = Retention(max_age_lines=SHARD, margin_lines=16, hold_lines=(10, 20))
    with RecordingWriter.create(path, spec_of(policy)) as writer:
        grow(writer, SHARD, step=32)
        writer.add_event("mark", 0, 1000 + SHARD + 20)
        hold(path, 1000 + 4 * SHARD - 10, 5, why="a flash")
        grow(writer, 9 * SHARD)
        assert left(path) == [0, 1, 3, 4, 9], "both touch the next shard with their margin"
        recording = open_recording(path)
        assert recording.dropped == ((1000 + 2 * SHARD, SHARD), (1000 + 5 * SHARD, 4 * SHARD))
        assert recording.attrs["holds"] == [
            [1000 + SHARD + 10, 31, "mark"],
            [1000 + 4 * SHARD - 10, 5, "a flash"],
        ]
        assert recording.cut(1000, 2 * SHARD).mask.all()
        with pytest.raises(DataError, match=r"lines 1128 to 1191 are gone already; possible: the others"):
            hold(path, 1120, 200)
        writer.seal(RunCondition.GOOD, "done", {})
    assert [file.name for file in path.rglob(".*")] == [COPY]
    assert verify(path).intact


def test_a_hold_that_comes_while_lines_are_being_dropped_wins(path):
    """The writer has told of the drop and not yet deleted."""
    with RecordingWriter.create(path, spec_of(None)) as writer:
        grow(writer, 4 * SHARD)
        keeper = Keeper(path, AGE, SHARD, 1000, Disk())
        going = keeper.choose(4 * SHARD)
        assert (going, keeper.gone) == ([0, 1], [range(2)])
        hold(path, 1000, 10)
        assert keeper.delete(going) == [0]
        assert keeper.gone == [range(1, 2)]
        assert left(path) == [0, 2, 3]


def test_holds_and_drops_race_in_threads(path):
    """Whatever the order, what `hold` accepted is there at the end."""
    accepted = []
    begun = threading.Event()

    def holder():
        begun.wait(300)
        for line in range(1000, 1000 + 30 * SHARD, 3 * SHARD):
            try:
                accepted.append(hold(path, line, 4))
            except DataError:
                continue

    thread = threading.Thread(target=holder)
    thread.start()
    try:
        policy = Retention(max_age_lines=SHARD, margin_lines=1)
        with RecordingWriter.create(path, spec_of(policy)) as writer:
            begun.set()
            grow(writer, 30 * SHARD, step=64)
            thread.join(300)
            for held in accepted:
                assert open_recording(path).cut(held.first_line, held.count).mask.all()
    finally:
        begun.set()
        thread.join(300)


class SmallDisk(Disk):
    """``size`` bytes, of which a recording takes its share."""

    def __init__(self, path, size):
        self.path, self.size = path, size

    def free_bytes(self, path):
        return self.size - sum(shard_bytes(self.path, shard) for shard in left(self.path))


@pytest.fixture
def always_looking(monkeypatch):
    monkeypatch.setattr("acquire.store.room.LOOK_S", 0.0)


def test_a_disk_is_reported_as_nearly_full_before_it_is_full(path, always_looking):
    disk = SmallDisk(path, 1_000_000)
    spec = spec_of(None, reserve_bytes=300_000)
    with RecordingWriter.create(path, spec, disk) as writer:
        while writer.nearly_full is None:
            assert disk.free_bytes(path) > 100_000
            fill(writer, 48)
            writer.commit()
        assert "disk nearly full: 300000 bytes are kept free" in writer.nearly_full
        assert writer.room.full
        assert writer.room.seconds_to_full == 0
        writer.seal(RunCondition.INTERRUPTED, writer.nearly_full, {})
    assert verify(path).intact


class AnyDisk(Disk):
    """As many bytes as the test says."""

    def __init__(self, free):
        self.free = free

    def free_bytes(self, path):
        return self.free


@pytest.mark.parametrize("others", [0, 600])
def test_a_reserve_that_is_smaller_than_one_step_holds(path, always_looking, others):
    """What came between two looks took all of it, also if another recording on the same disk wrote it."""
    disk, reserve, written = AnyDisk(10_000), 50, 0
    watch = RoomWatch(disk, path, reserve)
    while not watch.look(written).full:
        written += 400
        disk.free -= 400 + others
    assert reserve < disk.free <= reserve + 400 + others


def test_a_copy_holds_nothing_where_a_recording_was_moved_away(path, tmp_path):
    """It made directories there, which looked like a recording that had lost its lines."""
    with RecordingWriter.create(path, spec_of(None)) as writer:
        grow(writer, SHARD)
        path.rename(tmp_path / "moved.zarr")
        with pytest.raises(PlaceError, match="cannot be held: No such file or directory"):
            keep_from(path, 1000, "file:///far/r.zarr")
    assert not path.exists()


def test_of_an_endless_recording_on_a_full_disk_what_it_writes_counts(path, always_looking):
    """It frees as much, so that the disk does not get any fuller."""
    disk = AnyDisk(50 + 401)
    watch = RoomWatch(disk, path, 50)
    assert not watch.look(400).full
    assert not watch.look(800).full
    disk.free -= 1
    assert watch.look(1200).missing_bytes == 0


def test_with_retention_the_oldest_lines_make_room_instead(path, always_looking):
    disk = SmallDisk(path, 2_000_000)
    spec = spec_of(Retention(margin_lines=16), reserve_bytes=300_000)
    with RecordingWriter.create(path, spec, disk) as writer:
        grow(writer, 30 * SHARD)
        assert writer.nearly_full is None
        assert disk.free_bytes(path) > 0
        dropped = open_recording(path).dropped
        assert dropped[0][0] == 1000
        hold(path, open_recording(path).first_available_line, 10**6)
        for _ in range(100):
            grow(writer, SHARD, step=64)
            if writer.nearly_full:
                break
        assert writer.nearly_full
        assert disk.free_bytes(path) + 300_000 > 0


def test_recover_deletes_files_that_were_only_listed_as_dropped(path):
    with RecordingWriter.create(path, spec_of(AGE)) as writer:
        grow(writer, 6 * SHARD)
    before = left(path)
    assert before == [4, 5]
    for arm in "ab":
        (path / arm / "tick" / "c" / "0").write_bytes(b"left")
    recovered = recover(path)
    assert (recovered.lines, left(path)) == (6 * SHARD, [4, 5])
    assert open_recording(path).dropped == ((1000, 4 * SHARD),)
    assert verify(path).intact


@pytest.mark.parametrize("wrong", [{"max_bytes": 0}, {"max_age_lines": -1}, {"margin_lines": -1}])
def test_limits_that_cannot_be_are_refused(wrong):
    with pytest.raises(UsageError, match="retention"):
        Retention(**wrong)


def test_holds_that_cannot_be_are_refused(path):
    with RecordingWriter.create(path, spec_of(AGE)) as writer:
        for first, count in ((-1, 5), (1000, 0), (10, 20)):
            with pytest.raises(UsageError, match="held"):
                hold(path, first, count)
        writer.seal(RunCondition.GOOD, "done", {})
    with pytest.raises(UsageError, match=r"it drops no lines"):
        hold(path, 1000, 5)


@pytest.mark.parametrize(
    "text",
    ["{", '{"first_line": 1e999, "count": 5, "why": ""}', '{"first_line": -5, "count": 5, "why": ""}'],
    ids=["torn", "infinite", "negative"],
)
def test_a_file_that_is_no_hold_holds_everything_and_is_named(path, text):
    """It may have meant any line; the recording goes on until the disk is full, and says why."""
    with RecordingWriter.create(path, spec_of(AGE)) as writer:
        grow(writer, 6 * SHARD)
        hold(path, 1500, 5)
        (path / "a" / "lines" / ".holds" / "1-2.json").write_text(text)
        grow(writer, 6 * SHARD)
        assert left(path) == list(range(4, 12))
        (why,) = [why for _, _, why in open_recording(path).attrs["holds"] if "not a valid hold" in why]
        assert "1-2.json is not a valid hold, remove it" in why
        (path / "a" / "lines" / ".holds" / "1-2.json").unlink()
        grow(writer, SHARD)
        assert left(path)[0] == 8 - 1
        writer.seal(RunCondition.GOOD, "done", {})
    assert verify(path).intact


def test_events_that_follow_each_other_are_one_hold(path):
    policy = Retention(max_age_lines=SHARD, hold_lines=(10, 20))
    keeper = Keeper(path, policy, SHARD, 1000, Disk())
    for line in (1005, 1030, 1010, 2000, 2001):
        keeper.note("mark", line)
    keeper.note("started", 3000)
    assert [(hold.first_line, hold.count) for hold in keeper.holds] == [(1000, 51), (1990, 32)]


def test_a_hold_is_read_again_only_if_it_has_changed(path, monkeypatch):
    """There may be thousands, and ten commits a second."""
    read, now_s = [], [100.0]
    original = holds.read_object
    monkeypatch.setattr(
        holds, "read_object", lambda file, **more: read.append(file.name) or original(file, **more)
    )

    def look(later_s):
        read.clear()
        now_s[0] += later_s
        return [(held.first_line, held.count, held.why) for held in files.read()], list(read)

    with RecordingWriter.create(path, spec_of(AGE)) as writer:
        grow(writer, 2 * SHARD)
        files = holds.HoldFiles(path, lambda: now_s[0])
        assert look(0.0) == ([], [])
        hold(path, 1000, 5, "one")
        keep_from(path, 1010, "file:///copy")
        (copy,) = (path / "a" / "lines" / holds.HOLDS).glob("0-*.json")
        names = [copy.name, "1000-5.json"]
        for _ in range(2):  # changed twice within a step of the clock, they would look the same
            assert look(2.0) == ([(1010, 2**62, "not copied yet"), (1000, 5, "one")], names)
        assert look(2.0)[1] == names
        assert look(0.1) == ([(1010, 2**62, "not copied yet"), (1000, 5, "one")], [])
        keep_from(path, 1020, "file:///copy")
        hold(path, 1001, 5, "two")
        assert look(0.1) == (
            [(1020, 2**62, "not copied yet"), (1000, 5, "one"), (1001, 5, "two")],
            [copy.name, "1001-5.json"],
        )
        (copy.parent / "1000-5.json").write_text('{"first_line": 900, "count": 5, "why": "by hand"}')
        assert look(9.0)[0][1:] == [(900, 5, "by hand"), (1001, 5, "two")]
        assert look(9.0)[1] == ["1000-5.json"]
        copy.unlink()
        assert look(0.1) == ([(900, 5, "by hand"), (1001, 5, "two")], [])
