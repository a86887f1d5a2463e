"""What of a recording is never deleted, never written through, and rebuilt where its root is lost."""

from __future__ import annotations

import errno
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
import zarr
from store_helpers import Truth, check_rows, fill, make_spec

import acquire
from acquire.errors import AcquireError, DataError
from acquire.lines import ARMS
from acquire.store import RecordingWriter, Retention, RunCondition, hold, open_recording, recover, verify
from acquire.store.files import DISK
from acquire.store.rebuild import DAMAGED_ROOT
from acquire.store.removal import COPY, Dropped, Unborn, remove, shard_files

SPEC = make_spec(codec="none")
SHARD = 64


@pytest.fixture
def path(tmp_path):
    return tmp_path / "r.zarr"


def leave_open(path, lines=150, spec=SPEC):
    """What a killed writer leaves: committed lines, and some behind them."""
    with RecordingWriter.create(path, spec) as writer:
        fill(writer, lines)
        writer.commit()
        fill(writer, 40)
        return writer.committed_lines


def snapshot(path):
    return {file: (file.lstat().st_ino, file.read_bytes()) for file in path.rglob("*") if file.is_file()}


def test_nothing_is_deleted_without_its_proof(path):
    leave_open(path)
    before = snapshot(path)
    for proof in (Unborn(0), Unborn(7), Dropped(0, []), Dropped(1, [range(1)])):
        with pytest.raises(DataError, match=r"not removed|not deleted"):
            remove(DISK, path, proof)
    assert snapshot(path) == before
    remove(DISK, path, Dropped(1, [range(2)]))
    assert (shard_files(path, 1), len(shard_files(path, 0))) == ([], 12)


def test_a_directory_that_holds_no_line_is_removed_by_the_same_proof(path):
    RecordingWriter.prepare(path, SPEC).close()
    with pytest.raises(DataError, match="5 lines of it were committed"):
        remove(DISK, path, Unborn(5))
    remove(DISK, path, Unborn(0))
    assert not path.exists()


def test_what_cannot_be_listed_now_is_not_removed(path, monkeypatch):
    """No descriptor is left: it counted as an empty directory."""
    leave_open(path)
    before, really = snapshot(path), os.scandir

    def fails(place="."):
        if Path(place).name in ARMS:
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
        return really(place)

    with monkeypatch.context() as trouble:
        trouble.setattr(os, "scandir", fails)
        trouble.setattr("acquire.store.removal.refuse_links", lambda _: None)  # it had a descriptor
        with pytest.raises(DataError, match="what it holds cannot be listed: Too many open files"):
            remove(DISK, path, Unborn(0))
    assert snapshot(path) == before


def test_trees_are_deleted_in_one_place_only():
    """Whoever adds another has to think of the proof."""
    package = Path(acquire.__file__).parent
    found = {
        str(file.relative_to(package))
        for layer in ("store", "daemon", "stream")
        for file in (package / layer).rglob("*.py")
        if re.search(r"remove_tree\(|rmtree\(", file.read_text())
    }
    assert found == {
        "store/files.py",  # where it is defined
        "store/removal.py",
        "store/retention.py",  # the files of `hold`, which hold no lines
        "store/delivery.py",  # videos that were never delivered
        "store/swap.py",  # calibrations that were replaced, which hold no lines
    }


@pytest.mark.parametrize("root", [None, b"", b"{", b"[]", b'{"attributes": []}', b"[" * 100_000])
def test_a_root_that_is_lost_is_rebuilt(path, root):
    committed = leave_open(path)
    before = open_recording(path).attrs
    (path / "zarr.json").unlink()
    if root is not None:
        (path / "zarr.json").write_bytes(root)
    done = recover(path)
    assert (done.changed, done.root_rebuilt, done.lines) == (True, True, 176)
    assert done.lines >= committed
    after = open_recording(path).attrs
    for key in ("run_id", "first_line", "geometry", "code", "clock", "cameras", "trigger", "config"):
        assert after[key] == before[key]
    check_rows(zarr.open_group(path, mode="r"), SPEC, 176)
    assert verify(path).intact
    assert not recover(path).changed
    assert (path / DAMAGED_ROOT).exists() == (root is not None)


def test_the_root_of_a_sealed_recording_is_rebuilt_as_it_was(path):
    with RecordingWriter.create(path, SPEC) as writer:
        fill(writer, 150)
        writer.add_event("mark", 5, 1010, "grün")
        writer.seal(RunCondition.GOOD, "done", {"a": {"stored": 150, "missing": {}}})
    before = (path / "zarr.json").read_bytes()
    (path / "zarr.json").unlink()
    assert recover(path).root_rebuilt
    assert (path / "zarr.json").read_bytes() == before


@pytest.mark.parametrize("rows", [0, 1e999])
def test_a_root_is_not_rebuilt_from_arrays_that_cannot_be(path, rows):
    leave_open(path)
    (path / "zarr.json").unlink()
    for arm in ARMS:
        file = path / arm / "lines" / "zarr.json"
        document = json.loads(file.read_bytes())
        document["codecs"][0]["configuration"]["chunk_shape"][0] = rows
        file.write_text(json.dumps(document).replace("Infinity", "1e999"))
    with pytest.raises(DataError, match=r"its root zarr\.json is lost, and its arrays are damaged"):
        recover(path)


