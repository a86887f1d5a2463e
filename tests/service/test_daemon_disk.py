"""A daemon whose disk or recorder pauses: it waits, reports the pause, and continues without help."""

from __future__ import annotations

import os
import re
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import frozen_disk
import numpy as np
import pytest
from live_daemon import SUBSTEPS, Daemon, until_gone
from waiting import until

from acquire.client import Client
from acquire.daemon.messages import Status
from acquire.daemon.states import State
from acquire.errors import DataError, StateError
from acquire.store import Recording, open_recording, verify

MARKS_BEFORE = 12
"""Marks before the disk is filled."""
LONG_RING = "stream.ring_slots=4096"
"""26 s of lines: a busy host is slow to come back."""
SHORT_RING = "stream.ring_slots=256"
"""1.6 s of lines."""
SMALL_DISK = "recording.reserve_gb=0.01"


@contextmanager
def recording(home: Path, path: Path, *settings: str) -> Iterator[tuple[Daemon, Client]]:
    """A daemon that records to ``path`` and has committed some lines."""
    daemon = Daemon(home, *settings)
    try:
        with daemon.client() as client:
            client.arm()
            client.start(path)
            until(lambda: committed(client.status()) > 300, "committed lines")
            yield daemon, client
    finally:
        daemon.close()


def committed(status: Status) -> int:
    return 0 if status.recording is None else status.recording.committed_lines


def waits(client: Client, text: str) -> Callable[[], bool]:
    """The pause is reported as ``text``, and nothing is abandoned during it."""

    def is_reported() -> bool:
        status = client.status()
        assert (status.state, status.fault) == (State.RECORDING, None)
        return re.search(text, status.waiting or "") is not None

    return is_reported


def ended(client: Client) -> Status:
    """The recording is sealed, and the devices are released."""
    client.stop()
    if client.status().state is State.ARMED:
        client.disarm()
    return client.wait({State.IDLE}, 60)


def check_whole(recording: Recording) -> None:
    assert recording.state == "sealed"
    assert not recording.gaps
    assert verify(recording.path).intact
    index = np.arange(recording.lines, dtype=np.uint64) + np.uint64(recording.first_line)
    for arm in "ab":
        camera = recording.camera(arm)
        assert np.array_equal(camera.code_index[:], np.uint64(SUBSTEPS) * index)
        assert not camera.flags[:].any()


def check_books(status: Status, *recordings: Recording) -> None:
    for arm in status.arms.values():
        assert arm.ledger is not None
        assert arm.ledger.balanced
        assert sum(arm.lost.values()) == sum(arm.ledger.lost.values()) == 0
        assert arm.ledger.stored == sum(recording.lines for recording in recordings)


def test_a_recorder_that_pauses_for_seconds_is_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "x.zarr"
    with recording(tmp_path, path, LONG_RING) as (daemon, client):
        pid = client.status().processes["recorder"]
        os.kill(pid, signal.SIGSTOP)
        until(waits(client, "for ([5-9]|1[0-9]) s; the rings hold "), "the words")
        assert "waiting" in daemon("status").out
        os.kill(pid, signal.SIGCONT)
        until(lambda: client.status().waiting is None, "the end of the pause")
        status = ended(client)
    assert status.last is not None
    assert (status.last.path, status.last.condition, status.last.end_reason) == (path, "GOOD", "stopped")
    found = open_recording(path)
    check_whole(found)
    check_books(status, found)


def test_a_long_pause_of_the_recorder_loses_no_recorded_line(tmp_path: Path) -> None:
    """The recording ends where the rings were full, and continues in a segment next to it."""
    path = tmp_path / "x.zarr"
    with recording(tmp_path, path, SHORT_RING) as (_, client):
        pid = client.status().processes["recorder"]
        os.kill(pid, signal.SIGSTOP)
        until(waits(client, "the rings are full"), "full rings")
        os.kill(pid, signal.SIGCONT)
        until(lambda: (now := client.status().recording) is not None and now.path != path, "a segment")
        until(lambda: committed(client.status()) > 300, "committed lines")
        status = ended(client)
    assert status.fault is None
    first = open_recording(path)
    parts = [first, *first.segments]  # a busy host may fill a ring this short more than once
    assert len(parts) > 1
    for part in parts:
        check_whole(part)
    check_books(status, *parts)


