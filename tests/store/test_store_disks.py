"""Disks as they are: full ones, some without direct I/O; and codecs chosen by what they sustain."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
import zarr
from store_helpers import Truth, check_rows, fill, make_spec
from waiting import until

from acquire.errors import DataError, StoreError, UsageError
from acquire.lines import ARMS
from acquire.store import (
    Circumstances,
    RecordingWriter,
    RunCondition,
    choose_codec,
    files,
    hold,
    measure_disk,
    open_recording,
    open_video,
    recover,
    verify,
    write_video,
)
from acquire.store.array_writer import ArrayWriter
from acquire.store.delivery import whole_file
from acquire.store.files import Disk, ShardFile, write_all
from acquire.store.pages import PAGE, aligned_bytes, is_aligned, open_direct
from acquire.store.shape import CODECS
from acquire.store.table import EVENT_ROWS, GAP_ROWS

BIG = make_spec(pixels=1024, chunk_lines=64, shard_chunks=4, codec="none")
"""Chunks of 128 KiB: large enough for direct I/O."""


@pytest.fixture
def path(tmp_path):
    return tmp_path / "r.zarr"


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 8 MB."""
    place = tmp_path / "small"
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "none", str(place)], check=True)
    yield place
    subprocess.run(["umount", str(place)], check=True)


def fill_up(writer):
    for _ in range(1000):
        fill(writer, 64)
        writer.commit()


@pytest.mark.needs_mount
@pytest.mark.parametrize("codec", ["none", "lz4"])
def test_a_disk_that_is_full_seals_what_it_has(small_disk, codec):
    path = small_disk / "r.zarr"
    spec = make_spec(pixels=1024, chunk_lines=64, shard_chunks=4, codec=codec, reserve_bytes=0)
    with RecordingWriter.create(path, spec) as writer:
        with pytest.raises(DataError, match=r"No space left on device.*try: free space"):
            fill_up(writer)
        acknowledged = writer.committed_lines
        writer.seal(RunCondition.ABORTED, "disk full", {})
    assert acknowledged > 100
    recording = open_recording(path)
    assert recording.lines >= acknowledged
    assert recording.attrs["ledger"]["store"]["disk_error"].endswith("No space left on device")
    assert verify(path).intact
    check_rows(zarr.open_group(path, mode="r"), spec, recording.lines)


@pytest.mark.needs_mount
def test_on_a_full_disk_a_hold_leaves_nothing_and_a_recovery_has_its_reserve(small_disk):
    """An empty file of the hold was left, and the recovery found no room although it had been reserved."""
    path = small_disk / "r.zarr"
    with RecordingWriter.create(path, make_spec()) as writer:
        fill(writer, 150)
        writer.commit()
        lines = writer.committed_lines
    with contextlib.suppress(OSError), (small_disk / "rest").open("wb", buffering=0) as rest:
        while rest.write(bytes(4096)):
            pass
    before = sorted(path.rglob("*"))
    with pytest.raises(StoreError, match=r"lines 1010 to 1014 cannot be held: No space left on device"):
        hold(path, 1010, 5)
    assert sorted(path.rglob("*")) == before
    assert recover(path).lines == lines
    assert open_recording(path).state == "sealed"
    assert verify(path).intact


