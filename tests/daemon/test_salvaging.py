"""The daemon's salvage with its real process, on recordings that a writer here has left open."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from waiting import until

from acquire.capacity.load import Load, recording_spec, trigger_run
from acquire.clock import ClockFit
from acquire.daemon.journal import Journal, only_user
from acquire.daemon.messages import RecoveryStatus
from acquire.daemon.salvage import MOST_ODD, Salvage
from acquire.errors import StateError, UsageError
from acquire.lines import ARMS, LineBlock
from acquire.store import RecordingWriter, RunCondition, open_recording
from acquire.store.files import locked
from acquire.stream import Note, Orphan
from acquire.stream.tagger import Tagger

CLOCK = ClockFit(90_000_000, 0, 0)
LOAD = Load(8, "uint16", 1000.0, chunk_lines=16, shard_chunks=4)
SPEC = recording_spec(LOAD, CLOCK)
LINES = 8 * 16
WAIT_S = 300.0


@pytest.fixture
def salvage(tmp_path: Path) -> Iterator[Salvage]:
    made = Salvage(tmp_path)
    yield made
    made.close()


def leave_open(path: Path, lines: int = 0) -> Path:
    """A recording whose writer has committed so many lines, whole chunks, and is gone."""
    with RecordingWriter.create(path, SPEC) as writer:
        tagger = Tagger(trigger_run(LOAD), LOAD.stages, CLOCK)
        for arm in ARMS if lines else ():
            pixels, flags = np.ones((lines, LOAD.pixels), np.uint16), np.zeros(lines, np.uint16)
            writer.append(tagger.tag(arm, LineBlock(writer.next_line(arm), pixels, flags)))
        writer.commit()
    return path


def states(salvage: Salvage) -> dict[str, str]:
    return {one.path.name: one.state for one in salvage.recoveries}


def look_until(salvage: Salvage, condition: Callable[[], bool], **how: bool) -> list[RecoveryStatus]:
    deadline, ended = time.monotonic() + WAIT_S, []
    while not condition():
        ended += salvage.poll(**how)
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return ended


def test_while_a_run_captures_only_what_it_left_is_recovered(salvage: Salvage, tmp_path: Path) -> None:
    """What the search finds waits, unless the run has left it: then it is recovered, for the run's reason."""
    found, ours = (leave_open(tmp_path / f"{name}.zarr") for name in ("found", "ours"))
    salvage.search()
    look_until(salvage, lambda: len(states(salvage)) == 2, capturing=True)
    assert states(salvage) == {"found.zarr": "waiting", "ours.zarr": "waiting"}
    salvage.add([Orphan(ours, "its recorder was killed")])
    (ended,) = salvage.wait(WAIT_S)
    assert (ended.path, ended.state, ended.condition) == (ours, "recovered", "INTERRUPTED")
    assert open_recording(ours).attrs["end_reason"] == "recovered: its recorder was killed"
    assert states(salvage)["found.zarr"] == "waiting"
    look_until(salvage, lambda: states(salvage)["found.zarr"] == "recovered")
    assert open_recording(found).state == "sealed"
    salvage.add([Orphan(ours, "its recorder was killed")])  # the status goes on telling it
    assert salvage.wait(WAIT_S) == []


def test_a_late_search_does_not_take_what_is_being_recorded_for_something_left(
    salvage: Salvage, tmp_path: Path
) -> None:
    """On a slow disk, the first run may begin before the search has ended."""
    path = tmp_path / "run.zarr"
    with RecordingWriter.create(path, SPEC) as writer:
        salvage.search()
        salvage.began(path)
        assert salvage._searching is not None
        salvage._searching.result(WAIT_S)
        assert salvage.poll(capturing=True) == []
        assert salvage.recoveries == []
        writer.seal(RunCondition.GOOD, "stopped", {})
    salvage.ended(path)
    assert salvage.poll() == []
    assert salvage.recoveries == []


