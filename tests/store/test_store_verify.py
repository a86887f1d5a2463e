"""What `verify` finds wrong and `recover` makes of it: nothing is cut off, the lost is flagged and listed."""

from __future__ import annotations

import errno
import json
import os
import shutil
import time
from dataclasses import replace

import numpy as np
import pytest
import zarr
from store_helpers import Truth, check_rows, fill, make_spec
from typer.testing import CliRunner

from acquire.cli import app
from acquire.errors import DataError, PlaceError, StateError, StoreError
from acquire.lines import ARMS, LineFlag
from acquire.store import Circumstances, Gap, RecordingWriter, RunCondition, open_recording, recover, verify
from acquire.store.host import has_run_on, is_here
from acquire.store.pages import PAGE
from acquire.store.removal import COPY
from acquire.store.scan import ArmScan
from acquire.store.shape import index_bytes
from acquire.store.source import LocalSource
from acquire.store.table import EVENT_ROWS

SPEC = make_spec(codec="none")
ARRAYS = ("lines", "code_index", "code", "tick", "time", "flags")


@pytest.fixture
def path(tmp_path):
    return tmp_path / "r.zarr"


def write(path, lines=150, lost=range(0), spec=SPEC):
    """A sealed recording of which arm b lacks some lines."""
    truth = Truth(spec)
    with RecordingWriter.create(path, spec) as writer:
        for arm in ARMS:
            block = truth.block(arm, SPEC.first_line, lines)
            gone = np.isin(np.arange(lines), lost) & (arm == "b")
            if gone.any():
                writer.add_gap(arm, SPEC.first_line + lost.start, len(lost), "ring_full")
            writer.append(replace(block, flags=np.where(gone, LineFlag.MISSING, 0).astype(np.uint16)))
        ledger = {"a": {"stored": lines, "missing": {}}}
        ledger["b"] = {"stored": lines - len(lost), "missing": {"ring_full": len(lost)}}
        writer.seal(RunCondition.INCOMPLETE if lost else RunCondition.GOOD, "done", ledger)
    return path