@pytest.mark.parametrize("lost", ["a/zarr.json", "b/lines/zarr.json", "a/tick/zarr.json", "events/zarr.json"])
def test_other_metadata_may_be_lost_as_well(path, lost):
    """Arrays are alike in both arms, so that one may speak for the other."""
    leave_open(path)
    for name in ("zarr.json", lost):
        (path / name).unlink()
    assert recover(path).lines == 176
    check_rows(zarr.open_group(path, mode="r"), SPEC, 176)


def test_what_retention_dropped_is_known_without_the_root(path):
    spec = make_spec(codec="none", retention=Retention(max_age_lines=2 * SHARD, margin_lines=16))
    with RecordingWriter.create(path, spec) as writer:
        for _ in range(12):
            fill(writer, 32)
            writer.commit()
    before = open_recording(path).dropped
    (path / "zarr.json").unlink()
    recover(path)
    assert before == open_recording(path).dropped == ((1000, 4 * SHARD),)
    assert verify(path).intact


def test_where_too_much_is_lost_it_is_said_and_nothing_is_touched(path):
    """Recordings of versions that kept no copy of their attributes."""
    leave_open(path)
    for name in ("zarr.json", f"a/lines/{COPY}"):
        (path / name).unlink()
    before = snapshot(path)
    with pytest.raises(DataError, match=r"root zarr.json is lost, and with it run_id, first_line, geometry"):
        recover(path)
    assert snapshot(path) == before


@pytest.mark.parametrize(
    "place",
    [
        *("a/lines/.next", "a/lines/c/1/0", "b/flags/c/1", "a/lines/.holds", "zarr.json", "gaps", "b/tick"),
        *("a/lines/.reserve", f"a/lines/{COPY}", "a/lines/c/9", "deep"),
    ],
)
def test_recover_and_hold_follow_no_link(path, tmp_path, place):
    """To a file or a directory, wherever in the recording it is."""
    leave_open(path)
    target = tmp_path / "elsewhere"
    link = path / place
    if link.exists():
        link.rename(target)
    elif "." in link.name and "holds" not in link.name:
        target.write_bytes(b"precious")
    else:
        target.mkdir()
    link.symlink_to(target)
    before = snapshot(tmp_path)
    with pytest.raises(DataError, match=f"holds a link, not touched: {place}"):
        recover(path)
    if place in ("a/lines/.holds", "a/lines"):
        with pytest.raises(DataError, match="holds a link, not touched"):
            hold(path, 1000, 5)
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize("kind", ["pipe", "socket"])
def test_what_is_neither_file_nor_directory_is_refused_too(path, kind):
    leave_open(path)
    if kind == "pipe":
        os.mkfifo(path / "a" / "odd")
    else:
        os.mknod(path / "a" / "odd", 0o140600)
    for attempt in (recover, verify):
        with pytest.raises(DataError, match=f"holds a {kind}, not touched: a/odd"):
            attempt(path)


def test_a_recording_that_is_a_link_is_refused(path, tmp_path):
    leave_open(path)
    link = tmp_path / "link.zarr"
    link.symlink_to(path)
    for attempt in (recover, verify):
        with pytest.raises(DataError, match="is a link, not touched"):
            attempt(link)
    assert open_recording(link).lines == open_recording(path).lines, "a reader follows it"


@pytest.mark.parametrize("how", ["hard link", "read-only"])
def test_files_that_are_somebody_elses_copy_are_not_written_to(path, tmp_path, how):
    """A backup of hard links, the objects of git-annex: their bytes stay, and nothing is called mended."""
    leave_open(path)
    shard = path / "a" / "lines" / "c" / "1" / "0"
    with shard.open("r+b") as file:
        file.seek(16)
        file.write(b"torn")
    before = shard.read_bytes()
    if how == "hard link":
        os.link(shard, tmp_path / "backup")
    else:
        shard.chmod(0o444)
    with pytest.raises(AcquireError, match="is not changed"):
        recover(path)
    assert shard.read_bytes() == before
    assert open_recording(path).state == "recording"


def test_new_metadata_never_lands_in_a_file_that_has_another_name(path, tmp_path):
    """What a writer that was killed left is unlinked, not written over."""
    leave_open(path)
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious")
    os.link(victim, path / "a" / "lines" / ".next")
    recover(path)
    assert victim.read_bytes() == b"precious"
    assert verify(path).intact


def test_retention_deletes_nothing_through_a_link(path, tmp_path):
    """Somebody has put an array elsewhere: its files stay, count as kept, and the recording goes on."""
    spec = make_spec(codec="none", retention=Retention(max_age_lines=2 * SHARD, margin_lines=16))
    with RecordingWriter.create(path, spec) as writer:
        fill(writer, SHARD)
        writer.commit()
        moved = tmp_path / "moved"
        (path / "a" / "tick").rename(moved)
        (path / "a" / "tick").symlink_to(moved)
        for _ in range(6):
            fill(writer, SHARD)
            writer.commit()
        writer.seal(RunCondition.GOOD, "done", {})
    recording = open_recording(path)
    assert recording.dropped == ()
    assert len(list((moved / "c").iterdir())) == 7
    np.testing.assert_array_equal(recording.cut(1000, 50).lines[0], Truth(spec).block("a", 1000, 50).pixels)
