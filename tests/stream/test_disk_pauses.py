"""A disk that does not answer for a while, under the real recorder process, wherever it is asked.

As long as the rings hold what comes, nothing happens but that the status says so. Then the recording ends
before the first line that they had no room for, sealed when the disk answers, and goes on in a segment.
"""

from __future__ import annotations

import itertools
import os
import re
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from slow_disks import PausingDisk
from test_slow_disk import capturing, check_lines
from waiting import until

from acquire.capacity.load import Load, recording_spec
from acquire.errors import DataError, DeviceError, StateError
from acquire.lines import ARMS
from acquire.store import Recording, RecordingSpec, open_recording, verify
from acquire.store.files import DISK, Disk
from acquire.store.recovery import recover
from acquire.stream import Begin, Capture, CaptureStatus

LOAD = Load(64, "uint16", 8000.0, substeps=2, stages=8, block_lines=64, ring_slots=4000, chunk_lines=512)
"""A ring of 32 s: a busy host takes its time to come back after a pause."""
WORDS = r"the disk has not answered for \d+ s; the rings hold \d+ s more"
SHORT_RING = 400
"""Slots of one that is full after 3.2 s."""


@contextmanager
def recording(
    path: Path, disk: Disk, lines: int | None = None, fsync: Any = "seal", **changes: Any
) -> Iterator[Capture]:
    """A capture whose recording has some committed lines, or has only been asked for where it is held up."""
    with capturing(disk, LOAD, **changes) as capture:
        spec = replace(recording_spec(LOAD, capture.clock), fsync=fsync)
        capture.start(Begin(path, spec, lines))
        until(lambda: capture.poll().committed_lines > 500, "committed lines")
        yield capture


def overflow(capture: Capture) -> bool:
    return all(ring["drops"] > 2 for ring in capture.poll().ring.values())


def until_done(capture: Capture) -> CaptureStatus:
    until(lambda: capture.poll().done or capture.poll().fault, "the seal")
    assert capture.poll().fault is None
    return capture.poll()


def check_whole(path: Path) -> Recording:
    """Sealed, every row its line, nothing missing."""
    found = open_recording(path)
    assert found.state == "sealed"
    assert verify(path).intact
    check_lines(path, LOAD)
    for arm in ARMS:
        book = found.attrs["ledger"][arm]
        assert (book["balanced"], book["stored"], book["missing"]) == (True, found.lines, {})
    return found


def check_books(capture: Capture, *paths: Path) -> None:
    """Nothing is lost, and what is stored is what the recordings hold."""
    capture.close()
    for account in capture.poll().accounts.values():
        assert account.balanced
        assert account.lost == {}
        assert account.stored == sum(open_recording(path).lines for path in paths)


@pytest.mark.parametrize(("at", "fsync"), [("pages", "seal"), ("commit", "seal"), ("sync", "commit")])
def test_a_pause_is_waited_out_as_long_as_the_rings_hold(tmp_path: Path, at: str, fsync: str) -> None:
    """And another one right after it; no line is lost, flagged or in doubt."""
    disk = PausingDisk(tmp_path / "gate", at)
    with recording(tmp_path / "r.zarr", disk, fsync=fsync, continues=True) as capture:
        for _ in range(2):
            disk.gate.touch()
            until(lambda: re.match(WORDS, capture.poll().waiting), "words")
            disk.gate.unlink()
            until(lambda: capture.poll().waiting == "", "the end of the pause")
        capture.stop()
        seen = until_done(capture)
        assert (seen.condition, seen.end_reason, seen.ledger["tainted_by"]) == ("GOOD", "stopped", {})
        check_whole(tmp_path / "r.zarr")
        check_books(capture, tmp_path / "r.zarr")


