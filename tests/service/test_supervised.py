"""Under a supervisor that does what systemd does with our unit: killed, hung or out of memory, the service
comes back.

The supervisor here knows what the unit says: ready by a datagram, a word within the watchdog's time,
restarted when it ends otherwise than by itself, and what was left of it ended before.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from live_daemon import COMMAND, write_rig
from memory_group import MemoryGroup

from acquire.client import Client, State
from acquire.daemon.messages import Status
from acquire.errors import AcquireError

LIMIT_S = 300.0
WATCHDOG_S = 8.0
"""The unit says 30. One that is merely slow is restarted once more, and no harm is done."""


class Supervisor:
    """Runs one service; `turn` is called again and again."""

    def __init__(self, home: Path, *settings: str, group: MemoryGroup | None = None) -> None:
        self._group = group
        enter = [] if group is None else ["sh", "-c", f'echo $$ > {group.path}/cgroup.procs; exec "$@"', "sh"]
        self._words = [*enter, *COMMAND, "serve", "--config", str(write_rig(home))]
        self._words += [word for setting in settings for word in ("--set", setting)]
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(home / "notify"))
        self._socket.settimeout(0.05)
        self._home = home
        self.lives = 0
        self.ends: list[int] = []
        """How each life ended that is over."""
        self._start()

    def _start(self) -> None:
        self.lives += 1
        self.is_ready, self._heard_s = False, time.monotonic() + LIMIT_S
        environment = os.environ | {"NOTIFY_SOCKET": str(self._home / "notify")}
        with (self._home / "serve.log").open("ab") as log:
            self.process = subprocess.Popen(self._words, stderr=log, env=environment, start_new_session=True)

    def turn(self) -> None:
        with contextlib.suppress(TimeoutError):
            said = self._socket.recv(256).decode()
            self.is_ready |= "READY=1" in said
            if self.is_ready:
                self._heard_s = time.monotonic()
        if self.is_ready and time.monotonic() - self._heard_s > WATCHDOG_S:
            os.killpg(self.process.pid, signal.SIGKILL)  # systemd ends what is left of the group, too
            self.process.wait()
        if self.process.poll() is not None:
            self.ends.append(self.process.returncode)
            for pid in [] if self._group is None else self._group.pids:
                with contextlib.suppress(ProcessLookupError):  # it ended with its owner
                    os.kill(pid, signal.SIGKILL)  # as systemd does, where the recorder might still seal
            self._start()

    def close(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.process.pid, signal.SIGCONT)
            self.process.terminate()
        self.process.wait(LIMIT_S)
        self._socket.close()


@pytest.fixture
def supervisor(tmp_path: Path) -> Iterator[Supervisor]:
    with contextlib.closing(Supervisor(tmp_path, 'service.begin="recording"', "service.retry_s=0.5")) as made:
        yield made


def until_recording(supervisor: Supervisor, client: Client, life: int) -> Status:
    deadline = time.monotonic() + LIMIT_S
    while True:
        supervisor.turn()
        assert time.monotonic() < deadline
        if supervisor.lives < life or not supervisor.is_ready:
            continue
        with contextlib.suppress(AcquireError):
            status = client.status()
            if status.state is State.RECORDING and status.recording and status.recording.committed_lines:
                return status


def test_a_killed_or_hanging_daemon_restarts_recovers_and_continues_recording(
    supervisor: Supervisor, tmp_path: Path
) -> None:
    client = Client(tmp_path / "c.sock")
    first = until_recording(supervisor, client, 1)
    os.kill(supervisor.process.pid, signal.SIGKILL)
    second = until_recording(supervisor, client, 2)
    assert first.recording is not None
    assert second.recording is not None
    assert first.recording.path != second.recording.path
    deadline = time.monotonic() + LIMIT_S
    while client.open(first.recording.path).state != "sealed":  # by its recorder, or recovered
        supervisor.turn()
        assert time.monotonic() < deadline
    assert client.open(first.recording.path).lines >= first.recording.committed_lines

    os.kill(supervisor.process.pid, signal.SIGSTOP)  # it hangs: the watchdog hears nothing
    third = until_recording(supervisor, client, 3)
    assert third.recording is not None
    assert third.recording.path not in (first.recording.path, second.recording.path)

    client.stop()
    client.disarm()  # the operator's word is the last: nothing begins by itself any more
    time.sleep(1.0)
    assert client.status().state is State.IDLE


@pytest.mark.needs_memory_group
@pytest.mark.parametrize("victim", ["the kernel's choice", "daemon", "recorder", "a"])
def test_recording_continues_after_the_kernel_kills_for_memory(tmp_path: Path, victim: str) -> None:
    """The kernel kills one of its processes: the daemon replaces a worker, the supervisor the daemon."""
    settings = ('service.begin="recording"', "service.retry_s=0.5")
    client = Client(tmp_path / "c.sock")
    with (
        MemoryGroup() as group,
        contextlib.closing(Supervisor(tmp_path, *settings, group=group)) as supervisor,
    ):
        first = until_recording(supervisor, client, 1)
        assert first.recording is not None
        pids = {"daemon": supervisor.process.pid, **first.processes}
        assert set(pids.values()) <= set(group.pids)
        with ThreadPoolExecutor(1) as threads:
            running_out = threads.submit(group.run_out, pids.get(victim))
            while not running_out.done():
                supervisor.turn()
            gone = running_out.result()
        deadline = time.monotonic() + LIMIT_S
        while not goes_on(client, first, without=gone):
            supervisor.turn()
            assert time.monotonic() < deadline
        # one who runs out of memory may be slow, too, or the kernel take a second: the daemon is killed then
        # by the watchdog or the kernel, but it never ends for the sake of a worker
        assert supervisor.ends == [-signal.SIGKILL] * (supervisor.lives - 1)
        assert supervisor.lives > 1 or pids["daemon"] not in gone
        after = until_recording(supervisor, client, supervisor.lives)
        assert after.recording is not None
        again = client.stop()
        assert again.last is not None
        assert again.last.lines > 0
        before = client.open(first.recording.path)
        assert before.lines >= first.recording.committed_lines  # nothing that was committed is lost
        while client.open(first.recording.path).state != "sealed":
            supervisor.turn()
            assert time.monotonic() < deadline
        client.disarm()


def goes_on(client: Client, first: Status, without: set[int]) -> bool:
    """More is recorded than at ``first``, and ended processes are replaced."""
    try:
        now = client.status()
    except AcquireError:
        return False
    if (
        now.state is not State.RECORDING
        or now.recording is None
        or {now.pid, *now.processes.values()} & without
    ):
        return False
    assert first.recording is not None
    known = first.recording.committed_lines if now.recording.path == first.recording.path else 0
    return now.recording.committed_lines > known
