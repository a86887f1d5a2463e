"""The daemon's uploads with their real process; the place is a directory, reached as any other URL."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acquire.capacity.load import Load, recording_spec, trigger_run
from acquire.clock import ClockFit
from acquire.config import load_rig
from acquire.daemon.copier import FIRST_WAIT_S, MOST_WAIT_S, Copier, wait_s
from acquire.daemon.messages import UploadStatus
from acquire.daemon.uploads import Uploads, check_upload
from acquire.errors import ConfigError, UsageError
from acquire.lines import ARMS, LineBlock
from acquire.store import Continuation, RecordingWriter, RunCondition, mirror, open_recording, recover
from acquire.store.files import Disk, tree_bytes
from acquire.store.mirroring import only_copy
from acquire.stream.tagger import Tagger

CLOCK = ClockFit(90_000_000, 0, 0)
SHARD_LINES = 16
LOAD = Load(8, "uint16", 1000.0, chunk_lines=SHARD_LINES, shard_chunks=1)
SPEC = recording_spec(LOAD, CLOCK)
WAIT_S = 300.0


class Place:
    """Uploads of a directory to another, as one daemon after the other has them."""

    def __init__(self, home: Path) -> None:
        self.here = home / "here"
        self.far = home / "far"
        self.here.mkdir()
        self._made: list[Uploads] = []

    @property
    def journal(self) -> Path:
        return self.here / ".uploads-rig.json"

    def daemon(self, target: str | None = "") -> Uploads:
        for earlier in self._made:
            earlier.close()
        made = Uploads(f"file://{self.far}" if target == "" else target, self.journal)
        self._made.append(made)
        made.begin()
        return made

    def left(self) -> list[str]:
        """What the journal lists; there is none where nothing is left."""
        if not self.journal.exists():
            return []
        return [Path(path).name for path in json.loads(self.journal.read_bytes())["not_uploaded"]]

    def write(self, name: str, *, sealed: bool = True, run_id: str = "run", **changes: object) -> Path:
        path = self.here / name
        spec = replace(SPEC, run_id=run_id, **changes)  # type: ignore[arg-type]
        with RecordingWriter.create(path, spec) as writer:
            writer.commit()
            if sealed:
                writer.seal(RunCondition.GOOD, "done", {})
        return path

    def close(self) -> None:
        for made in self._made:
            made.close()


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Place]:
    made = Place(tmp_path)
    yield made
    made.close()


def fill(writer: RecordingWriter, lines: int) -> None:
    tagger = Tagger(trigger_run(LOAD), LOAD.stages, CLOCK)
    for arm in ARMS:
        pixels, flags = np.zeros((lines, LOAD.pixels), np.uint16), np.zeros(lines, np.uint16)
        writer.append(tagger.tag(arm, LineBlock(writer.next_line(arm), pixels, flags)))
    writer.commit()


class Box:
    """The copier's end of a pipe at whose other end nobody says anything."""

    def __init__(self) -> None:
        self.posted: list[UploadStatus] = []

    def take(self) -> None:
        return None

    def post(self, message: UploadStatus) -> None:
        self.posted.append(message)


def states(uploads: Uploads) -> dict[str, str]:
    return {one.path.name: one.state for one in uploads.statuses}


def said(uploads: Uploads, name: str) -> UploadStatus:
    return next(one for one in uploads.statuses if one.path.name == name)


