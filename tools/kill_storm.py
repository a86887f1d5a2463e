"""Kill processes of a recording daemon at random (kill -9), and check that no acknowledged line is lost.

::

    arm, start ─▶ stop the recorder for a while, as a disk does, and let it continue or kill it
               ─▶ kill a process at random ─▶ another takes its place ─▶ … ─▶ stop, or kill the daemon
               ─▶ the daemon, or the next one, seals the rest ─▶ every row holds its line, or is flagged and
                  listed; nothing acknowledged is missing

``python tools/kill_storm.py --kills 200`` prints what was killed and what was found. The cameras show a
pattern without zeros, so that a row that was never written is noticed.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acquire.client import Client
from acquire.config import builtin_directory
from acquire.daemon.states import SEALED, State
from acquire.errors import AcquireError
from acquire.lines import ARMS, LineFlag
from acquire.pattern import Pattern
from acquire.store import open_recording

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.daemon.messages import Status

RIG = """
name = "storm"
[geometry]
stages = 8
substeps = 2
[trigger]
substep_ticks = 2250         # lines at 20 kHz
tag_every_lines = 64
[cameras.a]
driver = "pattern"
serial = "A"
[cameras.b]
driver = "pattern"
serial = "B"
[stream]
block_lines = 64
ring_slots = 4096
reopen_s = 30.0
[recording]
directory = "{home}"
chunk_lines = 256
[control]
socket = "{home}/c.sock"
[simulation]
scene = "{scene}"
"""
VICTIMS = ("recorder", "a", "b")
STOPS = 0.3
"""Probability that the recorder is stopped before something is killed."""
KILLS_PER_RUN = 4
"""Fewer than the successors that one process may have."""
WAIT_S = 90.0
LONGEST_PAUSE_S = 0.5
ROOT_LOST = 0.5
"""Share of the killed recorders that lose the root of their recording as well."""
LONGEST_STOP_S = 3.0
"""Pause of a recorder: shorter than what the rings hold."""


@dataclass
class Outcome:
    """What was killed, and what was wrong with the recordings afterwards (nothing, if all is well)."""

    killed: Counter[str] = field(default_factory=Counter)
    roots: int = 0
    """Recordings whose zarr.json was deleted under their recorder."""
    stopped: int = 0
    recordings: int = 0
    lines: int = 0
    missing: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        rows = [
            f"killed      {sum(self.killed.values())}: {dict(self.killed)}; {self.roots} roots deleted",
            f"stopped     {self.stopped} times, for up to {LONGEST_STOP_S:g} s",
            f"recordings  {self.recordings}, {self.lines} lines of each arm",
            f"missing     {dict(self.missing) or 0} (flagged and listed)",
            f"faults      {len(self.faults)}",
        ]
        return "\n".join([*rows, *self.faults])


class Storm:
    """Seeded runs and kills; all files are below ``home``."""

    def __init__(self, home: Path, seed: int) -> None:
        self._home = home
        self._chance = random.Random(seed)
        self._config = home / "rig.toml"
        scene = builtin_directory() / "scene-leds.toml"
        self._config.write_text(RIG.format(home=home, scene=scene))
        self._socket = home / "c.sock"
        self._daemon: subprocess.Popen[bytes] | None = None
        self.outcome = Outcome()

    def run(self, kills: int) -> Outcome:
        """Kill this many processes."""
        try:
            while (left := kills - self.outcome.killed.total()) > 0:
                self._one_run(min(left, KILLS_PER_RUN))
        finally:
            self.close()
        return self.outcome

    def close(self) -> None:
        if self._daemon is not None:
            self._daemon.send_signal(signal.SIGTERM)
            self._daemon.wait(WAIT_S)
            self._daemon = None

    def _one_run(self, kills: int) -> None:
        daemon = self._serve()
        path = self._home / f"r{self.outcome.recordings}.zarr"
        with Client(self._socket) as client:
            client.arm(force=True)  # the rate that a busy host sustains does not matter here
            client.start(path)
            _until(lambda: _committed(client.status()) > 0)
            for _ in range(kills - 1):
                self._kill_one(client)
            acknowledged = client.status()
            last = self._chance.choice(["stop", "daemon", *VICTIMS])
            if last == "daemon":
                self._end_daemon(daemon, acknowledged)
            else:
                self._end_run(client, last)
        self._serve()  # a killed daemon has left the last recovery to the next one
        _until(lambda: not _open_parts(path))
        self._examine(path, acknowledged)

    def _end_run(self, client: Client, last: str) -> None:
        """Stop, in some cases just after a process was killed."""
        if last in VICTIMS:
            self._kill_one(client)
        status = client.status()
        if status.state is State.RECORDING:
            client.stop()
        if client.wait(SEALED, WAIT_S).state is State.ARMED:
            client.disarm()

    def _end_daemon(self, daemon: subprocess.Popen[bytes], status: Status) -> None:
        time.sleep(self._chance.uniform(0, LONGEST_PAUSE_S))
        self.outcome.killed["daemon"] += 1
        daemon.kill()
        daemon.wait(WAIT_S)
        self._daemon = None
        _until(lambda: not any(Path("/proc", str(pid)).exists() for pid in status.processes.values()))

    def _kill_one(self, client: Client) -> None:
        """Kill a process at a random moment, and wait until another has taken its place."""
        time.sleep(self._chance.uniform(0, LONGEST_PAUSE_S))
        name, before = self._chance.choice(VICTIMS), client.status()
        recorder = before.processes["recorder"]
        if self._chance.random() < STOPS:
            self.outcome.stopped += 1
            os.kill(recorder, signal.SIGSTOP)
            time.sleep(self._chance.uniform(0, LONGEST_STOP_S))
            if name != "recorder":  # else it is killed as it is
                os.kill(recorder, signal.SIGCONT)
        if name == "recorder" and before.recording is not None and self._chance.random() < ROOT_LOST:
            os.kill(before.processes[name], signal.SIGSTOP)  # otherwise its next commit would write a new one
            (before.recording.path / "zarr.json").unlink(missing_ok=True)
            self.outcome.roots += 1
        os.kill(before.processes[name], signal.SIGKILL)
        self.outcome.killed[name] += 1

        def is_replaced() -> bool:
            now = client.status()
            if now.state is State.FAULTED:
                raise AcquireError(f"{name} was not replaced: {now.fault}")
            if now.processes.get(name) in (None, before.processes[name]):
                return False
            if name == "recorder":
                return now.recording is not None and _place(now) != _place(before) and _committed(now) > 0
            lost = now.arms[name].lost.get("grabber_lost", 0)
            return lost > before.arms[name].lost.get("grabber_lost", 0)

        _until(is_replaced)

    def _serve(self) -> subprocess.Popen[bytes]:
        if self._daemon is None:
            command = [sys.executable, "-m", "acquire", "serve", "--config", str(self._config)]
            with (self._home / "serve.log").open("ab") as log:
                self._daemon = subprocess.Popen(command, stdout=log, stderr=log)
            _until(self._answers)
        return self._daemon

    def _answers(self) -> bool:
        assert self._daemon is not None
        assert self._daemon.poll() is None, (self._home / "serve.log").read_text()
        try:
            with Client(self._socket) as client:
                return client.status().pid == self._daemon.pid
        except AcquireError:
            return False

    def _examine(self, path: Path, acknowledged: Status) -> None:
        """The recording and the segments that continue it."""
        end = None
        for part in (path, *(segment.path for segment in open_recording(path).segments)):
            self.outcome.faults += [f"{part.name}: {fault}" for fault in check_recording(part)]
            recording = open_recording(part)
            if end is not None and not recording.first_line <= end:
                self.outcome.faults.append(
                    f"{part.name}: lines {end} to {recording.first_line} are in no part"
                )
            end = recording.first_line + recording.lines
            self.outcome.lines += recording.lines
            self.outcome.missing.update({gap.cause: gap.count for gap in recording.gaps})
        self.outcome.recordings += 1
        seen = acknowledged.recording
        if seen is not None and end is not None and (seen.first_line or 0) + seen.committed_lines > end:
            self.outcome.faults.append(f"{path.name}: {seen.committed_lines} lines were acknowledged")


def _open_parts(path: Path) -> list[str]:
    """Segments of a recording that are not sealed, or not listed in the first."""
    if not (path / "zarr.json").exists():
        return [path.name]
    listed = [path.name, *open_recording(path).attrs.get("segments", [])]
    parts = [path, *path.parent.glob(f"{path.stem}-*.zarr")]
    sealed = [
        part for part in parts if (part / "zarr.json").exists() and open_recording(part).state == "sealed"
    ]
    return [part.name for part in parts if part.name not in listed or part not in sealed]


def check_recording(path: Path) -> list[str]:
    """Defects of a recording of patterns."""
    recording = open_recording(path)
    found = []
    for arm in ARMS:
        listed = np.zeros(recording.lines, bool)
        for gap in recording.gaps:
            if gap.arm == arm:
                first = gap.first_line - recording.first_line
                listed[first : first + gap.count] = True
        stream = recording.camera(arm)
        flags, lines = stream.flags[:], stream.lines[:]
        missing = (flags & LineFlag.MISSING) != 0
        expected = Pattern(arm, 8, "uint16", 4095).lines(recording.first_line, recording.lines).copy()
        expected[missing] = 0
        if (missing != listed).any():
            found.append(
                f"arm {arm}: {int((missing != listed).sum())} missing lines are not listed, or the reverse"
            )
        if (wrong := (lines != expected).any(axis=1)).any():
            found.append(
                f"arm {arm}: {int(wrong.sum())} rows are not their lines, first {int(wrong.argmax())}"
            )
        found += _check_ledger(recording.attrs.get("ledger", {}).get(arm), recording.lines, missing, arm)
    if recording.state != "sealed":
        found.append(f"is {recording.state}")
    return found


def _check_ledger(book: dict[str, object] | None, lines: int, missing: np.ndarray, arm: str) -> list[str]:
    """The ledger, if the recorder wrote one, must agree with the rows."""
    if book is None or "stored" not in book:
        return []
    stored, lost = int(str(book["stored"])), sum(dict(book["missing"]).values())  # type: ignore[call-overload]
    if (stored + lost, lost) != (lines, int(missing.sum())):
        return [
            f"arm {arm}: the ledger has {stored} stored, {lost} missing of {lines} with {int(missing.sum())}"
        ]
    return []


def _committed(status: Status) -> int:
    return 0 if status.recording is None else status.recording.committed_lines


def _place(status: Status) -> tuple[Path, int | None] | None:
    """Path and first line; a recorder killed before it created anything leaves its name to the next one."""
    return None if status.recording is None else (status.recording.path, status.recording.first_line)


def _until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + WAIT_S
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"waited {WAIT_S:g} s")
        time.sleep(0.02)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="acquire-storm-") as home:
        begun = time.monotonic()
        outcome = Storm(Path(home), options.seed).run(options.kills)
        print(outcome)
        print(f"{time.monotonic() - begun:.0f} s, seed {options.seed}")
    return 1 if outcome.faults else 0


if __name__ == "__main__":
    sys.exit(main())
