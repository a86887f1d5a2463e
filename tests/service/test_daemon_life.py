"""One daemon, driven by commands: each test finds it idle and leaves it idle."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from live_daemon import END_S, LINE_RATE_HZ, SUBSTEPS, Daemon, acquire
from waiting import until

from acquire.config import load_rig
from acquire.daemon.endpoint import lock_path
from acquire.daemon.states import SEALED, State
from acquire.errors import UsageError
from acquire.store import open_recording


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    daemon = Daemon(tmp_path_factory.mktemp("d"))
    with daemon.client() as client:  # the first run starts a helper process that stays with the daemon
        client.arm()
        client.disarm()
    yield daemon
    daemon.close()


@pytest.fixture
def daemon(running: Daemon) -> Iterator[Daemon]:
    with running.client() as client:
        assert client.status().state is State.IDLE
    yield running
    with running.client() as client:
        if client.status().state is State.RECORDING:
            client.stop()
        if client.status().state is not State.IDLE:
            client.disarm()


def test_whole_life(daemon: Daemon) -> None:
    """A recording until stopped: what commands and log say, and that the file is what was recorded."""
    assert daemon("arm", "--json").json["state"] == "armed"
    assert "armed" in daemon("status").out
    begun = daemon("start", "life.zarr", "--json").json
    assert begun["state"] == "recording"
    assert begun["recording"]["path"] == str(daemon.home / "life.zarr")
    stopped = daemon("stop", "--json")
    assert stopped.code == 0, stopped.err
    last = stopped.json["last"]
    assert (last["condition"], last["end_reason"]) == ("GOOD", "stopped")
    recording = open_recording(daemon.home / "life.zarr")
    assert (recording.state, recording.lines) == ("sealed", last["lines"])
    assert recording.first_line == begun["recording"]["first_line"]
    assert recording.attrs["run_id"] == begun["run_id"]
    assert recording.attrs["config"] == load_rig(daemon.config).model_dump(mode="json")

    def changes() -> list[str]:
        lines = daemon.log.read_text().splitlines()  # a busy host is reported in warnings
        entries = [line.split("INFO ")[1].split(" (")[0] for line in lines if "INFO " in line]
        return [words for words in entries if "→" in words]

    wanted = ["idle → armed", "armed → recording", "recording → draining", "draining → armed"]
    # A thread of its own writes the log: an entry may come after the answer to its command.
    until(lambda: changes()[-4:] == wanted, limit_s=30)


def test_a_recording_continues_in_a_segment(daemon: Daemon) -> None:
    """Another day, the same recording: existing lines are not touched, and the outage is reported."""
    assert daemon("arm").code == 0
    for resume in ((), ("--resume",)):
        begun = daemon("start", "days.zarr", "--lines", 300, *resume, "--json")
        assert begun.code == 0, begun.err
        assert daemon("status", "--wait", "sealed", "--timeout", 300).code == 0
    assert begun.json["recording"]["path"] == str(daemon.home / "days-2.zarr")
    first = open_recording(daemon.home / "days.zarr")
    (second,) = first.segments
    assert (first.lines, second.lines) == (300, 300)
    assert second.attrs["run_id"] == first.attrs["run_id"]
    assert second.attrs["segment"]["of"] == "days.zarr"
    for path in ("days.zarr", "days-2.zarr"):
        assert daemon("verify", path).code == 0
    shown = daemon("info", "days-2.zarr").out
    assert "days.zarr after line" in shown
    refused = daemon("start", "none.zarr", "--resume")
    assert (refused.code, "does not exist" in refused.err) == (2, True)
    assert daemon("disarm").code == 0


def test_line_budget(daemon: Daemon) -> None:
    """The recording ends itself; both arms hold exactly the budget, contiguous, with the run's code."""
    with daemon.client() as client:
        client.arm()
    assert daemon("start", "budget.zarr", "--lines", 700).code == 0
    status = daemon("status", "--wait", "sealed", "--timeout", 300, "--json").json
    assert status["last"] == {
        "path": str(daemon.home / "budget.zarr"),
        "lines": 700,
        "condition": "GOOD",
        "end_reason": "line budget reached",
    }
    recording = open_recording(daemon.home / "budget.zarr")
    for arm in ("a", "b"):
        camera = recording.camera(arm)
        assert camera.lines.shape == (700, 8)
        assert np.array_equal(camera.code_index[:], SUBSTEPS * camera.line_number)
        assert not np.any(camera.flags[:] & 1)
    code = load_rig(daemon.config).code.build().bits(SUBSTEPS * recording.first_line, SUBSTEPS * 700)
    packed = np.packbits(code.reshape(700, SUBSTEPS), axis=1, bitorder="little")[:, 0]
    assert np.array_equal(recording.camera("a").code[:], packed)


