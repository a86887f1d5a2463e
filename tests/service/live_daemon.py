"""The real daemon as a process of its own, and commands as a user gives them."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
from answers import Answer

from acquire.client import Client
from acquire.config import builtin_directory

COMMAND = (str(Path(sys.executable).with_name("acquire")),)
OBEY_PERMISSIONS = (
    sys.executable,
    "-c",
    "import ctypes, os, sys; PR_CAPBSET_DROP, CAP_DAC_OVERRIDE = 24, 1;"
    "ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, 0, 0, 0);"
    "os.execv(sys.argv[1], sys.argv[1:])",
)
"""Runs a command without what lets root write to any directory: tests may run as root."""
END_S = 300.0

RIG = """
name = "small"
[geometry]
stages = 8
substeps = 2
[trigger]
clock_hz = 90_000_000
substep_ticks = 4500         # lines at 10 kHz
tag_every_lines = 64
[cameras.a]
serial = "A"
pixel_format = "Mono12"
responsivity_dn = 40.0
[cameras.b]
serial = "B"
pixel_format = "Mono12"
responsivity_dn = 40.0
[stream]
block_lines = 64
ring_slots = 4096            # 26 s: the disk of a busy host may pause
[recording]
directory = "{directory}"
chunk_lines = 256
[control]
socket = "{socket}"
[simulation]
scene = "{scene}"
"""
LINE_RATE_HZ = 10_000
SUBSTEPS = 2


def acquire(*words: object, socket: Path | None = None, cwd: Path | None = None) -> Answer:
    """Run one command to its end."""
    environment = {key: value for key, value in os.environ.items() if key != "ACQUIRE_SOCKET"}
    if socket is not None:
        environment["ACQUIRE_SOCKET"] = str(socket)
    ended = subprocess.run(
        [*COMMAND, *map(str, words)],
        check=False,
        capture_output=True,
        text=True,
        timeout=300,
        env=environment,
        cwd=cwd,
    )
    assert "Traceback" not in ended.stderr, ended.stderr
    return Answer(ended.returncode, ended.stdout, ended.stderr)


class Daemon:
    """A running ``acquire serve``, in a directory of its own."""

    def __init__(self, home: Path, *settings: str, **environment: str) -> None:
        self.home = home
        self.socket = home / "c.sock"
        self.log = home / "serve.log"
        self.config = write_rig(home)
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [*OBEY_PERMISSIONS, *COMMAND, "serve", "--config", str(self.config), *_set(settings)],
                stderr=log,
                stdout=log,
                env=os.environ | environment,
                start_new_session=True,
            )
        self.until_listening()

    def __call__(self, *words: object) -> Answer:
        return acquire(*words, socket=self.socket, cwd=self.home)

    @contextlib.contextmanager
    def client(self) -> Iterator[Client]:
        with Client(self.socket) as client:
            yield client

    def until_listening(self) -> None:
        deadline = time.monotonic() + END_S
        while f"listening on {self.socket} (process {self.process.pid})" not in self.log.read_text():
            assert self.process.poll() is None, self.log.read_text()
            assert time.monotonic() < deadline
            time.sleep(0.02)

    def children(self) -> list[psutil.Process]:
        """Every process that the daemon started, directly or not."""
        return psutil.Process(self.process.pid).children(recursive=True)

    def workers(self) -> list[psutil.Process]:
        """Recorder and grabbers, in the order in which they were started: the children of the nursery."""
        (nursery,) = psutil.Process(self.process.pid).children()
        return sorted(nursery.children(), key=lambda child: child.pid)

    def end(self, number: signal.Signals = signal.SIGTERM) -> int:
        """Send a signal and wait; the exit code."""
        self.process.send_signal(number)
        return self.process.wait(END_S)

    def close(self) -> None:
        """End everything that belongs to the daemon, whatever happened in the test."""
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(END_S)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait(END_S)


def _set(settings: tuple[str, ...]) -> list[str]:
    return [word for setting in settings for word in ("--set", setting)]


def write_rig(home: Path) -> Path:
    path = home / "rig.toml"
    scene = builtin_directory() / "scene-leds.toml"
    path.write_text(RIG.format(directory=home, socket=home / "c.sock", scene=scene))
    return path


def until_gone(processes: list[psutil.Process]) -> None:
    """Fail unless the processes end by themselves in bounded time."""
    _, alive = psutil.wait_procs(processes, timeout=300)
    assert not alive
