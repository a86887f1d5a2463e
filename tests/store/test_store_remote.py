"""Recordings at URLs: an S3 server on loopback, memory, and the local disk through fsspec."""

from __future__ import annotations

import errno
import os
import random
import subprocess
import sys
import threading
import time
import uuid
import zipfile

import fsspec
import numpy as np
import pytest
import zarr
from store_helpers import Truth, check_rows, fill, make_spec

from acquire.errors import DataError, PlaceError, StateError, StoreError, UsageError
from acquire.store import (
    Continuation,
    RecordingWriter,
    Retention,
    RunCondition,
    format_of,
    mirror,
    open_recording,
    recover,
    verify,
)
from acquire.store.mirroring import Mirror, only_copy
from acquire.store.refusals import refusal
from acquire.store.remote import PATIENCE, PROOF, RemoteSource, be_patient

SPEC = make_spec()
SHARD = 64


pytestmark = pytest.mark.usefixtures("bucket")


@pytest.fixture(params=["s3", "memory"])
def place(request, bucket):
    """A URL at which a recording can be."""
    where = bucket if request.param == "s3" else "memory:/"
    return f"{where}/{uuid.uuid4()}/run.zarr"


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.zarr"


def write(path, lines=150, spec=SPEC):
    with RecordingWriter.create(path, spec) as writer:
        fill(writer, lines)
        writer.add_gap("a", 1010, 1, "test")
        writer.add_event("mark", 5, 1010, "grün")
        writer.seal(RunCondition.GOOD, "done", {"a": {"stored": lines - 1, "missing": {"test": 1}}})
    return path


def test_a_recording_is_the_same_far_away(path, place):
    here = open_recording(write(path))
    done = mirror(path, place)
    assert (done.lines, done.sealed, done.shards) == (150, True, 3)
    there = open_recording(place)
    assert (there.lines, there.gaps, there.events) == (150, here.gaps, here.events)
    for start, lines in ((1000, 150), (1060, 20)):
        near, far = here.cut(start, lines), there.cut(start, lines)
        for name in ("lines", "mask", "code", "time_ns"):
            np.testing.assert_array_equal(getattr(near, name), getattr(far, name))
    check_rows(zarr.open_group(there.source.zarr_store(), mode="r"), SPEC, 150)
    assert there.info()["path"] == place
    assert there.info()["bytes"] == done.bytes
    assert verify(place).damage == ()
    assert format_of(place) == "acquire-recording/2"
    again = mirror(path, place)
    assert (again.shards, again.lines) == (0, 150)


def test_any_file_system_will_do(path, tmp_path):
    place = f"file://{tmp_path}/far/run.zarr"
    mirror(write(path), place)
    check_rows(zarr.open_group(tmp_path / "far" / "run.zarr", mode="r"), SPEC, 150)
    assert verify(place).damage == verify(tmp_path / "far" / "run.zarr").damage == ()


def test_damage_in_a_remote_store_is_found_and_refused(path, place):
    write(path)
    mirror(path, place)
    target = RemoteSource(place)
    data = bytearray(target.read("b/lines/c/1/0"))
    data[4096 + 20] ^= 1
    target.put("b/lines/c/1/0", bytes(data))
    (damage,) = verify(place).damage
    assert (damage.arm, damage.first_line, damage.count) == ("b", 1064, 16)
    with pytest.raises(DataError, match="checksum"):
        open_recording(place).cut(1064, 5)


def test_a_growing_recording_is_followed_to_its_end(path, place):
    with RecordingWriter.create(path, SPEC) as writer:
        fill(writer, 100)
        writer.commit()
        copying = Mirror(path, place)
        done = copying.step()
        assert (done.lines, done.sealed) == (SHARD, False)
        assert open_recording(place).lines == SHARD
        assert open_recording(place).state == "recording"
        fill(writer, 100)
        writer.commit()
        assert copying.step().lines == 3 * SHARD
        np.testing.assert_array_equal(
            open_recording(place).cut(1060, 100).lines[0], Truth(SPEC).block("a", 1060, 100).pixels
        )
        seen = []
        follower = threading.Thread(target=lambda: seen.append(mirror(path, place, follow=True)))
        follower.start()
        fill(writer, 30)
        writer.seal(RunCondition.GOOD, "done", {})
    follower.join(300)
    assert (seen[0].lines, seen[0].sealed) == (230, True)
    assert verify(place).intact