@pytest.mark.parametrize("how", ["pages", "commit", "SIGSTOP"])
def test_after_a_longer_pause_the_recording_goes_on_in_a_further_segment(tmp_path: Path, how: str) -> None:
    path = tmp_path / "r.zarr"
    disk = PausingDisk(tmp_path / "gate", how)
    with recording(path, disk, ring_slots=SHORT_RING, continues=True) as capture:
        recorder = capture.pids["recorder"]
        assert recorder is not None
        if how == "SIGSTOP":
            os.kill(recorder, signal.SIGSTOP)
        else:
            disk.gate.touch()
        until(lambda: overflow(capture), "full rings")
        until(lambda: "the rings are full: lines that come now belong" in capture.poll().waiting, "words")
        check_records(capture)
        held_up = capture.poll().path
        disk.gate.unlink(missing_ok=True)
        os.kill(recorder, signal.SIGCONT)
        until(lambda: capture.poll().path != held_up, "a segment")
        until(lambda: capture.poll().committed_lines > 500, "committed lines")
        check_records(capture)
        assert capture.pids["recorder"] == recorder
        capture.stop()
        assert until_done(capture).end_reason == "stopped"
        first = check_whole(path)
        parts = [first, *(check_whole(part.path) for part in first.segments)]  # a busy host may need several
        assert [part.path.name for part in parts[:2]] == ["r.zarr", "r-2.zarr"]
        for one, two in itertools.pairwise(parts):
            assert one.attrs["run_condition"] == "INTERRUPTED"
            assert one.attrs["end_reason"].startswith("too slow to write: ")
            assert two.attrs["run_id"] == one.attrs["run_id"]
            outage = two.attrs["segment"]["outage"]
            assert outage["after_line"] == one.first_line + one.lines - 1
            assert outage["lines"] == two.first_line - (one.first_line + one.lines) > 0
            assert any(event.kind == "resumed" for event in two.events)
        assert sum(part.lines for part in parts) >= SHORT_RING * 64
        check_books(capture, *(part.path for part in parts))


def test_a_recording_that_is_extended_while_its_next_segment_is_created_ends_that_late(
    tmp_path: Path,
) -> None:
    """As by an event: a recorder that is creating a segment takes no such command, and gets it once more."""
    lines = 30_000
    disk = PausingDisk(tmp_path / "gate", "make")
    with recording(tmp_path / "r.zarr", disk, lines) as capture:
        end_line = (capture.poll().first_line or 0) + lines + 4000
        recorder = capture.pids["recorder"]
        assert recorder is not None
        disk.gate.touch()
        os.kill(recorder, signal.SIGKILL)
        until(disk.held.exists, "the successor's segment")
        capture.extend(end_line)
        disk.gate.unlink()
        assert until_done(capture).end_reason == "line budget reached"
        segment = check_whole(tmp_path / "r-2.zarr")
        assert segment.first_line + segment.lines == end_line


def test_a_recording_whose_end_passes_during_the_pause_has_ended(tmp_path: Path) -> None:
    """No further segment can begin: it says so, and does not wait for one."""
    path, lines = tmp_path / "r.zarr", (SHORT_RING + 100) * 64
    disk = PausingDisk(tmp_path / "gate", "pages")
    with recording(path, disk, lines, ring_slots=SHORT_RING, continues=True) as capture:
        disk.gate.touch()
        until(lambda: overflow(capture), "full rings")
        end_line = (capture.poll().first_line or 0) + lines
        until(lambda: capture.poll().lines["a"]["delivered"] > end_line + 64 * SHORT_RING, "later lines")
        disk.gate.unlink()
        seen = until_done(capture)
        assert seen.condition == "INTERRUPTED"
        passed = f"its end, line {end_line}, passed before a further segment could begin"
        assert re.fullmatch(f"too slow to write: .*; {passed}", str(seen.end_reason))
        assert (seen.waiting, seen.recording) == ("", False)
        assert check_whole(path).lines < lines
        assert [left.name for left in tmp_path.glob("*.zarr")] == ["r.zarr"]
        check_books(capture, path)


def check_records(capture: Capture) -> None:
    """It does not seem to end."""
    seen = capture.poll()
    assert (seen.recording, seen.draining, seen.done, seen.fault) == (True, False, False, None)