def test_what_had_not_begun_is_removed(salvage: Salvage, tmp_path: Path) -> None:
    half = tmp_path / "half.zarr"
    (half / "a" / "lines").mkdir(parents=True)
    salvage.add([Orphan(half, "killed"), Orphan(tmp_path / "none.zarr", "killed")])
    ended = {one.path.name: one for one in salvage.wait(WAIT_S)}
    assert states(salvage) == {"half.zarr": "gone", "none.zarr": "gone"}
    assert "no line was committed" in ended["half.zarr"].text
    assert not half.exists()


@pytest.mark.parametrize("held", ["a/lines/c/0/0", "notes.txt"])
def test_what_holds_anything_is_not_removed(salvage: Salvage, tmp_path: Path, held: str) -> None:
    """A shard without a root, or somebody's file, whatever the recorder said."""
    path = tmp_path / "x.zarr"
    (path / held).parent.mkdir(parents=True)
    (path / held).write_bytes(b"precious")
    salvage.add([Orphan(path, "killed")])
    (ended,) = salvage.wait(WAIT_S)
    assert ended.state == "failed"
    assert (path / held).read_bytes() == b"precious"


def test_acknowledged_lines_without_a_root_are_recovered(salvage: Salvage, tmp_path: Path) -> None:
    path = leave_open(tmp_path / "x.zarr", LINES)
    (path / "zarr.json").unlink()
    salvage.add([Orphan(path, "killed", LINES)])
    (ended,) = salvage.wait(WAIT_S)
    assert (ended.state, ended.lines, ended.text) == ("recovered", LINES, "recovered: killed")
    assert open_recording(path).lines == LINES


def test_marks_that_the_recorder_received_and_did_not_write_are_listed(
    salvage: Salvage, tmp_path: Path
) -> None:
    """A mark whose line was committed, and which was not, belongs to this recording and to no successor's."""
    path = leave_open(tmp_path / "x.zarr", LINES)
    first = open_recording(path).first_line
    told = [Note(first + 17, "mark", "the valve opens"), Note(first + LINES, "mark", "the successor's")]
    salvage.add([Orphan(path, "killed", LINES, (told[0], told[0], told[1]))])
    salvage.wait(WAIT_S)
    recording = open_recording(path)
    marks = [event for event in recording.events if event.kind == "mark"]
    assert [(mark.line, mark.text) for mark in marks] == [(first + 17, "the valve opens")]
    assert marks[0].tick == recording.arms["a"].read("tick", 17, 18)[0]


def test_a_directory_that_is_gone_is_not_called_recovered(salvage: Salvage, tmp_path: Path) -> None:
    """Its disk was unmounted, or it was removed: the lines that were acknowledged are named."""
    (tmp_path / "empty.zarr").mkdir()
    salvage.add([Orphan(tmp_path / name, "killed", 20_000) for name in ("away.zarr", "empty.zarr")])
    ended = {one.path.name: one for one in salvage.wait(WAIT_S)}
    assert states(salvage) == {"away.zarr": "gone", "empty.zarr": "failed"}
    assert all("20000 lines of it were" in one.text for one in ended.values())
    assert (tmp_path / "empty.zarr").is_dir()


def test_a_recording_of_any_name_is_found_and_recovered(salvage: Salvage, tmp_path: Path) -> None:
    """Also without the journal, which may be lost with the directory's other hidden files."""
    leave_open(tmp_path / "take 3", LINES)
    (leave_open(tmp_path / "no root", LINES) / "zarr.json").unlink()
    (tmp_path / "older").mkdir()
    salvage.search()
    look_until(salvage, lambda: states(salvage) == {"take 3": "recovered", "no root": "recovered"})
    assert open_recording(tmp_path / "take 3").lines == LINES