def test_the_spool_is_bounded_and_no_line_is_lost(path):
    """Retention deletes here what is there; a copy that lags behind is waited for."""
    place = f"memory://{uuid.uuid4()}/run.zarr"
    spec = make_spec(retention=Retention(max_age_lines=SHARD, margin_lines=1))
    with RecordingWriter.create(path, spec) as writer:
        copying = Mirror(path, place)
        copying.step()
        for _ in range(6):
            fill(writer, 2 * SHARD, block_lines=32)
            writer.commit()
        assert open_recording(path).dropped == ()
        copying.step()
        fill(writer, 2 * SHARD, block_lines=32)
        writer.commit()
        assert open_recording(path).dropped[0][1] >= 10 * SHARD
        writer.seal(RunCondition.GOOD, "done", {})
    copying.step()
    assert open_recording(place).dropped == ()
    check_rows(zarr.open_group(RemoteSource(place).zarr_store(), mode="r"), spec, 14 * SHARD)


def test_nothing_goes_before_its_copy_has_begun(path):
    """The rig copies its recordings: the writer waits for whoever will do it."""
    target = f"memory://{uuid.uuid4()}"
    spec = make_spec(retention=Retention(max_age_lines=SHARD, margin_lines=1, copied_to=target))
    with RecordingWriter.create(path, spec) as writer:
        for _ in range(3):
            fill(writer, 2 * SHARD, block_lines=32)
            writer.commit()
            Mirror(path, f"memory://{uuid.uuid4()}/run.zarr").step()  # to another place
        assert open_recording(path).dropped == ()
        copying = Mirror(path, f"{target}/run.zarr")
        assert copying.step(most_shards=2).waiting_lines == 4 * SHARD
        for _ in range(2):
            fill(writer, 32, block_lines=32)
            writer.commit()
        assert open_recording(path).dropped == ((spec.first_line, SHARD),)  # the margin is kept


def test_a_copy_in_small_steps_is_one_recording_at_any_time(path):
    place = f"memory://{uuid.uuid4()}/run.zarr"
    with RecordingWriter.create(path, SPEC) as writer:
        fill(writer, 200)
        writer.commit()
        copying = Mirror(path, place)
        assert [copying.step(most_shards=1).lines for _ in range(2)] == [SHARD, 2 * SHARD]
        check_rows(zarr.open_group(RemoteSource(place).zarr_store(), mode="r"), SPEC, 2 * SHARD)
        fill(writer, 130)
        writer.seal(RunCondition.GOOD, "done", {})
    seen = [copying.step(most_shards=2) for _ in range(2)]
    assert [(done.lines, done.waiting_lines, done.sealed) for done in seen] == [
        (4 * SHARD, 330 - 4 * SHARD, False),
        (330, 0, True),
    ]
    assert verify(place).intact


def test_what_recovery_mended_after_it_was_copied_is_copied_again(path, place):
    with RecordingWriter.create(path, SPEC) as writer:
        fill(writer, 230)
        writer.commit()
        copying = Mirror(path, place)
        assert copying.step().lines == 3 * SHARD
    file = path / "b" / "lines" / "c" / "1" / "0"
    data = bytearray(file.read_bytes())
    data[4096 + 20] ^= 1
    file.write_bytes(data)
    assert [found.first_line for found in recover(path).damage] == [1064]
    assert copying.step().sealed
    there = open_recording(place)
    assert there.gaps == open_recording(path).gaps
    assert there.source.read("b/flags/c/1") == (path / "b" / "flags" / "c" / "1").read_bytes()
    assert verify(place).contradictions == ()


def test_one_process_copies_a_recording(path, tmp_path):
    place = f"file://{tmp_path}/far.zarr"
    write(path)
    with only_copy(path), pytest.raises(StateError, match="another process"):
        mirror(path, place)
    assert mirror(path, place).sealed
    with pytest.raises(PlaceError, match="does not exist"):
        mirror(tmp_path / "none.zarr", place)


def test_another_recording_is_not_written_over(path, tmp_path):
    place = f"memory://{uuid.uuid4()}/run.zarr"
    copying = Mirror(write(path), place)
    copying.step()
    other = write(tmp_path / "other.zarr", spec=make_spec(run_id="run-2"))
    with pytest.raises(UsageError, match="another recording: run run-1"):
        mirror(other, place)
    path.rename(tmp_path / "moved.zarr")
    other.rename(path)
    with pytest.raises(DataError, match="no longer the same recording"):
        copying.step()
    RemoteSource(place).put("zarr.json", b"{")
    with pytest.raises(UsageError, match="another recording: run run-1"):
        mirror(path, place)
    assert RemoteSource(place).read("zarr.json") == b"{"