def flip(path, arm, array, chunk, at=5):
    """Another bit in a chunk of an array; shards have four."""
    file = path / arm / array / "c" / str(chunk // 4)
    reader = open_recording(path).arms[arm].reader(array)
    offset, _ = reader.entry(chunk)
    with (file / "0" if array == "lines" else file).open("r+b") as opened:
        opened.seek(offset + at)
        byte = opened.read(1)[0]
        opened.seek(offset + at)
        opened.write(bytes([byte ^ 16]))


def test_a_whole_recording_is_intact(path):
    found = verify(write(path, lost=range(20, 30)))
    assert found.intact
    assert (found.state, found.lines, found.notes) == ("sealed", 150, ())
    assert json.loads(json.dumps(found.to_dict()))["intact"] is True
    assert not recover(path).changed


@pytest.mark.parametrize("array", ARRAYS)
def test_a_flipped_bit_is_found_and_its_lines_are_flagged(path, array):
    flip(write(path), "b", array, 5)
    found = verify(path)
    (damage,) = found.damage
    assert (damage.arm, damage.array, damage.first_line, damage.count) == ("b", array, 1080, 16)
    assert damage.what == "the checksum is wrong"
    assert not found.intact
    recovered = recover(path)
    assert recovered.changed
    assert (recovered.lines, recovered.damage) == (150, (damage,))
    assert open_recording(path).gaps == (Gap("b", 1080, 16, "damaged"),)
    flags = zarr.open_group(path, mode="r")["b/flags"][:]
    assert np.flatnonzero(flags & LineFlag.MISSING).tolist() == list(range(80, 96))
    attrs = open_recording(path).attrs
    assert (attrs["state"], attrs["run_condition"]) == ("sealed", "INCOMPLETE")
    assert attrs["ledger"]["b"] == {"stored": 134, "missing": {"ring_full": 0, "damaged": 16}}
    assert verify(path).contradictions == ()
    again = recover(path)
    assert (again.changed, again.lines) == (False, 150)


@pytest.mark.parametrize("arm", ["a", "b"])
def test_an_arm_that_is_gone_is_flagged_as_missing(path, arm):
    """Recovery flagged its lines, failed then for want of a directory, and the damage no longer showed."""
    shutil.rmtree(write(path) / arm)
    recovered = recover(path)
    assert {damage.array for damage in recovered.damage} == set(ARRAYS)
    assert open_recording(path).gaps == (Gap(arm, 1000, 150, "damaged"),)
    assert open_recording(path).attrs["run_condition"] == "INCOMPLETE"
    assert not recover(path).changed
    flags = zarr.open_group(path, mode="r")[f"{arm}/flags"][:]
    assert (flags & LineFlag.MISSING).all()
    # It said DAMAGED for ever, although the recording states its loss.
    found = verify(path)
    assert (found.intact, found.damage, found.contradictions) == (True, (), ())
    assert {damage.array for damage in found.recovered} == set(ARRAYS) - {"flags"}
    result = CliRunner().invoke(app, ["verify", str(path)])
    assert (result.exit_code, "recovered; sealed, 150 lines" in result.output) == (0, True)
    assert f"lost, flagged as missing: {arm}/lines: lines 1000 to 1149" in " ".join(result.output.split())


def test_lines_that_are_lost_after_a_recovery_are_damage_again(path):
    flip(write(path), "b", "lines", 5)
    recover(path)
    flip(path, "b", "lines", 2)
    found = verify(path)
    assert [damage.first_line for damage in found.damage] == [1032]
    assert [damage.first_line for damage in found.recovered] == [1080]
    assert not found.intact
    assert json.loads(json.dumps(found.to_dict()))["recovered"][0]["first_line"] == 1080


@pytest.mark.parametrize("array", ARRAYS)
@pytest.mark.parametrize("arm", ["a", "b"])
def test_what_a_recovery_has_flagged_is_masked_in_a_cut(path, arm, array):
    """A cut refused the range still, with the advice to recover the recording."""
    whole = open_recording(write(path)).cut(1070, 40)
    flip(path, arm, array, 5)  # lines 1080 to 1095
    recover(path)
    segment = open_recording(path).cut(1070, 40)
    lost = np.zeros(whole.mask.shape, bool)
    lost["ab".index(arm), 10:26] = True
    np.testing.assert_array_equal(segment.mask, whole.mask & ~lost)
    np.testing.assert_array_equal(segment.lines[~lost], whole.lines[~lost])
    np.testing.assert_array_equal(segment.time_ns, whole.time_ns)
    assert not open_recording(path).whole_lines(1070, 40)[1][lost].any()


def test_times_of_lines_that_both_arms_have_lost_are_by_the_clock(path):
    whole = open_recording(write(path)).cut(1070, 40)
    for arm in ARMS:
        flip(path, arm, "time", 5)
    recover(path)
    segment = open_recording(path).cut(1070, 40)
    np.testing.assert_array_equal(segment.time_ns, whole.time_ns)
    assert not segment.mask[:, 10:26].any()


@pytest.mark.parametrize(
    ("array", "chunk", "rows"),
    [("lines", 5, range(80, 96)), ("lines", 9, range(144, 150)), ("tick", 2, range(64, 96))],
)
def test_damage_costs_the_lines_of_its_chunk_only(path, array, chunk, rows):
    """Chunks of tags are longer here than those of pixels, and have fewer to a file."""
    write(path, spec=replace(SPEC, shard_chunks=8, tag_chunks=2))
    offset, _ = open_recording(path).arms["b"].reader(array).entry(chunk)
    file = path / "b" / array / "c" / str(rows.start // 128)
    with (file / "0" if array == "lines" else file).open("r+b") as opened:
        opened.seek(offset + 5)
        byte = opened.read(1)[0]
        opened.seek(offset + 5)
        opened.write(bytes([byte ^ 16]))
    (damage,) = verify(path).damage
    assert (damage.array, damage.first_line, damage.count) == (array, 1000 + rows.start, len(rows))
    assert recover(path).changed
    assert open_recording(path).gaps == (Gap("b", 1000 + rows.start, len(rows), "damaged"),)
    flags = zarr.open_group(path, mode="r")["b/flags"][:]
    assert np.flatnonzero(flags & LineFlag.MISSING).tolist() == list(rows)
    assert verify(path).contradictions == ()
    assert not recover(path).changed


def test_of_a_chunk_of_tags_the_lines_are_added_that_have_pixels(path):
    """A writer that was killed between the two; whole chunks of tags are what a commit can list."""
    writer = RecordingWriter.create(path, replace(SPEC, shard_chunks=8, tag_chunks=4))
    fill(writer, 150, block_lines=8)
    assert writer.committed_lines == 0
    writer.commit()
    assert writer.committed_lines == 128
    fill(writer, 42, block_lines=42)
    writer.close()
    with (path / open_recording(path).arms["b"].reader("lines").file(10)).open("r+b") as opened:
        opened.truncate(PAGE + 2 * PAGE + 100)  # the third chunk of its file
    recovered = recover(path)
    assert (recovered.lines_before, recovered.lines) == (128, 160)
    check_rows(zarr.open_group(path, mode="r"), SPEC, 160)
    assert verify(path).intact


def test_a_lost_file_is_found(path):
    write(path, lost=range(66, 70))
    (path / "b" / "tick" / "c" / "1").unlink()
    (damage,) = verify(path).damage
    assert (damage.array, damage.first_line, damage.count) == ("tick", 1064, 64)
    assert damage.what == "it is not on disk"
    recover(path)
    gaps = open_recording(path).gaps
    assert [(gap.first_line, gap.count, gap.cause) for gap in gaps] == [
        (1066, 4, "ring_full"),
        (1064, 2, "damaged"),
        (1070, 58, "damaged"),
    ]
    assert verify(path).contradictions == ()


def test_a_file_that_was_cut_short_is_found(path):
    write(path)
    file = path / "a" / "lines" / "c" / "2" / "0"
    with file.open("r+b") as opened:
        opened.truncate(PAGE + 40)
    torn, gone = verify(path).damage
    assert (torn.first_line, torn.count, torn.what) == (1128, 16, "220 of 260 bytes are not there")
    assert (gone.first_line, gone.count, gone.what) == (1144, 6, "260 of 260 bytes are not there")


def test_lost_flags_are_missing_lines_to_every_reader(path):
    """Where there is no file, plain Zarr gives the fill value: of flags that is `missing`."""
    write(path)
    (path / "a" / "flags" / "c" / "0").unlink()
    flags = zarr.open_group(path, mode="r")["a/flags"][:]
    assert (flags[:64] == LineFlag.MISSING).all()
    assert verify(path).damage[0].array == "flags"


def test_a_torn_index_is_mended(path):
    write(path)
    file = path / "a" / "lines" / "c" / "1" / "0"
    with file.open("r+b") as opened:
        opened.seek(16 * 4)
        opened.write(b"torn")
    assert "index" in verify(path).damage[0].what
    recovered = recover(path)
    assert (recovered.indices_mended, recovered.damage) == (1, ())
    assert verify(path).intact
    root = zarr.open_group(path, mode="r")
    np.testing.assert_array_equal(root["a/lines"][:], Truth(SPEC).block("a", 1000, 150).pixels)


def edit_root(path, change):
    document = json.loads((path / "zarr.json").read_bytes())
    change(document)
    (path / "zarr.json").write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d["attributes"]["ledger"]["a"].update(stored=149), "does not balance"),
        (lambda d: d["attributes"]["ledger"]["b"].update(stored=150, missing={}), "gaps list 10"),
        (lambda d: d["attributes"]["geometry"].update(substeps=4), "code index"),
        (lambda d: d["attributes"].update(first_line=900), "code index"),
        (lambda d: d["consolidated_metadata"]["metadata"]["a/time"].update(shape=[144]), "differs"),
        (lambda d: d["consolidated_metadata"]["metadata"]["a/time"].update(shape=[144]), "arrays of"),
    ],
)
def test_what_is_said_twice_and_differs_is_found(path, change, words):
    write(path, lost=range(20, 30))
    edit_root(path, change)
    found = verify(path)
    assert not found.intact
    assert any(words in contradiction for contradiction in found.contradictions), found