def test_links_are_not_followed(salvage: Salvage, tmp_path: Path) -> None:
    """Neither where the recording is one, nor where it holds one."""
    (tmp_path / "elsewhere").mkdir()
    victim = tmp_path / "elsewhere" / "victim"
    victim.write_bytes(b"precious")
    holds = leave_open(tmp_path / "holds.zarr", LINES)
    (holds / "a" / "lines" / ".next").symlink_to(victim)
    real = leave_open(tmp_path / "elsewhere" / "real", LINES)
    (tmp_path / "is.zarr").symlink_to(real)
    salvage.search()
    look_until(salvage, lambda: len(states(salvage)) == 2 and "waiting" not in states(salvage).values())
    assert states(salvage) == {"holds.zarr": "failed", "is.zarr": "left"}
    told = {one.path.name: one.text for one in salvage.recoveries}
    assert "is a link, not touched" in told["is.zarr"]
    assert "holds a link, not touched: a/lines/.next" in told["holds.zarr"]
    assert victim.read_bytes() == b"precious"
    assert open_recording(real).state == open_recording(holds).state == "recording"


def test_odd_entries_are_named_once_and_gone_around(
    salvage: Salvage, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    good = leave_open(tmp_path / "good.zarr")
    roots = {
        "list": b'{"attributes": []}',
        "deep": b'{"attributes":' * 50_000,
        "nested": b'{"attributes": {"x": ' + b"[" * 500 + b"]" * 500 + b"}}",
        "bytes": b"\xff\xfe",
        "nothing": b"",
    }
    for name, root in roots.items():
        (tmp_path / f"{name}.zarr").mkdir()
        (tmp_path / f"{name}.zarr" / "zarr.json").write_bytes(root)
    (tmp_path / "pipe.zarr").mkdir()
    os.mkfifo(tmp_path / "pipe.zarr" / "zarr.json")
    os.mkfifo(tmp_path / "itself.zarr")
    (tmp_path / "zero.zarr").mkdir()
    (tmp_path / "zero.zarr" / "zarr.json").symlink_to("/dev/zero")
    (tmp_path / "large.zarr").mkdir()
    with (tmp_path / "large.zarr" / "zarr.json").open("wb") as file:
        file.truncate(2**40)
    bad_name = tmp_path / os.fsdecode(b"\xff.zarr")
    bad_name.mkdir()
    salvage.search()
    look_until(salvage, lambda: states(salvage).get("good.zarr") == "recovered")
    assert open_recording(good).state == "sealed"
    assert len(salvage.recoveries) == 1 + MOST_ODD
    assert all(one.state == "left" and one.text for one in salvage.recoveries if one.path != good)
    assert "2 more like these" in caplog.text
    assert [one.model_dump_json() for one in salvage.recoveries]


def test_a_noted_recording_that_cannot_be_looked_at_hides_no_other(tmp_path: Path) -> None:
    """On a disk that does not answer, or in a directory that this user may not enter any more."""
    good, journal = leave_open(tmp_path / "good.zarr"), tmp_path / "journal"
    unreachable = tmp_path / ("x" * 300)  # as good as one: what stands there cannot be found out
    Journal(journal, "not_sealed", "").write([unreachable])
    salvage = Salvage(tmp_path, journal)
    try:
        salvage.search()
        look_until(salvage, lambda: states(salvage).get("good.zarr") == "recovered")
        assert states(salvage)[unreachable.name] == "left"
        assert open_recording(good).state == "sealed"
        assert Journal(journal, "not_sealed", "").read() == [unreachable]
    finally:
        salvage.close()


def test_open_recordings_with_odd_attributes_are_named(salvage: Salvage, tmp_path: Path) -> None:
    changes: dict[str, object] = {"config": None, "host": ["x"]}
    for key, value in changes.items():
        root = leave_open(tmp_path / f"{key}.zarr") / "zarr.json"
        document = json.loads(root.read_bytes())
        document["attributes"][key] = value
        root.write_text(json.dumps(document))
    salvage.search()
    look_until(
        salvage, lambda: len(states(salvage)) == len(changes) and "waiting" not in states(salvage).values()
    )
    assert states(salvage) == {"config.zarr": "failed", "host.zarr": "left"}


def test_what_is_recorded_elsewhere_is_known_to_the_next_daemon(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    journal = here / ".recordings-rig.json"
    killed = Salvage(here, journal)
    killed.search()
    paths = [there / "no-suffix", there / "sealed.zarr", there / "away.zarr", there / "never"]
    for path in paths:
        killed.began(path)
    leave_open(paths[0], LINES)
    killed.ended(leave_open(paths[1]))
    (paths[3] / "a" / "lines").mkdir(parents=True)
    assert json.loads(journal.read_bytes())["not_sealed"] == [str(paths[k]) for k in (0, 2, 3)]
    following = Salvage(here, journal)
    try:
        following.search()
        look_until(
            following, lambda: len(states(following)) == 3 and "waiting" not in states(following).values()
        )
        assert states(following) == {"no-suffix": "recovered", "away.zarr": "gone", "never": "left"}
        assert open_recording(paths[0]).state == "sealed"
        assert str(paths[0]) not in json.loads(journal.read_bytes())["not_sealed"]
        assert paths[3].is_dir()
    finally:
        following.close()


def test_the_lists_of_a_rig_have_one_user(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    tmp_path.chmod(0o770)
    with only_user(tmp_path, "rig"), only_user(tmp_path, "other"):
        with pytest.raises(StateError, match=f"process {os.getpid()}"), only_user(tmp_path, "rig"):
            pass
        # Of whoever may write to the directory, any may run the next daemon.
        assert (tmp_path / ".recordings-rig.lock").stat().st_mode & 0o777 == 0o660
    with only_user(tmp_path, "rig"):
        pass
    (tmp_path / ".recordings-odd.lock").write_text("a text that is longer than any number of a process")
    with pytest.raises(UsageError, match="it is not a lock of acquire"), only_user(tmp_path, "odd"):
        pass
    with only_user(tmp_path / "away", "rig"):  # a disk on which nothing can be made stops nothing else
        assert "would not be noticed" in caplog.text


@pytest.mark.parametrize("text", ["[" * 100_000, '{"not_sealed": 5}', '{"not_sealed": [1, "x", null]}', "\0"])
def test_a_journal_that_is_damaged_costs_a_line_in_the_log(
    tmp_path: Path, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    journal = tmp_path / "journal.json"
    journal.write_text(text)
    assert Journal(journal, "not_sealed", "not sealed").read() == []
    assert str(journal) in caplog.text


def test_a_recovery_that_is_killed_is_reported_as_failed(salvage: Salvage, tmp_path: Path) -> None:
    path = leave_open(tmp_path / "r.zarr")
    salvage.add([Orphan(path, "killed")])
    salvage.poll()
    worker = salvage._worker
    assert worker is not None
    until(lambda: worker.pid is not None, "the process")
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGKILL)
    (ended,) = salvage.wait(WAIT_S)
    assert ended.state == "failed"
    assert "killed by SIGKILL" in ended.text
    assert open_recording(path).state == "recording"


def test_what_somebody_holds_is_looked_at_again_and_left_in_the_end(
    salvage: Salvage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acquire.daemon.salvage.AGAIN_S", 0.01)
    path = leave_open(tmp_path / "r.zarr")
    salvage.search()
    with locked(path, "testing"):
        ended = look_until(salvage, lambda: states(salvage).get("r.zarr") == "left")
    assert "another process is writing it" in ended[-1].text
    assert open_recording(path).state == "recording"


def test_an_arming_daemon_puts_a_recovery_off(salvage: Salvage, tmp_path: Path) -> None:
    path = leave_open(tmp_path / "r.zarr")
    salvage.search()
    look_until(salvage, lambda: salvage._worker is not None)
    salvage.poll(capturing=True)
    assert salvage._worker is None
    assert states(salvage) == {"r.zarr": "waiting"}
    look_until(salvage, lambda: states(salvage) == {"r.zarr": "recovered"})
    assert open_recording(path).state == "sealed"