def look_until(uploads: Uploads, condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + WAIT_S
    while not condition():
        uploads.poll()
        assert time.monotonic() < deadline, uploads.statuses
        time.sleep(0.01)


def state_of(path: Path) -> object:
    return open_recording(path).state


def test_what_one_daemon_did_not_finish_the_next_does(place: Place) -> None:
    whole, left_open = place.write("whole.zarr"), place.write("open.zarr", sealed=False)
    first = place.daemon("file:///proc/nobody/can/write/here")
    first.renew(whole)
    first.renew(left_open)
    look_until(first, lambda: all(one.error for one in first.statuses))
    assert sorted(place.left()) == ["open.zarr", "whole.zarr"]
    nothing_set = place.daemon(None)
    nothing_set.poll()
    nothing_set.add(whole)
    assert sorted(place.left()) == ["open.zarr", "whole.zarr"]
    second = place.daemon()
    look_until(second, lambda: states(second)["whole.zarr"] == "copied")
    look_until(second, lambda: "not recovered" in said(second, "open.zarr").error)
    assert place.left() == ["open.zarr"]
    recover(left_open)
    second.recovered(left_open)
    look_until(second, lambda: set(states(second).values()) == {"copied"})
    assert state_of(place.far / "open.zarr") == "sealed"
    assert place.left() == []


def test_a_recovered_recording_is_copied_if_its_rig_says_so(place: Place) -> None:
    wanted = place.write("wanted.zarr", config={"recording": {"upload_to": "file:///somewhere"}})
    other = place.write("other.zarr")
    uploads = place.daemon()
    uploads.recovered(other)
    uploads.recovered(wanted)
    uploads.recovered(place.here / "none.zarr")
    look_until(uploads, lambda: states(uploads) == {"wanted.zarr": "copied"})


def test_a_segment_is_listed_there_as_it_is_here(place: Place) -> None:
    first = place.write("x.zarr")
    uploads = place.daemon()
    uploads.add(first)
    look_until(uploads, lambda: states(uploads) == {"x.zarr": "copied"})
    second = place.write("x-2.zarr", continues=Continuation("x.zarr", 2, 0, None, "a break"))
    uploads.add(second)
    look_until(uploads, (place.far / "x-2.zarr" / "zarr.json").exists)
    look_until(uploads, lambda: open_recording(place.far / "x.zarr").attrs.get("segments") == ["x-2.zarr"])
    look_until(uploads, lambda: set(states(uploads).values()) == {"copied"})


def test_uploads_that_cannot_be_are_reported_and_the_others_go_on(place: Place) -> None:
    taken = place.write("taken.zarr")
    mirror(place.write("another.zarr", run_id="another"), f"file://{place.far}/taken.zarr")
    (place.here / "broken.zarr").mkdir()
    (place.here / "broken.zarr" / "zarr.json").write_text("{")
    uploads = place.daemon()
    for path in (place.here / "broken.zarr", taken, place.here / "removed.zarr", place.write("good.zarr")):
        uploads.renew(path)
    expected = {"broken": "waiting", "taken": "refused", "removed": "gone", "good": "copied"}
    look_until(
        uploads, lambda: states(uploads) == {f"{name}.zarr": state for name, state in expected.items()}
    )
    assert "run another" in said(uploads, "taken.zarr").error
    assert "damaged" in said(uploads, "broken.zarr").error
    assert sorted(place.left()) == ["broken.zarr", "taken.zarr"]
    assert uploads.left == 2


def test_two_do_not_copy_the_same(place: Place) -> None:
    path = place.write("x.zarr")
    uploads = place.daemon()
    with only_copy(path):
        uploads.add(path)
        look_until(uploads, lambda: "another process" in uploads.statuses[0].error)
    look_until(uploads, lambda: states(uploads) == {"x.zarr": "copied"})


def test_what_grows_goes_before_what_waits_on_the_disk(place: Place) -> None:
    """Its lines are held until they are copied; those of a sealed recording are in nobody's way."""
    old, new = place.here / "old.zarr", place.here / "new.zarr"
    with RecordingWriter.create(old, SPEC) as writer:
        fill(writer, 3 * SHARD_LINES)
        writer.seal(RunCondition.GOOD, "done", {})
    copier = Copier(box := Box(), f"file://{place.far}")  # type: ignore[arg-type]
    with RecordingWriter.create(new, SPEC) as writer:
        fill(writer, 2 * SHARD_LINES)
        for path in (old, new):
            copier.add(path, ours=True)
        while not any(one.state == "copied" for one in box.posted):
            copier.turn()
    assert [(one.path.stem, one.lines // SHARD_LINES, one.state) for one in box.posted] == [
        ("old", 1, "copying"),
        ("new", 1, "copying"),
        ("new", 2, "copying"),
        ("old", 2, "copying"),
        ("old", 3, "copied"),
    ]


def test_a_process_that_is_killed_is_replaced(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    uploads = place.daemon()
    uploads.prove()
    assert uploads.warning is None
    assert uploads._worker is not None
    assert uploads._worker.pid is not None
    os.kill(uploads._worker.pid, signal.SIGKILL)
    uploads.add(place.write("x.zarr"))
    look_until(uploads, lambda: states(uploads) == {"x.zarr": "copied"})
    assert "killed by SIGKILL; it is replaced" in caplog.text


def test_without_a_place_nothing_is_remembered(place: Place) -> None:
    """Of every recording of a daemon that copies none, one more path was kept, for as long as it lived."""
    uploads = place.daemon(None)
    path = place.here / "run.zarr"
    before = sys.getrefcount(path)
    uploads.add(path)
    assert sys.getrefcount(path) == before
    assert (uploads.left, uploads.statuses) == (0, [])


def test_waits_grow_and_are_bounded() -> None:
    waits = [wait_s(tries) for tries in (0, 1, 2, 100, 100_000)]
    assert waits == [FIRST_WAIT_S, 2 * FIRST_WAIT_S, 4 * FIRST_WAIT_S, MOST_WAIT_S, MOST_WAIT_S]


def test_a_place_that_says_no_is_refused_unless_forced(place: Place) -> None:
    uploads = place.daemon("file:///proc/nobody/can/write/here")
    with pytest.raises(UsageError, match="cannot be uploaded") as refused:
        uploads.prove()
    assert "--force" in refused.value.hint
    uploads.prove(force=True)
    assert "/proc/nobody" in str(uploads.warning)


def test_a_journal_that_cannot_be_read_is_reported(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    place.journal.write_text("[")
    assert place.daemon().statuses == []
    assert "does not say what is to be uploaded" in caplog.text


@pytest.mark.parametrize(
    ("url", "told"),
    [
        ("/mnt/archive", "not a URL; possible: s3://bucket/prefix"),
        ("s3://", "not a URL"),
        ("s3://key:secret@bucket/x", "must come from the environment"),
        ("s3://bucket/x?versionId=1", "must come from the environment"),
        ("gopher://x/y", "gopher"),
    ],
)
def test_a_url_that_cannot_be_is_refused(url: str, told: str) -> None:
    with pytest.raises(ConfigError, match=r"recording\.upload_to") as refused:
        check_upload(load_rig("rig-demo", {"recording.upload_to": url}))
    assert told in str(refused.value)


def test_what_is_not_installed_is_refused_with_a_hint(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = load_rig("rig-demo", {"recording.upload_to": "s3://bucket/runs/"})
    assert rig.recording.upload_to == "s3://bucket/runs"
    check_upload(rig)
    check_upload(load_rig("rig-demo"))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="not installed") as refused:
        check_upload(rig)
    assert "tdi-acquire[remote]" in refused.value.hint


def test_without_a_target_recordings_are_not_remembered(tmp_path: Path) -> None:
    """The path of every recording was, until the daemon ended."""
    uploads = Uploads()
    for number in range(10):
        uploads.add(tmp_path / f"{number}.zarr")
    assert not uploads._ours
    assert uploads.statuses == []


def test_copies_on_the_recordings_disk_leave_its_reserve_free(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They filled it, and a file that was larger than the reserve took all of it."""
    path, box, reserve = place.here / "r.zarr", Box(), 100
    with RecordingWriter.create(path, SPEC) as writer:
        fill(writer, 8 * SHARD_LINES)
        writer.seal(RunCondition.GOOD, "done", {})

    copier = Copier(box, f"file://{place.far}", reserve)
    whole = tree_bytes(path)
    for room in (reserve, reserve + whole // 8, reserve + whole // 2):
        monkeypatch.setattr(Disk, "free_bytes", lambda *_, room=room: room - tree_bytes(place.far))
        copier.add(path, ours=False)
        copier.turn()
        while box.posted[-1].state == "copying":
            copier.turn()
        found = box.posted.pop()
        assert "bytes more would leave less than recording.reserve_gb free" in found.error
        assert found.hint == "free space there, or recording.upload_to on another disk"
        assert room - tree_bytes(place.far) >= reserve
    assert tree_bytes(place.far) > whole // 8
    # Another disk has a reserve of its own.
    monkeypatch.setattr("acquire.daemon.copier.shares_disk", lambda *_: False)
    copier.add(path, ours=False)
    while box.posted[-1].state != "copied":
        copier.turn()
    assert state_of(place.far / "r.zarr") == "sealed"


def test_a_reserve_that_is_reloaded_holds_for_copies_at_once(place: Place) -> None:
    """It held from the next start on, while the page said otherwise."""
    path = place.write("r.zarr")
    free = os.statvfs(path).f_bavail * os.statvfs(path).f_frsize
    uploads = place.daemon()
    uploads.keep(2 * free)
    uploads.add(path)
    look_until(uploads, lambda: "recording.reserve_gb" in uploads.statuses[-1].error)
    uploads.keep(0)
    look_until(uploads, lambda: uploads.statuses[-1].state == "copied")