def test_flags_that_gaps_do_not_list_are_found(path):
    write(path, lost=range(20, 30))
    file = path / "gaps" / "count" / "c" / "0"
    file.write_bytes(b"\0" * len(file.read_bytes()))
    assert any("gaps/count cannot be read" in words for words in verify(path).contradictions)


def test_a_recording_that_is_being_written_is_left_alone(path):
    with RecordingWriter.create(path, SPEC) as writer:
        fill(writer, 40)
        writer.commit()
        with pytest.raises(StateError, match="another process is writing it"):
            recover(path)
        found = verify(path)
        assert found.intact
        assert "not sealed" in found.notes[0]
        writer.seal(RunCondition.GOOD, "done", {})
    assert not recover(path).changed


def test_what_a_commit_did_not_list_is_added(path):
    writer = RecordingWriter.create(path, SPEC)
    fill(writer, 40)
    writer.commit()
    writer.add_gap("a", 1040, 3, "ring_full")
    fill(writer, 45)
    writer.close()
    recovered = recover(path)
    assert (recovered.lines_before, recovered.lines, recovered.changed) == (32, 80, True)
    recording = open_recording(path)
    check_rows(zarr.open_group(path, mode="r"), SPEC, 80)
    assert recording.attrs["run_condition"] == "INTERRUPTED"
    assert "recovered" in recording.attrs["end_reason"]
    assert recording.attrs["ledger"]["a"] == {"stored": 80, "missing": {}, "balanced": True}
    assert recording.events[-1].kind == "recovered"
    assert [file.name for file in path.rglob(".*")] == [COPY]
    assert verify(path).intact


