"""How a daemon ends, and what is left of a recording then."""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from live_daemon import SUBSTEPS, Daemon, acquire, until_gone, write_rig
from waiting import until

from acquire.daemon.states import State
from acquire.store import Recording, open_recording

Start = Callable[..., Daemon]


@pytest.fixture
def start(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Start]:
    """Starts daemons; all have ended after the test."""
    started: list[Daemon] = []

    def start_one(home: Path | None = None, **environment: str) -> Daemon:
        started.append(Daemon(home or tmp_path_factory.mktemp("d"), **environment))
        return started[-1]

    yield start_one
    for daemon in started:
        daemon.close()


def record(daemon: Daemon, committed_lines: int = 300) -> Path:
    """Record until a reader would find some lines."""
    path = daemon.home / "x.zarr"
    with daemon.client() as client:
        client.arm()
        client.start(path)
        deadline = time.monotonic() + 300
        while (now := client.status().recording) is None or now.committed_lines < committed_lines:
            assert time.monotonic() < deadline
            time.sleep(0.02)
    return path


def check_contiguous(recording: Recording, at_least: int) -> None:
    assert recording.lines >= at_least
    index = np.arange(recording.lines, dtype=np.uint64) + np.uint64(recording.first_line)
    for arm in ("a", "b"):
        camera = recording.camera(arm)
        assert np.array_equal(camera.code_index[: recording.lines], np.uint64(SUBSTEPS) * index)
        assert not np.any(camera.flags[: recording.lines] & 1)
        assert np.any(camera.lines[: recording.lines])
    recording.cut(recording.first_line, recording.lines)


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)], ids=["SIGTERM", "SIGINT"]
)
def test_signal_while_recording_seals(start: Start, number: signal.Signals, code: int) -> None:
    daemon = start()
    path = record(daemon)
    children = daemon.children()
    assert len(children) >= 3
    if number is signal.SIGINT:  # Ctrl-C reaches the whole foreground group
        for child in children:
            child.send_signal(number)
    assert daemon.end(number) == code
    until_gone(children)
    assert not daemon.socket.exists()
    recording = open_recording(path)
    assert (recording.state, recording.attrs["end_reason"]) == ("sealed", "signal")
    assert recording.attrs["run_condition"] == "GOOD"
    check_contiguous(recording, 300)


def test_signal_while_armed(start: Start) -> None:
    daemon = start()
    with daemon.client() as client:
        client.arm()
    children = daemon.children()
    assert daemon.end() == 0
    until_gone(children)
    assert not daemon.socket.exists()


def test_killed_while_recording(start: Start) -> None:
    """What was committed is there, nothing of the daemon stays, and the next one starts as if nothing was."""
    daemon = start()
    path = record(daemon)
    children = daemon.children()
    daemon.process.kill()
    daemon.process.wait(300)
    until_gone(children)
    check_contiguous(open_recording(path), 300)
    assert daemon.socket.exists()
    assert acquire("status", socket=daemon.socket).code == 3
    again = start(daemon.home)
    with again.client() as client:
        assert client.status().state is State.IDLE


def test_killed_processes_are_replaced(start: Start) -> None:
    """The daemon goes on recording: a gap with another grabber, a recording beside with another recorder."""
    daemon = start()
    path = record(daemon)
    recorder, *grabbers = daemon.workers()
    with daemon.client() as client:
        grabbers[-1].kill()  # grabber b is started last
        until(lambda: client.status().arms["b"].lost.get("grabber_lost", 0) > 0)
        recorder.kill()
        until(lambda: (now := client.status().recording) is not None and now.path != path)
        until(lambda: (now := client.status().recording) is not None and now.committed_lines > 300)
        status = client.stop()
        assert status.fault is None
        assert status.last is not None
        assert status.last.path == path.with_name(f"{path.stem}-2.zarr")
        assert status.state is State.ARMED
        until_gone([recorder, grabbers[-1]])
        assert grabbers[0].is_running()  # nobody killed it, and the instrument stays armed
        workers = daemon.workers()
        client.disarm()
    until_gone([*grabbers, *workers])
    assert open_recording(status.last.path).state == "sealed"
    assert open_recording(path).lines >= 300


def test_a_camera_that_hangs_is_a_fault(start: Start) -> None:
    """Told, ended by force, and the daemon goes on."""
    daemon = start()
    with daemon.client() as client:
        client.arm()
        workers = daemon.workers()
        workers[-1].suspend()
        status = client.wait({State.FAULTED}, 60)
        assert str(status.fault).startswith("arm b: no line for 3 s")
        until_gone(workers)
        for refused in (
            daemon("start"),
            daemon("camera", "live"),
            daemon("calibrate", "all", "--out", daemon.home / "new.zarr", "--yes"),
        ):
            assert refused.code == 4
            assert "faulted: arm b: no line for 3 s" in refused.err
            assert "try: acquire disarm clears the fault" in refused.err
        client.disarm()
        client.arm()
        late = daemon("status", "--wait", "recording", "--timeout", "0.1")
        assert (late.code, "timeout_s" in late.err) == (4, False)  # which is no option of the command
        client.disarm()


def test_a_disk_that_ends_the_recording_is_a_fault(start: Start) -> None:
    daemon = start()
    path = record(daemon)
    (path / "a" / "zarr.json").unlink()
    (path / "a").rename(path / "away")
    with daemon.client() as client:
        status = client.wait({State.FAULTED}, 30)
        assert str(status.fault).startswith("the recording was aborted: write error: ")
        assert "possible" not in str(status.fault)
        assert status.last is not None
        # It is recovered then, from arm B.
        assert status.last.condition in ("ABORTED", "INTERRUPTED")
        assert client.disarm().state is State.IDLE


def test_systemd_is_notified(start: Start, tmp_path_factory: pytest.TempPathFactory) -> None:
    name = tmp_path_factory.mktemp("n") / "n"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(name))
        receiver.settimeout(300)
        daemon = start(NOTIFY_SOCKET=str(name))
        assert receiver.recv(100) == b"READY=1"
        assert receiver.recv(100) == b"WATCHDOG=1"
        assert daemon.end() == 0
        heard = []
        while (word := receiver.recv(100)) == b"WATCHDOG=1":
            heard.append(word)
        assert word == b"STOPPING=1"


def test_wrong_configuration_names_the_key(tmp_path: Path) -> None:
    config = write_rig(tmp_path)
    config.write_text(config.read_text().replace("stages = 8", "stages = 8\nstage = 9"))
    answer = acquire("serve", "--config", config)
    assert answer.code == 2
    assert "geometry.stage" in answer.err
    assert not (tmp_path / "c.sock").exists()
    assert not (tmp_path / "c.sock.lock").exists()