@pytest.mark.needs_mount
@pytest.mark.parametrize("text", ["the valve opens " * 25, "\N{BUG}" * 400])
@pytest.mark.parametrize("killed", [False, True])
def test_however_many_marks_there_are_the_end_finds_room_on_a_full_disk(small_disk, text, killed):
    """Their table had outgrown what is reserved for the end: the recording stayed open."""
    path, texts = small_disk / "r.zarr", [f"{number} {text}" for number in range(EVENT_ROWS)]
    with RecordingWriter.create(path, make_spec()) as writer:
        fill(writer, 150)
        for number in range(200):
            writer.add_event("mark", number, 1000, texts[number])
        writer.commit()
        with contextlib.suppress(OSError), (small_disk / "rest").open("wb", buffering=0) as rest:
            while rest.write(bytes(4096)):
                pass
        for number in range(200, EVENT_ROWS):
            writer.add_event("mark", number, 1000, texts[number])
        for _ in range(GAP_ROWS + 3):
            writer.add_gap("a", 1020, 1, "camera")
        with pytest.raises(DataError, match="No space left on device"):
            writer.commit()
        lines = writer.committed_lines
        if not killed:
            writer.seal(RunCondition.ABORTED, "disk full", {})
    if killed:
        recover(path, known=Circumstances(notes=tuple((1000, "mark", text) for text in texts)))
    found = open_recording(path)
    assert (found.state, found.lines) == ("sealed", lines)
    listed = [event.text for event in found.events if event.kind == "mark"]
    assert 600 < len(listed) < EVENT_ROWS
    assert listed == texts[: len(listed)]
    assert found.events_not_listed == EVENT_ROWS - len(listed)
    assert "events found no room in the table" in found.info()["tables_lack"][0]


@pytest.mark.needs_mount
def test_the_watch_ends_a_recording_before_the_disk_is_full(small_disk, monkeypatch):
    monkeypatch.setattr("acquire.store.room.LOOK_S", 0.0)
    path = small_disk / "r.zarr"
    spec = make_spec(pixels=1024, chunk_lines=64, shard_chunks=4, codec="none", reserve_bytes=2 * 2**20)
    with RecordingWriter.create(path, spec) as writer:
        while writer.nearly_full is None:
            fill(writer, 64)
            writer.commit()
        writer.seal(RunCondition.INTERRUPTED, writer.nearly_full, {})
    recording = open_recording(path)
    assert "disk nearly full" in recording.attrs["end_reason"]
    assert recording.attrs["ledger"]["store"]["disk_error"] is None
    assert verify(path).intact


@pytest.mark.parametrize("fsync", ["seal", "commit"])
def test_the_directory_of_recordings_may_be_a_link(tmp_path, fsync):
    """As /data often is: its recordings could not be sealed."""
    (tmp_path / "mounted").mkdir()
    (tmp_path / "data").symlink_to("mounted")
    path, left = tmp_path / "data" / "r.zarr", tmp_path / "data" / "left.zarr"
    with RecordingWriter.create(path, make_spec(fsync=fsync)) as writer:
        fill(writer, 150)
        writer.seal(RunCondition.GOOD, "done", {})
    with RecordingWriter.create(left, make_spec(fsync=fsync)) as writer:
        fill(writer, 150)
        writer.commit()
    recover(left)
    for one in (path, left):
        assert open_recording(one).state == "sealed"
        assert verify(one).intact
    place = tmp_path / "data" / "v.zarr"
    video = np.zeros((4, 6, 6), np.float32)
    write_video(place, video, np.arange(4), pixel_size=1.0, frame_interval_ns=1.0, provenance={})
    assert len(open_video(place).time_ns) == 4
    with whole_file(tmp_path / "data" / "file") as file:
        file.write_bytes(b"whole")
    assert (tmp_path / "mounted" / "file").read_bytes() == b"whole"


def test_chunks_go_past_the_page_cache_where_that_can_be(path):
    with RecordingWriter.create(path, BIG) as writer:
        fill(writer, 150, block_lines=64)
        writer.seal(RunCondition.GOOD, "done", {})
    (path / "probe").touch()
    fd = open_direct(path / "probe")
    assert open_recording(path).attrs["ledger"]["store"]["direct_io"] is (fd >= 0)
    if fd >= 0:
        os.close(fd)
    (path / "probe").unlink()
    check_rows(zarr.open_group(path, mode="r"), BIG, 150)


def test_without_direct_writes_it_goes_through_the_cache(path, monkeypatch):
    """A file system may take O_DIRECT when a file is opened, and then no write of it."""

    def refuse(fd, parts, offset):
        if fcntl.fcntl(fd, fcntl.F_GETFL) & os.O_DIRECT:
            raise OSError(errno.EINVAL, "Invalid argument")
        write_all(fd, parts, offset)

    monkeypatch.setattr("acquire.store.files.write_all", refuse)
    with RecordingWriter.create(path, BIG) as writer:
        fill(writer, 150, block_lines=64)
        writer.seal(RunCondition.GOOD, "done", {})
    check_rows(zarr.open_group(path, mode="r"), BIG, 150)