def test_events_that_found_no_room_are_counted_after_a_recovery_as_well(path):
    writer = RecordingWriter.create(path, SPEC)
    for number in range(EVENT_ROWS + 3):
        writer.add_event("mark", number, 1000, "x")
    fill(writer, 40)
    writer.commit()
    writer.close()
    recover(path)
    events = zarr.open_group(path, mode="r")["events"]
    assert (events["kind"].shape, events.attrs["not_listed"]) == ((EVENT_ROWS,), 4)  # and its own


def test_what_is_not_a_recording_cannot_be_verified_or_recovered(tmp_path):
    for attempt in (verify, recover):
        with pytest.raises(PlaceError, match="does not exist"):
            attempt(tmp_path / "no.zarr")


def test_where_the_machine_ran_on_only_what_came_after_the_commit_is_looked_at(path):
    """Lines that were on disk and not committed are found either way, damage of committed ones by looking."""
    with RecordingWriter.create(path, SPEC) as writer:
        fill(writer, 100)
        writer.commit()
        fill(writer, 50)
    flip(path, "b", "lines", 2)
    looked = []
    known = Circumstances("its machine ran on", committed_intact=True)
    quick = recover(path, progress=lambda *done: looked.append(done), known=known)
    assert (quick.changed, quick.lines_before, quick.lines, quick.damage) == (True, 96, 144, ())
    assert looked == []
    recording = open_recording(path)
    assert (recording.state, recording.attrs["end_reason"]) == ("sealed", "its machine ran on")
    again = recover(path)
    assert [(damage.first_line, damage.count) for damage in again.damage] == [(1032, 16)]


def test_where_nothing_tells_whether_somebody_writes_it_is_left(path, monkeypatch):
    def no_locks(fd, how):
        raise OSError(errno.ENOLCK, "no locks")

    with RecordingWriter.create(path, SPEC) as writer:
        fill(writer, 100)
        writer.commit()
    monkeypatch.setattr("fcntl.flock", no_locks)
    with pytest.raises(StateError, match="no locks, which would show"):
        recover(path, known=Circumstances(alone=False))
    assert open_recording(path).state == "recording"
    assert recover(path).lines == 96