def test_a_recording_that_must_not_go_on_ends_there(tmp_path: Path) -> None:
    disk = PausingDisk(tmp_path / "gate", "pages")
    with recording(tmp_path / "r.zarr", disk, ring_slots=SHORT_RING) as capture:
        disk.gate.touch()
        until(lambda: overflow(capture), "full rings")
        disk.gate.unlink()
        assert until_done(capture).condition == "INTERRUPTED"
        check_whole(tmp_path / "r.zarr")
        check_books(capture, tmp_path / "r.zarr")


def test_a_stop_during_a_pause_ends_where_it_was_asked_for(tmp_path: Path) -> None:
    disk = PausingDisk(tmp_path / "gate", "pages")
    with recording(tmp_path / "r.zarr", disk, continues=True) as capture:
        disk.gate.touch()
        until(disk.held.exists, "a write that is held up")
        before = capture.poll().lines["a"]["delivered"]
        capture.stop()
        after = capture.poll().lines["a"]["delivered"]
        until(lambda: capture.poll().lines["a"]["delivered"] > after + 2000, "lines that are not wanted")
        disk.gate.unlink()
        seen = until_done(capture)
        assert (seen.condition, seen.end_reason) == ("GOOD", "stopped")
        found = check_whole(tmp_path / "r.zarr")
        assert before - 64 <= found.first_line + found.lines + seen.lines["a"]["preroll"] <= after + 64
        check_books(capture, tmp_path / "r.zarr")


def test_a_budget_that_ends_during_the_pause_is_kept(tmp_path: Path) -> None:
    """The rings hold the last line, and what comes after it is not wanted."""
    disk = PausingDisk(tmp_path / "gate", "commit")
    with recording(tmp_path / "r.zarr", disk, 12_000, continues=True) as capture:
        disk.gate.touch()
        until(lambda: capture.poll().lines["b"]["delivered"] > 40_000, "the last line and more")
        disk.gate.unlink()
        seen = until_done(capture)
        assert (seen.condition, seen.recorded_lines) == ("GOOD", 12_000)
        check_whole(tmp_path / "r.zarr")
        check_books(capture, tmp_path / "r.zarr")


@pytest.mark.parametrize("at", ["make", "seal"])
def test_a_pause_while_a_recording_is_created_or_sealed_costs_nothing(tmp_path: Path, at: str) -> None:
    disk = PausingDisk(tmp_path / "gate", at)
    with capturing(disk, LOAD, continues=True) as capture:
        disk.gate.touch()
        if at == "make":
            threading.Timer(1.5, disk.gate.unlink).start()
        capture.start(Begin(tmp_path / "r.zarr", recording_spec(LOAD, capture.clock), 2000))
        if at == "seal":
            until(disk.held.exists, "a seal that is held up")
            until(lambda: "the disk has been at work for " in capture.poll().waiting, "the words")
            disk.gate.unlink()
        assert until_done(capture).condition == "GOOD"
        check_whole(tmp_path / "r.zarr")
        check_books(capture, tmp_path / "r.zarr")


def test_a_recording_that_the_disk_does_not_create_is_refused_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acquire.stream.supervisor._ANSWER_S", 0.5)
    disk = PausingDisk(tmp_path / "gate", "make")
    with capturing(disk, LOAD, continues=True) as capture:
        spec = recording_spec(LOAD, capture.clock)
        disk.gate.touch()
        with pytest.raises(DeviceError, match=r"it waits for the disk.*nothing was recorded"):
            capture.start(Begin(tmp_path / "r.zarr", spec))
        assert capture.poll().fault is None
        disk.gate.unlink()
        monkeypatch.undo()
        until(lambda: not (tmp_path / "r.zarr").exists(), "the removal")
        until(lambda: can_start(capture, tmp_path / "s.zarr", spec), "a recorder that is free again")
        assert until_done(capture).condition == "GOOD"
        check_whole(tmp_path / "s.zarr")