@pytest.mark.needs_freeze
def test_a_frozen_disk_is_waited_for_and_the_recording_continues(tmp_path: Path) -> None:
    """Frozen once for as long as the rings hold, then for longer."""
    with frozen_disk.mounted(tmp_path) as disk:
        path = disk.path / "x.zarr"
        with recording(tmp_path, path, SMALL_DISK) as (_, client):
            for text in (r"the disk has not answered for \d+ s; the rings hold ", "the rings are full"):
                disk.freeze()
                until(waits(client, text), "the words")
                disk.thaw()
                until(lambda: client.status().waiting is None, "the end of the pause")
            until(lambda: (now := client.status().recording) is not None and now.path != path, "a segment")
            until(lambda: committed(client.status()) > 300, "committed lines")
            status = ended(client)
        assert status.fault is None
        first = open_recording(path)
        parts = [first, *first.segments]
        for part in parts:
            check_whole(part)
        assert [part.attrs["run_condition"] for part in parts] == ["INTERRUPTED"] * (len(parts) - 1) + [
            "GOOD"
        ]
        assert (
            sum(part.lines for part in parts) > 60_000
        )  # what came in both pauses, as far as the rings held it
        check_books(status, *parts)


@pytest.mark.needs_freeze
def test_a_daemon_ends_although_its_disk_does_not_answer(tmp_path: Path) -> None:
    """In bounded time; what it left is recovered by the next one, once the disk answers."""
    with frozen_disk.mounted(tmp_path) as disk:
        path = disk.path / "x.zarr"
        home, again = tmp_path / "1", tmp_path / "2"
        home.mkdir()
        again.mkdir()
        with recording(home, path, SMALL_DISK, "recording.seal_timeout_s=2") as (daemon, client):
            disk.freeze()
            until(waits(client, "the disk has not answered"), "the words")
            acknowledged = committed(client.status())
            children = daemon.children()
            daemon.process.send_signal(signal.SIGTERM)
            daemon.process.wait(200)
            disk.thaw()
            until_gone(children)
        other = Daemon(again, SMALL_DISK, f"recording.directory='{disk.path}'")
        try:
            until(lambda: state_of(path) == "sealed", "the recovery")
        finally:
            other.close()
        assert open_recording(path).lines >= acknowledged


def state_of(path: Path) -> str:
    """Of a recording that somebody may be writing."""
    try:
        return str(open_recording(path).state)
    except DataError:
        return ""


def mark_until_full(client: Client, rest: Path) -> list[str]:
    """Fill the disk with ``rest`` while the instrument takes marks; return those that it took.

    All at once after the first marks, since a recording ends before a disk that fills slowly is full.
    """
    marks: list[str] = []
    with rest.open("wb", buffering=0) as file:
        while client.status().state is State.RECORDING:
            with suppress(OSError):
                while len(marks) > MARKS_BEFORE:
                    file.write(bytes(2**16))
            try:
                client.mark(f"mark {len(marks)}.")
            except StateError:
                break
            marks.append(f"mark {len(marks)}.")
    return marks


@pytest.mark.needs_mount
def test_marks_that_a_full_disk_leaves_out_are_named_and_in_the_log(tmp_path: Path) -> None:
    """They were accepted, and neither in the recording nor, after the tenth, in the log."""
    place = tmp_path / "small"
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=12m", "none", place], check=True)
    try:
        with recording(tmp_path, place / "x.zarr", "recording.reserve_gb=0.0") as (daemon, client):
            marks = mark_until_full(client, place / "rest")
            # Armed: if it was seen that the disk is full before a write failed.
            status = client.wait({State.FAULTED, State.ARMED}, 30)
            log = daemon.log.read_text()
        found = open_recording(place / "x.zarr")
        listed = [event.text for event in found.events if event.kind == "mark"]
        after = [text for text in marks if text not in listed]
        # Those within the recording are in it.
        assert listed == marks[: len(listed)]
        assert len(marks) > 10
        assert all(f": {text}" in log for text in marks)
        if after and status.state is State.FAULTED:
            assert "marks of lines after its last one, of which only the log is sure to have all" in (
                status.fault or ""
            )
    finally:
        subprocess.run(["umount", "--lazy", place], check=True)
