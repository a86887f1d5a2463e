"""The real daemon against clients without manners and odd entries in its directory."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import socket
from collections.abc import Iterator
from pathlib import Path

import httpx
import psutil
import pytest
from live_daemon import Daemon
from waiting import until

from acquire.daemon.states import State

IDLE, HALF_SENT = b"", b"POST /mark HTTP/1.1\r\nHost: x\r\nContent-Length: 50\r\n\r\n{"
MOST_LOG_BYTES = 100_000


@pytest.fixture
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    running = Daemon(tmp_path_factory.mktemp("d"))
    yield running
    running.close()


def limit_descriptors(daemon: Daemon, most: int) -> None:
    resource.prlimit(daemon.process.pid, resource.RLIMIT_NOFILE, (most, most))


def hold(daemon: Daemon, count: int, stack: contextlib.ExitStack) -> None:
    """Connections that stay, half of them with the beginning of a request."""
    for number in range(count):
        connection = stack.enter_context(socket.socket(socket.AF_UNIX))
        connection.settimeout(300)
        connection.connect(str(daemon.socket))
        with contextlib.suppress(OSError):  # the daemon was quicker to close it
            connection.sendall(HALF_SENT if number % 2 else IDLE)


def test_two_hundred_connections_do_not_block_the_status(daemon: Daemon) -> None:
    limit_descriptors(daemon, 128)
    with daemon.client() as client, contextlib.ExitStack() as stack:
        client.arm()
        client.start(daemon.home / "x.zarr")
        for _ in range(5):
            hold(daemon, 40, stack)
            assert client.status().state is State.RECORDING
        before = client.status().arms["a"].delivered
        until(lambda: client.status().arms["a"].delivered > before, "lines while connections are held")
        assert psutil.Process(daemon.process.pid).num_fds() < 128
        until(lambda: client.status().disk is not None, "the disk")
        now = client.status()
        assert now.trigger is not None
        assert now.trigger.answers
        assert now.trigger.clock_hz == 90_000_000
        assert now.disk is not None
        assert now.disk.directory == daemon.home
        ended = client.stop().last
    assert ended is not None
    assert (ended.condition, ended.end_reason) == ("GOOD", "stopped")
    assert daemon.log.stat().st_size < MOST_LOG_BYTES


def test_status_is_answered_when_no_descriptor_is_left(daemon: Daemon) -> None:
    used = max(int(entry.name) for entry in Path(f"/proc/{daemon.process.pid}/fd").iterdir())
    open_now = psutil.Process(daemon.process.pid).num_fds()
    with contextlib.ExitStack() as stack:
        hold(daemon, used + 1 - open_now, stack)  # holes below the highest descriptor are filled
        until(lambda: psutil.Process(daemon.process.pid).num_fds() > used, "connections")
        limit_descriptors(daemon, used + 1)
        with daemon.client() as client:
            for _ in range(3):
                assert client.status().state is State.IDLE
            spent = psutil.Process(daemon.process.pid).cpu_times().user
            assert client.status().state is State.IDLE
            assert psutil.Process(daemon.process.pid).cpu_times().user - spent < 0.5  # nothing spins
    assert daemon.log.stat().st_size < MOST_LOG_BYTES


def test_odd_entries_are_reported_and_do_not_keep_the_daemon_from_ending(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    home = tmp_path_factory.mktemp("d")
    os.mkfifo(home / "pipe.zarr")
    (home / "fifo.zarr").mkdir()
    os.mkfifo(home / "fifo.zarr" / "zarr.json")
    attributes = {"format": "acquire-recording/1", "state": "recording", "name": "\x1b[2J\udcff"}
    for name in (b"caf\xe9\x1b[2J.zarr", "b\u202ekcab\n.zarr".encode()):
        odd = Path(os.fsdecode(os.fsencode(home) + b"/" + name))
        odd.mkdir()
        root = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
        (odd / "zarr.json").write_text(json.dumps(root))
    daemon = Daemon(home)
    try:
        with (
            daemon.client() as client,
            httpx.Client(
                transport=httpx.HTTPTransport(uds=str(daemon.socket)), base_url="http://x", timeout=60
            ) as raw,
        ):
            for _ in range(20):
                answer = raw.get("/status")
                assert answer.status_code == 200
                assert all(c.isprintable() for c in answer.text)
            assert client.status().state is State.IDLE
            assert daemon("status").code == 0
        assert daemon.end() == 0
    finally:
        daemon.close()
    assert "Traceback" not in daemon.log.read_text()