def can_start(capture: Capture, path: Path, spec: RecordingSpec) -> bool:
    """It has begun; refused as long as the recorder clears away the one before."""
    try:
        capture.start(Begin(path, spec, 1000))
    except StateError:
        return False
    return True


def test_what_is_closed_during_a_pause_can_be_recovered(tmp_path: Path) -> None:
    """The devices are released in bounded time; what was acknowledged is there."""
    disk = PausingDisk(tmp_path / "gate", "pages")
    with recording(tmp_path / "r.zarr", disk, continues=True) as capture:
        disk.gate.touch()
        until(disk.held.exists, "a write that is held up")
        acknowledged = capture.poll().committed_lines
        with pytest.raises(DataError, match="could not be sealed in time"):
            capture.close(0.5)
        assert [orphan.path for orphan in capture.poll().orphans] == [tmp_path / "r.zarr"]
    recover(tmp_path / "r.zarr")
    found = open_recording(tmp_path / "r.zarr")
    assert (found.state, found.lines >= acknowledged) == ("sealed", True)
    check_lines(tmp_path / "r.zarr", LOAD)


def test_a_recorder_that_is_killed_during_a_pause_is_replaced_and_no_line_is_lost(tmp_path: Path) -> None:
    """Its successor finds a disk that does not answer either, and waits like it."""
    disk = PausingDisk(tmp_path / "gate", "pages")
    with recording(tmp_path / "r.zarr", disk, continues=True) as capture:
        disk.gate.touch()
        until(disk.held.exists, "a write that is held up")
        recorder = capture.pids["recorder"]
        assert recorder is not None
        os.kill(recorder, signal.SIGKILL)
        until(lambda: capture.poll().path == str(tmp_path / "r-2.zarr"), "a successor")
        disk.gate.unlink()
        until(lambda: capture.poll().committed_lines > 500, "committed lines")
        capture.stop()
        seen = until_done(capture)
        assert seen.condition == "GOOD"
        recover(tmp_path / "r.zarr")
        one, two = open_recording(tmp_path / "r.zarr"), check_whole(tmp_path / "r-2.zarr")
        check_lines(one.path, LOAD)
        assert one.first_line < two.first_line <= one.first_line + one.lines
    assert all(account.balanced and not account.lost for account in capture.poll().accounts.values())


def test_a_disk_is_not_waited_for_longer_than_the_rig_allows(tmp_path: Path) -> None:
    disk = PausingDisk(tmp_path / "gate", "pages")
    with recording(tmp_path / "r.zarr", disk, patience_s=1.0) as capture:
        disk.gate.touch()
        until(lambda: capture.poll().fault, "the fault")
        assert capture.poll().fault == "the disk has not answered for 1 s"
        disk.gate.unlink()
        until(lambda: capture.poll().done, "the seal")
        assert capture.poll().condition == "INTERRUPTED"
        check_whole(tmp_path / "r.zarr")


def test_a_recorder_that_hangs_is_replaced(tmp_path: Path) -> None:
    """It does not wait for a disk: another takes its place, and the recording goes on."""
    with recording(tmp_path / "r.zarr", DISK, patience_s=1.0) as capture:
        recorder = capture.pids["recorder"]
        assert recorder is not None
        os.kill(recorder, signal.SIGSTOP)
        until(lambda: capture.poll().path == str(tmp_path / "r-2.zarr"), "a segment")
        until(lambda: capture.poll().committed_lines > 500, "committed lines")
        assert capture.pids["recorder"] != recorder
        capture.stop()
        assert until_done(capture).fault is None
        (orphan,) = capture.poll().orphans
    assert orphan.why.startswith("its recorder was killed by SIGKILL after no sign of life for 1 s")
    told = [event.text for event in open_recording(tmp_path / "r-2.zarr").events if event.kind == "fault"]
    assert told == ["recorder: killed by SIGKILL after no sign of life for 1 s; another took its place"]
    recover(orphan.path)
    one, two = (open_recording(tmp_path / name) for name in ("r.zarr", "r-2.zarr"))
    assert two.first_line <= one.first_line + one.lines