def test_an_unaligned_short_direct_write_goes_on_through_the_cache(path):
    file = ShardFile(path, direct=True)
    memory = aligned_bytes(2 * PAGE)
    memory[:] = 7
    file.write_pages([memory[1 : PAGE + 1].data], PAGE)  # what direct I/O refuses
    file.close()
    assert path.read_bytes() == bytes(PAGE) + b"\7" * PAGE


def test_memory_in_pages_is_written_from_where_it_is(path):
    spec = make_spec(pixels=1024, dtype="uint8", chunk_lines=64, shard_chunks=4, codec="none")
    truth = Truth(spec)
    with RecordingWriter.create(path, spec) as writer:
        for number in range(3):
            for arm in ARMS:
                block = truth.block(arm, 1000 + 64 * number, 64)
                memory = aligned_bytes(block.pixels.nbytes)[: block.pixels.nbytes]
                memory[:] = block.pixels.reshape(-1)
                assert is_aligned(memory)
                object.__setattr__(block, "pixels", memory.reshape(64, 1024))
                writer.append(block)
                memory[:] = 0  # it may be used again at once
        writer.seal(RunCondition.GOOD, "done", {})
    check_rows(zarr.open_group(path, mode="r"), spec, 192)


class LateDisk(Disk):
    """Looks at the memory that it is given late; after ``allowed`` pieces it is full."""

    def __init__(self, allowed=10**6):
        self.left = allowed

    def create(self, path, *, direct):
        file = ShardFile(path, direct=direct)
        write_pages = file.write_pages

        def late(parts, offset):
            self.left -= 1
            time.sleep(0.005)
            if self.left < 0:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            write_pages(parts, offset)

        file.write_pages = late
        return file


def lend_blocks(writer, truth, sizes):
    """Blocks of both arms in turn, each arm's in the same memory, which is filled anew once it is back."""
    memory = {arm: aligned_bytes(max(sizes) * truth.spec.pixels * 2) for arm in ARMS}
    for size in sizes:
        for arm in ARMS:
            writer.give_back(arm)
            block = truth.block(arm, writer.next_line(arm), size)
            pixels = memory[arm][: block.pixels.nbytes].view(block.pixels.dtype).reshape(block.pixels.shape)
            pixels[:] = block.pixels
            object.__setattr__(block, "pixels", pixels)
            writer.append(block, lent=True)


@pytest.mark.parametrize("codec", ["none", "lz4"])
def test_memory_that_is_lent_is_written_as_it_was(path, codec):
    """Whole chunks, several at once, over the end of a file, and such as are put together from blocks."""
    spec = make_spec(pixels=1024, chunk_lines=64, shard_chunks=4, codec=codec)
    sizes = [64, 128, 320, 150, 10, 90, 64, 200]
    with RecordingWriter.create(path, spec, LateDisk()) as writer:
        lend_blocks(writer, Truth(spec), sizes)
        writer.commit()
        assert writer.committed_lines == sum(sizes) // 64 * 64
        writer.seal(RunCondition.GOOD, "done", {})
    check_rows(zarr.open_group(path, mode="r"), spec, sum(sizes))
    assert verify(path).intact


@pytest.mark.parametrize("allowed", range(1, 8))
def test_a_disk_that_fails_while_memory_is_lent(path, allowed):
    with RecordingWriter.create(path, BIG, LateDisk(allowed)) as writer:
        with pytest.raises(DataError, match=r"writing lines of arm [ab]: No space left on device"):
            lend_blocks(writer, Truth(BIG), [128] * 5)
        with pytest.raises(DataError, match="no more lines"):
            writer.append(Truth(BIG).block("a", writer.next_line("a"), 64), lent=True)
        for arm in ARMS:
            with contextlib.suppress(DataError):  # the other may have failed as well
                writer.give_back(arm)
        writer.seal(RunCondition.ABORTED, "disk full", {})
    recording = open_recording(path)
    assert recording.lines == allowed // 2 * 128
    assert verify(path).intact
    check_rows(zarr.open_group(path, mode="r"), BIG, recording.lines)