def test_takes_of_one_run_reach_back_and_every_line_is_accounted_for_once_idle(daemon: Daemon) -> None:
    """The second take holds lines of the first as well; what the ring does not hold any more is refused."""
    with daemon.client() as client:
        client.arm()
        client.start(daemon.home / "take-1.zarr", duration_s=4.0)
        first = client.wait(SEALED, END_S)
        # Into the second half of the first, however long a busy host took since its end.
        begun = open_recording(daemon.home / "take-1.zarr").first_line
        back = client.status().arms["a"].delivered - (begun + 2.0 * LINE_RATE_HZ)
        second = client.start(daemon.home / "take-2.zarr", pre_s=back / LINE_RATE_HZ, post_s=0.05)
        again = client.wait(SEALED, END_S)
        assert (first.run_id, again.run_id) == (second.run_id, second.run_id)
        with pytest.raises(UsageError, match="which both rings hold now"):
            client.start(daemon.home / "take-3.zarr", pre_s=3600)
        assert client.status().possible == ["start", "mark", "disarm"]
        arms = client.disarm().arms
    takes = [open_recording(daemon.home / f"take-{number}.zarr") for number in (1, 2)]
    assert takes[0].first_line <= takes[1].first_line < takes[0].first_line + takes[0].lines  # they overlap
    end = takes[1].first_line + takes[1].lines
    for arm in arms.values():
        ledger = arm.ledger
        assert ledger is not None
        assert ledger.balanced
        assert ledger.stored == end - takes[0].first_line
        assert arm.delivered == arm.preroll + arm.discarded + arm.lost["ring_full"] + ledger.stored
        assert arm.ring.fill == 0
    kept = range(takes[1].first_line - takes[0].first_line, takes[0].lines)
    for name in ("a", "b"):
        old, new = (take.camera(name).lines[:] for take in takes)
        assert np.array_equal(old[kept.start :], new[: len(kept)])


def test_refusals_leave_the_daemon_armed(daemon: Daemon) -> None:
    """Wrong state, existing and unwritable places: named, nothing touched, and the next start works."""
    precious, closed, absent = (daemon.home / name for name in ("precious.zarr", "closed", "absent"))
    precious.mkdir()
    (precious / "data").write_text("precious")
    before = precious.stat().st_mtime_ns
    closed.mkdir(mode=0o500)
    with daemon.client() as client:
        client.arm()
        refused = {path: daemon("start", path) for path in (precious, closed / "x.zarr", absent / "x.zarr")}
        again = daemon("arm")
        assert client.status().state is State.ARMED
    assert (again.code, "possible: start, mark, disarm" in again.err) == (4, True)
    assert {path: answer.code for path, answer in refused.items()} == dict.fromkeys(refused, 2)
    assert "exists" in refused[precious].err
    assert str(closed) in refused[closed / "x.zarr"].err
    assert str(absent) in refused[absent / "x.zarr"].err
    assert (precious / "data").read_text() == "precious"
    assert precious.stat().st_mtime_ns == before
    assert not list(closed.iterdir())
    assert not absent.exists()
    for odd in ("x" * 300, "\udcff.zarr"):
        answer = daemon("start", odd)
        assert (answer.code, "path" in answer.err) == (2, True)
        with daemon.client() as client:
            assert client.status().state is State.ARMED
    begun = daemon("start", "--duration", 0.05, "--json").json
    path = Path(begun["recording"]["path"])
    assert path.parent == daemon.home
    assert path.name.startswith("small-2")
    with daemon.client() as client:
        client.wait(SEALED, 30)
    assert open_recording(path).lines == 0.05 * LINE_RATE_HZ


def test_commands_while_idle(daemon: Daemon) -> None:
    for command in ("start", "stop", "disarm"):
        answer = daemon(command)
        assert answer.code == 4
        assert f"cannot {command} while idle" in answer.err
        assert "possible: arm" in answer.err


def test_second_daemon_is_refused(daemon: Daemon) -> None:
    socket_inode = daemon.socket.stat().st_ino
    answer = acquire("serve", "--config", daemon.config)
    assert answer.code == 4
    assert f"process {daemon.process.pid}" in answer.err
    assert daemon.socket.stat().st_ino == socket_inode
    with daemon.client() as client:
        assert client.status().pid == daemon.process.pid


def test_second_daemon_of_the_rig_is_refused_on_another_socket(daemon: Daemon) -> None:
    """Both kept their lists of open recordings in one file, and each overwrote the other's."""
    answer = acquire("serve", "--config", daemon.config, "--socket", daemon.home / "second.sock")
    assert answer.code == 4
    assert f"another daemon (process {daemon.process.pid}) of a rig named small records into" in answer.err
    assert "--set name=NAME" in answer.err
    assert not (daemon.home / "second.sock").exists()


@pytest.mark.parametrize("what", ["socket", "socket and lock"])
def test_a_socket_that_is_removed_comes_back(daemon: Daemon, what: str) -> None:
    """What empties /tmp or XDG_RUNTIME_DIR made a daemon unreachable until it was restarted."""
    with daemon.client() as client:
        follower = client.events(history=True, timeout_s=60)
        before = next(follower)  # by a connection that exists, and goes on
        daemon.socket.unlink()
        if "lock" in what:
            lock_path(daemon.socket).unlink()
        until(daemon.socket.exists, limit_s=30)
        assert daemon("status").code == 0
        told = next(news for news in follower if news.kind == "trouble")
        assert told.id.partition("-")[0] == before.id.partition("-")[0]
        assert "was removed by another program, and is made again" in told.text
        assert client.status().pid == daemon.process.pid
    refused = acquire("serve", "--config", daemon.config)
    assert (refused.code, f"process {daemon.process.pid}" in refused.err) == (4, True)


def test_socket_is_private(daemon: Daemon) -> None:
    assert stat.S_IMODE(daemon.socket.stat().st_mode) == 0o600
    assert daemon.socket.stat().st_uid == os.geteuid()


def test_wait_has_a_time_limit(daemon: Daemon) -> None:
    answer = daemon("status", "--wait", "recording", "--timeout", 0.1)
    assert answer.code == 4
    assert "still idle" in answer.err