def test_a_recording_says_which_machine_wrote_it(path):
    attributes = open_recording(write(path)).attrs
    assert is_here(attributes)
    assert has_run_on(attributes) == bool(attributes["host"]["boot_id"])
    elsewhere = {"host": {**attributes["host"], "name": "far"}}
    assert not is_here(elsewhere)
    assert not has_run_on(elsewhere)
    assert not has_run_on({"host": {**attributes["host"], "boot_id": "before"}})
    assert not is_here({})


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENOMEM, errno.EACCES, errno.ETIMEDOUT])
@pytest.mark.parametrize("torn", [False, True])
def test_what_cannot_be_read_now_is_neither_damaged_nor_masked(path, monkeypatch, number, torn):
    """No descriptor is left, or a share does not answer: the lines are there, and a recovery is repeated."""
    with RecordingWriter.create(path, SPEC) as writer:
        fill(writer, 230)
        writer.commit()
    if torn:  # the checksum of the index, so that each chunk is looked at
        file = path / "b" / "lines" / "c" / "1" / "0"
        data = bytearray(file.read_bytes())
        data[index_bytes(4) - 1] ^= 1
        file.write_bytes(data)
    really, before = LocalSource.read_range, (path / "zarr.json").read_bytes()

    def fails(self, key, start, size):
        if key == "b/lines/c/1/0" and start:
            raise OSError(number, os.strerror(number))
        return really(self, key, start, size)

    kind = PlaceError if number == errno.EACCES else StoreError
    with monkeypatch.context() as trouble:
        trouble.setattr(LocalSource, "read_range", fails)
        for attempt in (lambda: recover(path), *([] if torn else [lambda: verify(path)])):
            with pytest.raises(kind, match=os.strerror(number)):
                attempt()
        if not torn:
            with pytest.raises(kind, match="b/lines cannot be read"):
                open_recording(path).cut(1064, 5)
    assert (path / "zarr.json").read_bytes() == before
    assert recover(path).damage == ()
    check_rows(zarr.open_group(path, mode="r"), SPEC, 224)


def test_tables_that_cannot_be_read_now_are_not_damaged(path, monkeypatch):
    write(path, lost=range(20, 30))
    recording, really = open_recording(path), LocalSource.read

    def fails(self, key):
        if key.startswith("gaps/"):
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
        return really(self, key)

    monkeypatch.setattr(LocalSource, "read", fails)
    for attempt in (lambda: recording.gaps, lambda: verify(path)):
        with pytest.raises(StoreError, match=r"gaps/.* cannot be read: Too many open files"):
            attempt()


def test_a_medium_that_cannot_be_read_is_damage(path, monkeypatch):
    write(path)
    really = LocalSource.read_range

    def fails(self, key, start, size):
        if key == "b/lines/c/1/0" and start:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return really(self, key, start, size)

    monkeypatch.setattr(LocalSource, "read_range", fails)
    assert {found.arm for found in verify(path).damage} == {"b"}
    with pytest.raises(DataError, match="cannot be read"):
        open_recording(path).cut(1064, 5)


def test_a_disk_that_has_lost_most_of_a_long_recording_is_listed_in_a_moment(path):
    """A day at 100 kHz has two million chunks in each array, which took ten minutes to join."""
    stream = open_recording(write(path)).arms["a"]
    size = stream.reader("lines").shape.chunk_rows
    troubles = {chunk: "gone" if chunk % 3 else "damaged" for chunk in range(300_000)}
    begun_s = time.process_time()
    found = list(ArmScan(stream, {"lines": troubles}).damages(300_000 * size - 1))
    assert time.process_time() - begun_s < 10
    assert [(one.first_line - SPEC.first_line, one.count, one.what) for one in (*found[:3], found[-1])] == [
        (0, size, "damaged"),
        (size, 2 * size, "gone"),
        (3 * size, size, "damaged"),
        (299_998 * size, 2 * size - 1, "gone"),
    ]