@pytest.mark.parametrize("codec", ["lz4", "zstd"])
def test_encoders_keep_the_order_of_chunks(path, codec):
    spec = make_spec(codec=codec, encoders=4, chunk_lines=16, shard_chunks=3)
    with RecordingWriter.create(path, spec) as writer:
        for _ in range(5):
            fill(writer, 100, block_lines=9)
            writer.commit()
            assert writer.committed_lines == (writer.next_line("a") - 1000) // 16 * 16
        writer.seal(RunCondition.GOOD, "done", {})
    check_rows(zarr.open_group(path, mode="r"), spec, 500)


@pytest.mark.parametrize("tag_chunks", [1, 4])
def test_no_more_is_lost_at_a_kill_than_is_stated(path, tag_chunks):
    spec = make_spec(codec="none", chunk_lines=16, commit_lines=32, tag_chunks=tag_chunks)
    lost = spec.durability.kill_lines
    with RecordingWriter.create(path, spec) as writer:
        for lines in range(7, 200, 7):
            fill(writer, 7, block_lines=7)
            assert writer.next_line("a") - 1000 == lines
            assert lines - writer.committed_lines < spec.commit_lines + lost
        told = writer.next_line("a") - 1000
    assert told - recover(path).lines < lost


def lines(noise: float) -> np.ndarray:
    generator = np.random.default_rng(1)
    return np.clip(generator.normal(100, noise, (512, 1024)), 0, 255).astype(np.uint8)


def test_the_smallest_codec_that_holds_the_rate_is_chosen():
    slow = choose_codec(lines(1), bytes_per_s=1e3, disk_bytes_per_s=1e9)
    ratios = {speed.codec: speed.ratio for speed in slow.measured}
    assert set(ratios) == set(CODECS)
    assert ratios["none"] == 1
    assert min(ratios["lz4"], ratios["zstd"]) > 1.5
    assert ratios[slow.codec] == max(ratios.values())
    assert "smallest" in slow.reason
    assert slow.to_attrs()["measured"][0]["codec"] == "none"


def test_a_rate_that_no_codec_holds_gets_the_nearest():
    choice = choose_codec(lines(60), bytes_per_s=1e15, disk_bytes_per_s=1e14)
    assert choice.codec == "none"
    assert "none holds" in choice.reason


def test_a_slow_disk_asks_for_packing():
    """Uncompressed lines do not fit through the disk, packed ones do."""
    choice = choose_codec(lines(1), bytes_per_s=1e4, disk_bytes_per_s=1.6e4)
    assert choice.codec != "none"


@pytest.mark.parametrize("wrong", [(0, 1.0), (1.0, 0)])
def test_rates_that_cannot_be_are_refused(wrong):
    with pytest.raises(UsageError, match="no codec can be chosen"):
        choose_codec(lines(1), *wrong)


def test_the_disk_is_measured_and_nothing_is_left(tmp_path):
    assert measure_disk(tmp_path, size=2**23) > 1e5
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("named", [False, True])
def test_the_disk_is_measured_the_way_lines_are_written(tmp_path, monkeypatch, named):
    if named:
        monkeypatch.setattr(os, "O_TMPFILE", os.O_TMPFILE & ~os.O_DIRECTORY)  # is refused: EISDIR
    ways = []

    class Watched(files.ShardFile):
        def write_pages(self, parts, offset):
            super().write_pages(parts, offset)
            ways.append(self.direct)

    monkeypatch.setattr(files, "ShardFile", Watched)
    measure_disk(tmp_path, size=2**23)
    with contextlib.closing(ShardFile(tmp_path / "lines", direct=True)) as lines_file:
        assert ways == [lines_file.direct] * 2


