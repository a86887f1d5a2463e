"""The instrument of `tools/shifts.py`: a daemon and its page, restarted when they die."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Iterable
from pathlib import Path

import psutil

from acquire.client import Client
from acquire.config import builtin_directory
from acquire.errors import AcquireError
from acquire.store import open_recording
from acquire.web.tokens import load_tokens
from tools.soak import MOST_GROWTH_MB, Soak, own_mb

RIG = """
name = "night"
[geometry]
stages = 8
substeps = 2
[trigger]
substep_ticks = 4500         # lines at 10 kHz
tag_every_lines = 64
[cameras.a]
driver = "pattern"
serial = "A"
[cameras.b]
driver = "pattern"
serial = "B"
[stream]
block_lines = 64
ring_slots = 1024
reopen_s = 30.0
[recording]
directory = "{home}"
chunk_lines = 256
[control]
socket = "{home}/c.sock"
[web]
port = {port}
[simulation]
scene = "{scene}"
"""
SAMPLE_S = 2.0
BACK_S = 120.0
"""systemd would not wait longer for any process."""
END_S = 60.0
LONG_S = 480.0
"""A shorter life may still load modules and fill bounded caches: its growth is reported but not judged."""
CALM_S = 20.0
"""Wait after the last stranger has gone, so that unclosed connections time out."""
MOST_MORE = (4, 10)
"""Allowed descriptors and threads beyond those of a new process; thread pools fill once."""
_SHARED = re.compile(r"/dev/shm/(\S+)")
PART = re.compile(r"-\d+$")


class Host:
    """One directory, one daemon at a time."""

    def __init__(self, home: Path) -> None:
        self.home, self.socket = home, home / "c.sock"
        self._mark = uuid.uuid4().hex
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port: int = free.getsockname()[1]
        self.address = f"http://127.0.0.1:{self.port}"
        scene = builtin_directory() / "scene-leds.toml"
        (home / "rig.toml").write_text(RIG.format(home=home, port=self.port, scene=scene))
        self._log = home / "serve.log"
        self._shared: set[str] = set()
        self._lock = threading.Lock()
        self._soak = Soak()
        self._handles: dict[str, list[tuple[int, int]]] = {}
        self._daemon = self._serve()
        self.restarts = 0
        self.slowest_back_s = 0.0
        self._until_answers()
        self.token = load_tokens(self.socket.with_name(self.socket.name + ".tokens")).operator

    def _serve(self) -> subprocess.Popen[bytes]:
        words = [sys.executable, "-m", "acquire", "serve", "--config", str(self.home / "rig.toml")]
        with self._log.open("ab") as log:
            return subprocess.Popen(
                words, stdout=log, stderr=log, cwd=self.home, env=os.environ | {"ACQUIRE_NIGHT": self._mark}
            )

    @property
    def pid(self) -> int:
        return self._daemon.pid

    @property
    def page_pid(self) -> int | None:
        try:
            children = psutil.Process(self.pid).children()
            return next((one.pid for one in children if "web" in one.cmdline()), None)
        except psutil.Error:
            return None

    def keep(self, ending: threading.Event) -> None:
        """Restart the daemon as a supervisor does, and record the resources used, until the end."""
        while not ending.wait(SAMPLE_S):
            if self._daemon.poll() is not None:
                begun_s = time.monotonic()
                self._daemon = self._serve()
                self._until_answers()
                self.restarts += 1
                self.slowest_back_s = max(self.slowest_back_s, time.monotonic() - begun_s)
            for name, pid in (("daemon", self.pid), ("page", self.page_pid)):
                if pid is not None:
                    self._note(f"{name} {pid}", pid)

    def _note(self, name: str, pid: int) -> None:
        try:
            process = psutil.Process(pid)
            self._shared |= mapped(each.pid for each in (process, *process.children(recursive=True)))
            self._handles.setdefault(name, []).append((process.num_fds(), process.num_threads()))
        except psutil.Error:
            return
        if own := own_mb(pid):
            self._soak.memory.setdefault(name, []).append((time.monotonic(), own))

    def answers(self) -> bool:
        try:
            return Client(self.socket).status().pid == self._daemon.pid
        except AcquireError:
            return False

    def _until_answers(self) -> None:
        """Wait until it listens, or is dead again, which `keep` notices."""
        deadline = time.monotonic() + BACK_S
        while self._daemon.poll() is None and not self.answers():
            if time.monotonic() > deadline:
                raise TimeoutError(f"the daemon did not come back within {BACK_S:g} s: {self._log}")
            time.sleep(0.1)

    # ---- recordings

    def first_part(self, path: Path) -> Path:
        """First recording of a segment: take-3-2.zarr belongs to take-3.zarr."""
        stem = path.stem
        return path if stem.count("-") < 2 else path.with_name(PART.sub("", stem) + ".zarr")

    def unsealed(self) -> list[str]:
        found = []
        for path in self.home.glob("take-*.zarr"):
            try:
                if open_recording(path).state != "sealed":
                    found.append(path.name)
            except AcquireError:
                found.append(path.name)
        return found

    # ---- the end

    def failures_in_log(self) -> list[str]:
        """Unforeseen failures, with the last one's text: the log's directory is temporary."""
        text = self._log.read_text(errors="replace")
        count, last = text.count("Traceback"), text.rfind("Traceback")
        begin = text.rfind("\n", 0, text.rfind("\n", 0, last))
        return [f"the log has {count} tracebacks; the last one:{text[begin : last + 4000]}"] if count else []

    def judge(self) -> list[str]:
        """Memory of long lives; descriptors and threads compared with those of new processes."""
        for name, noted in self._soak.memory.items():
            grown = self._soak.growth_mb(name)
            if grown is not None and grown > MOST_GROWTH_MB and noted[-1][0] - noted[0][0] > LONG_S:
                self._soak.wrong.append(f"{name}: grew by {grown:.1f} MB in the second half of its life")
        wrong = list(self._soak.wrong)
        time.sleep(CALM_S)
        old = self._used()
        self._daemon.send_signal(signal.SIGTERM)
        self._daemon.wait(END_S)
        self._daemon = self._serve()
        self._until_answers()
        with Client(self.socket) as client:
            client.arm(force=True)
            client.start(self.home / "last.zarr", lines=1000)
            client.wait(("armed",), END_S)  # type: ignore[arg-type]
            client.disarm()
        time.sleep(CALM_S)
        new = self._used()
        for name in old:
            for what, most, before, now in zip(
                ("descriptors", "threads"), MOST_MORE, new[name], old[name], strict=True
            ):
                if now > before + most:
                    wrong.append(f"{name}: {now} {what} after the night, {before} in a new one")
        self._ends = old, new
        return wrong

    def _used(self) -> dict[str, tuple[int, int]]:
        found = {}
        for name, pid in (("daemon", self.pid), ("page", self.page_pid)):
            process = psutil.Process(pid)
            found[name] = (process.num_fds(), process.num_threads())
        return found

    def close(self) -> list[str]:
        """End the daemon, and return what outlives it."""
        self._daemon.send_signal(signal.SIGTERM)
        try:
            self._daemon.wait(END_S)
        except subprocess.TimeoutExpired:
            self._daemon.kill()
            self._daemon.wait()
            return [f"the daemon did not end within {END_S:g} s"]
        deadline = time.monotonic() + CALM_S
        while (left := self._processes()) and time.monotonic() < deadline:
            time.sleep(0.2)
        wrong = [f"process {each.pid} is left: {_words(each)}" for each in left]
        return wrong + [f"shared memory is left: {name}" for name in left_in_shared_memory(self._shared)]

    def _processes(self) -> list[psutil.Process]:
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error):
                if process.environ().get("ACQUIRE_NIGHT") == self._mark:
                    found.append(process)
        return found

    def rows(self) -> list[str]:
        rows = [f"restarts    {self.restarts} of the daemon; the slowest took {self.slowest_back_s:.1f} s"]
        for role in ("daemon", "page"):
            lives = {name: noted for name, noted in self._soak.memory.items() if name.startswith(role)}
            longest = max(lives, key=lambda name: len(lives[name]))
            noted = lives[longest]
            grown = self._soak.growth_mb(longest)
            most = max(mb for each in lives.values() for _, mb in each)
            handles = max(h for each in lives for h, _ in self._handles[each])
            rows.append(
                f"memory      {role}: {len(lives)} lives, {most:.1f} MB and {handles} descriptors at most;"
                f" the longest, {(noted[-1][0] - noted[0][0]) / 60:.0f} min, from {noted[0][1]:.1f} to"
                f" {noted[-1][1]:.1f} MB, "
                + ("too short to judge" if grown is None else f"{grown:+.2f} MB in its second half")
                + f" (more than {MOST_GROWTH_MB:g} would be wrong)"
            )
        if ends := getattr(self, "_ends", None):
            rows.append(f"in the end  (descriptors, threads) {ends[0]}; of new processes {ends[1]}")
        return rows


def _words(process: psutil.Process) -> str:
    try:
        return " ".join(process.cmdline())[-120:]
    except psutil.Error:
        return "?"


def mapped(pids: Iterable[int]) -> set[str]:
    """Names of shared memory in /dev/shm that these processes have mapped; others' memory is not our leak."""
    found = set()
    for pid in pids:
        with contextlib.suppress(OSError):
            maps = Path(f"/proc/{pid}/maps").read_text(encoding="utf-8", errors="replace")
            found |= set(_SHARED.findall(maps))
    return found


def left_in_shared_memory(ours: set[str]) -> set[str]:
    """Those of our names that are still there: a process that maps a semaphore usually removes its name."""
    return {name for name in ours if Path("/dev/shm", name).exists()}