@pytest.mark.parametrize("root", [b"", b"{", None])
def test_a_copy_whose_root_was_torn_goes_on(path, tmp_path, root):
    """As a kill leaves it where a part is not put in one step: not published yet."""
    far = tmp_path / "far.zarr"
    mirror(write(path), f"file://{far}")
    whole = {file: file.stat().st_mtime_ns for file in far.rglob("*") if file.is_file()}
    (far / "zarr.json").unlink()
    if root is not None:
        (far / "zarr.json").write_bytes(root)
    (far / "b" / "lines" / "c" / "1" / "0").write_bytes(b"torn")
    (far / "a" / "lines" / "c" / "1" / ".next").write_bytes(b"left by a kill")
    (far / ".next").write_bytes(b"left by a kill")
    assert mirror(path, f"file://{far}").shards == 1
    check_rows(zarr.open_group(far, mode="r"), SPEC, 150)
    assert verify(far).intact == verify(path).intact
    untouched = far / "b" / "lines" / "c" / "0" / "0"
    assert untouched.stat().st_mtime_ns == whole[untouched]
    other = write(tmp_path / "other.zarr", spec=make_spec(run_id="run-2"))
    (far / "zarr.json").write_bytes(b"")
    with pytest.raises(UsageError, match="another recording: run run-1"):
        mirror(other, f"file://{far}")


def test_what_no_mark_vouches_for_is_copied_anew(path, tmp_path):
    """Versions that left none: files of the right size may be another recording's."""
    far = tmp_path / "far.zarr"
    mirror(write(tmp_path / "other.zarr", spec=make_spec(run_id="other", codec="none")), f"file://{far}")
    (far / "zarr.json").unlink()
    (far / "a" / "lines" / ".copy-of").unlink()
    assert mirror(write(path, spec=make_spec(codec="none")), f"file://{far}").shards == 3
    follows = Continuation("run.zarr", 2, 0, None, "test")
    segment = write(tmp_path / "run-2.zarr", spec=make_spec(continues=follows))
    with pytest.raises(UsageError, match="segment 1"):
        mirror(segment, f"file://{far}")


def test_a_kill_at_any_moment_leaves_whole_parts(path, tmp_path):
    """Readers there meet the old bytes or the new ones; a copy that is cut off, however often, goes on."""
    write(path, lines=1000)
    far = tmp_path / "far.zarr"
    script = f"from pathlib import Path; from acquire.store import mirror; mirror(Path({str(path)!r}), 'file://{far}')"
    moment = random.Random(3)
    for _ in range(4):
        with subprocess.Popen([sys.executable, "-c", script], start_new_session=True) as process:
            shards = moment.randrange(12)
            while process.poll() is None and len(list(far.glob("a/lines/c/*/0"))) < shards:
                time.sleep(0.001)
            process.kill()
        for file in far.rglob("[!.]*"):
            if file.is_file() and file.name != "zarr.json":
                assert file.read_bytes() == (path / file.relative_to(far)).read_bytes()
    assert mirror(path, f"file://{far}").sealed
    assert verify(far).intact == verify(path).intact
    check_rows(zarr.open_group(far, mode="r"), SPEC, 1000)


def test_links_are_refused_on_either_side(path, tmp_path):
    write(path)
    far, precious = tmp_path / "far.zarr", tmp_path / "precious"
    precious.mkdir()
    for place, target in (("b", precious), ("zarr.json", tmp_path / "victim")):
        far.mkdir()
        (far / place).symlink_to(target)
        with pytest.raises(DataError, match=f"holds a link, not touched: {place}"):
            mirror(path, f"file://{far}")
        (far / place).unlink()
        far.rmdir()
    far.symlink_to(precious)
    with pytest.raises(DataError, match="is a link, not touched"):
        mirror(path, f"file://{far}")
    shard = path / "a" / "lines" / "c" / "1" / "0"
    shard.rename(tmp_path / "moved")
    shard.symlink_to(tmp_path / "moved")
    for attempt in (lambda: mirror(path, f"file://{tmp_path}/new.zarr"), lambda: verify(path)):
        with pytest.raises(DataError, match="holds a link, not touched: a/lines/c/1/0"):
            attempt()
    assert open_recording(path).cut(1064, 5).mask.any(), "a reader follows links"
    assert not any(precious.iterdir())
    assert not (tmp_path / "new.zarr").exists()