@pytest.mark.parametrize("named", [False, True])
def test_a_kill_while_the_disk_is_measured_leaves_nothing(tmp_path, monkeypatch, named):
    """Also where the file system makes no file without a name; the next look clears what older ones left."""
    if named:
        monkeypatch.setattr(os, "O_TMPFILE", os.O_TMPFILE & ~os.O_DIRECTORY)  # is refused: EISDIR
    left = tmp_path / ".acquire-999999999.measure"
    left.touch()
    child = os.fork()
    if child == 0:
        try:
            measure_disk(tmp_path, size=2**50)
        finally:
            os._exit(1)

    def has_file() -> bool:
        targets = []
        for entry in Path(f"/proc/{child}/fd").iterdir():
            with contextlib.suppress(FileNotFoundError):  # it has been closed since
                targets.append(str(entry.readlink()))
        return any(str(tmp_path) in target and "deleted" in target for target in targets)

    try:
        until(has_file, "the file that is written")
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    assert not list(tmp_path.iterdir())


def test_a_disk_that_is_gone_while_measured_is_an_error(tmp_path):
    with pytest.raises(OSError, match=os.strerror(errno.ENOENT)):
        measure_disk(tmp_path / "gone")


def test_what_somebody_else_removes_meanwhile_need_not_be_forced(tmp_path, monkeypatch):
    """As a copier its hold, which it replaces, while the recording is sealed."""
    (tmp_path / "holds").mkdir()
    names = [tmp_path / "chunk", tmp_path / "holds" / "a", tmp_path / "holds" / "b"]
    for name in names:
        name.write_bytes(b"x")
    forced, really = [], files._sync

    def sync(path, flags=0):
        forced.append(path)
        if path.name in "ab":
            for other in (names[1], names[2]):
                other.unlink(missing_ok=True)
        really(path, flags)

    monkeypatch.setattr(files, "_sync", sync)
    files.DISK.sync_tree(tmp_path)
    assert {tmp_path / "chunk", tmp_path / "holds", tmp_path} <= set(forced)


@pytest.mark.parametrize("number", [errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_file_is_delivered_where_there_are_no_hard_links(tmp_path, monkeypatch, number):
    """As to a memory card: exFAT refuses links with EPERM."""

    def refuse(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "link", refuse)
    with whole_file(tmp_path / "cut.npz") as part:
        part.write_bytes(b"lines")
    assert [path.name for path in tmp_path.iterdir()] == ["cut.npz"]
    assert (tmp_path / "cut.npz").read_bytes() == b"lines"
    with pytest.raises(UsageError, match="exists already"), whole_file(tmp_path / "cut.npz") as part:
        part.write_bytes(b"others")
    assert [path.name for path in tmp_path.iterdir()] == ["cut.npz"]
    assert (tmp_path / "cut.npz").read_bytes() == b"lines"


def test_a_file_that_vanishes_while_sizes_are_added_up_counts_nothing(tmp_path, monkeypatch):
    """As the scratch file of a recording's metadata, ten times a second."""
    (tmp_path / "zarr.json").write_bytes(b"root")
    (tmp_path / ".next").write_bytes(b"x")
    really = Path.stat

    def stat(path, **how):
        found = really(path, **how)
        if path.name == ".next":
            path.unlink()
        return found

    monkeypatch.setattr(Path, "stat", stat)
    assert files.tree_bytes(tmp_path) in (4, 5)


def test_a_file_that_cannot_be_closed_keeps_neither_the_others_nor_the_lock(path, monkeypatch):
    """As on a network disk, which may report a failed write only then."""
    writer = RecordingWriter.create(path, make_spec(codec="none"))
    fill(writer, 40)
    really, closed = ArrayWriter.close, []

    def close(array):
        really(array)
        closed.append(array)
        if len(closed) == 1:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(ArrayWriter, "close", close)
    with pytest.raises(DataError, match="the disk failed while closing files"):
        writer.close()
    assert len(closed) == 12
    with files.locked(path, "reading"):
        pass
    writer.close()
