"""Processes of the real daemon are killed: every recording is sealed without a command."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
from live_daemon import Daemon, acquire, until_gone
from waiting import until

from acquire.store import open_recording, verify

Start = Callable[..., Daemon]
KILLED = "recovered: its recorder was killed by SIGKILL"


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start daemons in one directory, one after the other; all are ended after the test."""
    started: list[Daemon] = []

    def start_one() -> Daemon:
        started.append(Daemon(tmp_path))
        return started[-1]

    yield start_one
    for daemon in started:
        daemon.close()


def record(daemon: Daemon, name: str = "x.zarr") -> Path:
    with daemon.client() as client:
        client.arm()
        client.start(daemon.home / name)
    until(lambda: committed(daemon) > 300)
    return daemon.home / name


def committed(daemon: Daemon) -> int:
    with daemon.client() as client:
        now = client.status().recording
        return 0 if now is None else now.committed_lines


def kill_recorder(daemon: Daemon) -> None:
    """Kill it, and wait until another records in its place."""
    with daemon.client() as client:
        before = client.status()
        assert before.recording is not None
        path = before.recording.path
        psutil.Process(before.processes["recorder"]).kill()
        until(lambda: (now := client.status().recording) is not None and now.path != path)
    until(lambda: committed(daemon) > 300)


def recovery(daemon: Daemon, name: str) -> tuple[str, str]:
    """State and text of a recording that was not sealed."""
    with daemon.client() as client:
        found = [one for one in client.status().recoveries if one.path.name == name]
    return (found[0].state, found[0].text) if found else ("unknown", "")


def end_of(path: Path) -> tuple[str, str, str]:
    attributes = open_recording(path).attrs
    return attributes["state"], attributes["run_condition"], attributes["end_reason"]


def kill_all(daemon: Daemon) -> None:
    """Kill the daemon and all its processes at once."""
    family = [psutil.Process(daemon.process.pid), *daemon.children()]
    for process in family:
        process.suspend()  # so that none of them notices that another has gone
    for process in family:
        process.kill()
    daemon.process.wait(300)
    until_gone(family[1:])


def test_a_recorder_is_killed_twice_and_a_stop_leaves_nothing_open(start: Start) -> None:
    daemon = start()
    first = record(daemon)
    kill_recorder(daemon)
    until(lambda: recovery(daemon, "x.zarr")[0] == "recovered")  # while its successor records
    assert end_of(first) == ("sealed", "INTERRUPTED", f"{KILLED}; it continues in x-2.zarr")
    kill_recorder(daemon)
    assert daemon("stop").code == 0
    second, third = (daemon.home / name for name in ("x-2.zarr", "x-3.zarr"))
    assert end_of(second) == ("sealed", "INTERRUPTED", f"{KILLED}; it continues in x-3.zarr")
    assert end_of(third)[::2] == ("sealed", "stopped")
    assert all(verify(path).intact for path in (first, second, third))
    assert open_recording(first).attrs["segments"] == ["x-2.zarr", "x-3.zarr"]
    whole = open_recording(first)
    for segment in whole.segments:
        outage = segment.attrs["segment"]["outage"]
        assert (outage["lines"], outage["cause"]) == (0, "its recorder was killed by SIGKILL")
    last = whole.segments[-1]
    assert whole.cut(last.first_line + last.lines - 50, 50).first_line == last.first_line + last.lines - 50
    assert "not sealed" in daemon("status").out
    until(lambda: "x-2.zarr recovered: " in daemon.log.read_text())


def test_the_recording_of_a_killed_daemon_is_sealed_by_the_next(start: Start) -> None:
    daemon = start()
    path = record(daemon)
    acknowledged = committed(daemon)
    kill_all(daemon)
    assert end_of(path)[0] == "recording"
    again = start()
    until(lambda: end_of(path)[0] == "sealed")
    assert end_of(path) == ("sealed", "INTERRUPTED", "recovered: its writer ended without sealing it")
    assert open_recording(path).lines >= acknowledged
    assert verify(path).intact
    until(lambda: recovery(again, "x.zarr")[0] == "recovered")


def test_a_recording_that_another_process_writes_is_left_alone(start: Start, tmp_path: Path) -> None:
    """On this or another machine: it is reported and not touched. A recording without a writer is sealed."""
    writer_script = Path(__file__).parents[1] / "store" / "writer_process.py"
    live, dead, far = (tmp_path / f"{name}.zarr" for name in ("live", "dead", "far"))
    command = [sys.executable, str(writer_script), str(live), "10000000", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
        try:
            assert writer.stdout is not None
            until(lambda: writer.stdout.readline().startswith("committed 6"))  # type: ignore[union-attr]
            writer.send_signal(signal.SIGSTOP)  # it writes nothing more for now, and lives
            killed = subprocess.Popen([*command[:2], str(dead), *command[3:]], stdout=subprocess.DEVNULL)
            until(lambda: dead.exists() and (dead / "zarr.json").exists())
            killed.kill()
            killed.wait(300)
            shutil.copytree(dead, far)
            root = (far / "zarr.json").read_text()
            (far / "zarr.json").write_text(root.replace('"host":{"name":"', '"host":{"name":"far-'))
            before = [(path / "zarr.json").read_bytes() for path in (live, far)]
            daemon = start()
            until(lambda: recovery(daemon, "dead.zarr")[0] == "recovered")
            until(lambda: "another process" in recovery(daemon, "live.zarr")[1])
            until(lambda: "not written on this machine" in recovery(daemon, "far.zarr")[1])
            assert [(path / "zarr.json").read_bytes() for path in (live, far)] == before
            daemon.end()
            assert "another process is writing it" in acquire("recover", live).err
        finally:
            writer.kill()


def test_deleting_the_root_during_recording_loses_no_line(start: Start) -> None:
    """It is deleted, and then the recorder is killed: in the end all acknowledged lines are there."""
    daemon = start()
    path = record(daemon)
    with daemon.client() as client:
        recorder = psutil.Process(client.status().processes["recorder"])
    recorder.suspend()
    acknowledged = committed(daemon)
    (path / "zarr.json").unlink()
    recorder.kill()
    assert daemon("stop").code == 0
    until(lambda: recovery(daemon, "x.zarr")[0] == "recovered")
    assert open_recording(path).lines >= acknowledged > 0
    assert verify(path).intact


def test_deleting_the_directory_during_recording_is_reported(start: Start) -> None:
    """As when its disk is unmounted: acknowledged lines are counted, and nothing is reported as recovered."""
    daemon = start()
    path = record(daemon)
    path.rename(daemon.home / "moved")
    daemon("stop")
    until(lambda: recovery(daemon, "x.zarr")[0] == "gone")
    _, text = recovery(daemon, "x.zarr")
    assert "lines of it were acknowledged" in text
    assert "not sealed" in daemon("status").out


def test_recordings_outside_the_directory_are_sealed_by_the_next_daemon(
    start: Start, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Wherever it is, and whatever it is called."""
    daemon = start()
    path = tmp_path_factory.mktemp("elsewhere") / "take-1"
    with daemon.client() as client:
        client.arm()
        client.start(path)
    until(lambda: committed(daemon) > 300)
    kill_all(daemon)
    again = start()
    until(lambda: end_of(path)[0] == "sealed")
    until(lambda: recovery(again, "take-1")[0] == "recovered")
    assert verify(path).intact