def test_what_is_not_whole_here_is_not_copied(path, tmp_path):
    """A file cut short, or gone; once its lines are flagged, they are told there as well."""
    write(path)
    with (path / "b" / "lines" / "c" / "1" / "0").open("r+b") as file:
        file.truncate(5000)
    far = tmp_path / "far.zarr"
    with pytest.raises(DataError, match=r"is not copied: b/lines: lines 1080 to 1127: .*cut short"):
        mirror(path, f"file://{far}")
    assert not far.exists()
    recover(path)
    assert mirror(path, f"file://{far}").sealed
    assert open_recording(far).gaps == open_recording(path).gaps


def test_a_recording_is_not_copied_onto_itself(path, tmp_path):
    before = (write(path) / "zarr.json").read_bytes()
    (tmp_path / "link").symlink_to(tmp_path)
    for place in (f"file://{path}", f"file://{tmp_path}/link/run.zarr"):
        with pytest.raises(UsageError, match="the recording itself"):
            mirror(path, place)
    assert (path / "zarr.json").read_bytes() == before


def test_a_writer_that_is_gone_is_reported(path, tmp_path):
    with RecordingWriter.create(path, SPEC) as writer:
        fill(writer, 100)
        writer.commit()
    place = f"file://{tmp_path}/far.zarr"
    with pytest.raises(DataError, match=r"has not grown for 0 s.*64 lines are in"):
        mirror(path, place, follow=True, idle_s=0)
    recover(path)
    assert mirror(path, place).lines == 96


def test_a_slow_store_has_time_unless_somebody_says_how_much(monkeypatch):
    for store in ("AWS", "GOOGLE"):
        monkeypatch.setenv(f"{store}_TIMEOUT", "7s")  # so that it is put back afterwards
        monkeypatch.delenv(f"{store}_TIMEOUT")
    monkeypatch.setenv("AZURE_TIMEOUT", "7s")
    be_patient()
    assert [os.environ[f"{store}_TIMEOUT"] for store in ("AWS", "GOOGLE", "AZURE")] == [
        PATIENCE,
        PATIENCE,
        "7s",
    ]


def test_places_that_cannot_be_reached_are_refused(bucket, path):
    with pytest.raises(PlaceError, match="does not exist"):
        open_recording(f"memory://{uuid.uuid4()}/no.zarr")
    with pytest.raises(UsageError, match="gopher"):
        open_recording("gopher://x/y.zarr")
    with pytest.raises(PlaceError, match="does not exist"):
        open_recording(f"{bucket}/no.zarr")
    with pytest.raises(PlaceError, match="nobucketofthisname"):
        mirror(write(path), "s3://nobucketofthisname/x.zarr")
    with pytest.raises(FileNotFoundError, match="nobucketofthisname"):
        RemoteSource("s3://nobucketofthisname").prove()
    RemoteSource(bucket).prove()
    assert b"acquire" in RemoteSource(bucket).read(PROOF)


def test_errors_of_other_file_systems_are_reported_with_the_address(tmp_path, monkeypatch):
    """zipfile's, ftplib's and aiohttp's are no OSErrors."""
    file = tmp_path / "far.zip"
    place = f"zip://run.zarr::file://{file}"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("run.zarr/zarr.json", b"{}" * 100)
    file.write_bytes(file.read_bytes().replace(b"{}{}", b"{}[]", 1))
    with pytest.raises(StoreError, match=rf"^{place} cannot be read: Bad CRC-32"):
        open_recording(place)
    file.write_bytes(b"no archive")
    with pytest.raises(StoreError, match=rf"^{place} cannot be opened: File is not a zip file"):
        open_recording(place)

    class ClientResponseError(Exception):  # as aiohttp's
        status = 403

    def refuse(*_, **__):
        raise ClientResponseError("Forbidden")

    monkeypatch.setattr(fsspec.get_filesystem_class("memory"), "cat_file", refuse)
    with pytest.raises(PlaceError, match=r"^memory://x.zarr cannot be read: Forbidden; try: the credentials"):
        open_recording("memory://x.zarr")


def test_a_directory_of_this_machine_needs_no_credentials(tmp_path):
    found = refusal(f"file://{tmp_path}", PermissionError(errno.EACCES, "Permission denied"), "written")
    assert "credentials" not in found.hint
    assert "permissions" in found.hint
