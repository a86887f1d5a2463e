"""A thread that hangs in the system keeps no process from ending."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

BEGIN = """
import logging, pathlib, sys, threading, time
from acquire.daemon import ending
logging.basicConfig()
fifo, left = map(pathlib.Path, sys.argv[1:])
threading.Thread(target=fifo.read_bytes, name="reader").start()
"""
LEAVE = "ending.LINGER_S = 0.1; sys.exit(ending.leave(7))"
LAST_RESORT = "ending.LastResort(left.unlink).within(0.1); fifo.read_bytes()"


@pytest.mark.parametrize(("end", "code"), [(LEAVE, 7), (LAST_RESORT, 1)])
def test_a_thread_that_hangs_is_named_and_left(tmp_path: Path, end: str, code: int) -> None:
    fifo, left = tmp_path / "fifo", tmp_path / "c.sock"
    os.mkfifo(fifo)
    left.touch()
    ended = subprocess.run(
        [sys.executable, "-c", BEGIN + end, fifo, left],
        check=False,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert ended.returncode == code, ended.stderr
    assert "thread reader at" in ended.stderr
    assert left.exists() == (end is LEAVE)


def test_nothing_is_forced_where_all_threads_end() -> None:
    ended = subprocess.run(
        [
            sys.executable,
            "-c",
            "import threading, time; from acquire.daemon import ending;"
            "last = ending.LastResort(lambda: None); last.within(60); last.within(0.05); last.cancel();"
            "threading.Thread(target=time.sleep, args=(0.3,)).start(); print(ending.leave(0))",
        ],
        check=False,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "0\n", "")


HUNG = """
import asyncio, contextlib, os, pathlib, signal, sys, threading
sys.path.insert(0, sys.argv[2])
from fake_run import FakeRun, rig_config
from acquire.daemon import server
from acquire.daemon.endpoint import Endpoint
from acquire.daemon.service import Service
server.END_S = 0.5
socket = pathlib.Path(sys.argv[1])

class Hung(FakeRun):
    def close(self):
        threading.Event().wait()

async def live():
    service = Service(rig_config(socket.parent), lambda _: Hung())
    daemon = server.Daemon(service, endpoint)
    service.arm()
    asyncio.get_running_loop().call_later(0.1, os.kill, os.getpid(), signal.SIGTERM)
    await daemon.run()

with contextlib.closing(Endpoint(socket)) as endpoint:
    asyncio.run(live())
"""


def test_a_device_that_does_not_let_go_keeps_no_daemon_from_ending(tmp_path: Path) -> None:
    socket = tmp_path / "c.sock"
    ended = subprocess.run(
        [sys.executable, "-c", HUNG, socket, Path(__file__).parent],
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert ended.returncode == 1, ended.stderr
    assert "ending by force: thread MainThread" in ended.stderr
    assert "thread devices_0 at" in ended.stderr
    assert not socket.exists()


STOPPED = """
import asyncio, contextlib, logging, os, pathlib, signal, sys
sys.path.insert(0, sys.argv[2])
from fake_run import FakeRun, rig_config
from acquire.daemon import ending, server
from acquire.daemon.endpoint import Endpoint
from acquire.daemon.service import Service
from acquire.logs import write_log
server.END_S = ending.LINGER_S = 0.5
socket = pathlib.Path(sys.argv[1])
write_log(logging.ERROR)

async def live():
    daemon = server.Daemon(Service(rig_config(socket.parent), lambda _: FakeRun()), endpoint)
    asyncio.get_running_loop().call_later(0.5, logging.getLogger().setLevel, logging.INFO)
    asyncio.get_running_loop().call_later(1.0, os.kill, os.getpid(), signal.SIGTERM)
    await daemon.run()

with contextlib.closing(Endpoint(socket)) as endpoint:
    asyncio.run(live())
"""


def test_a_terminal_that_takes_no_text_keeps_no_daemon_from_ending(tmp_path: Path) -> None:
    """Ctrl-S, or a pager that nobody scrolls: the line "SIGTERM: ending" was waited for without limit."""
    read, write = os.pipe()
    os.set_blocking(write, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(write, bytes(4096))
    os.set_blocking(write, True)
    process = subprocess.Popen(
        [sys.executable, "-c", STOPPED, tmp_path / "c.sock", Path(__file__).parent], stderr=write
    )
    try:
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.wait()
        os.close(read)
        os.close(write)
