"""Simulate hours of capture in minutes with seeded faults: does memory grow, is every line accounted for?

::

    pattern cameras, time-compressed ─▶ … armed, recorded, stopped, again and again …
    faults: a camera disappears and returns · a camera drops blocks · the recorder is stopped for a while, or
            until the rings are full and the recording has to continue in a further segment

``python -m tools.soak --hours 8 --minutes 4`` simulates 8 hours of lines at 2 kHz. Every other second
and at the end of every cycle the memory of each process is recorded; for the owner, the only process that
outlives a cycle, also descriptors and threads. ``--cycle 60`` lets the others live longer. Every recording is
read again completely by a separate process, so that its memory does not count as the capture's.
"""

from __future__ import annotations

import argparse
import gc
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.camera.base import CameraBlock
from acquire.capacity.load import Load, recording_spec
from acquire.capacity.run import capture_plan
from acquire.config.device import TriggerConfig
from acquire.errors import CameraLostError
from acquire.lines import ARMS
from acquire.processes.shared import Counters
from acquire.sim.clock import Wire
from acquire.sim.trigger_model import TriggerModel
from acquire.sim.twin_links import TwinTransport
from acquire.store import open_recording
from acquire.stream import Begin, Capture
from acquire.trigger.driver import TriggerDriver
from tools.kill_storm import check_recording

if TYPE_CHECKING:
    from acquire.camera.base import Camera, CameraOpener
    from acquire.stream import CaptureStatus

CLOCK_HZ = 90_000_000
SIMULATED_HZ = 2000.0
FAULTS = ("gone", "drop", "pause", "freeze")
CYCLE_S = 4.0
SAMPLE_S = 2.0
LEAST_SAMPLES = 20
MOST_GROWTH_MB = 2.0
"""Allowed growth in the second half of a process's record, if that is long enough."""
LONGEST_PAUSE_S = 0.3
LONGEST_RING_S = 5.0
"""A longer ring is not filled: then a freeze is only a pause."""
WAIT_S = 60.0


@dataclass(frozen=True)
class FaultyOpener:
    """Opens a camera whose faults are switched on through shared memory."""

    opener: CameraOpener
    faults: Counters
    arm: str

    def __call__(self) -> Camera:
        return FaultyCamera(self)  # type: ignore[return-value]


class FaultyCamera:
    """A simulated camera that skips a block, or disappears, on request."""

    def __init__(self, given: FaultyOpener) -> None:
        self._given = given
        self._camera = given.opener()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)

    def next_block(self, timeout_s: float) -> CameraBlock | None:
        if self._takes("gone"):
            raise CameraLostError("unplugged")
        block = self._camera.next_block(timeout_s)
        if block is not None and self._takes("drop"):
            self._camera.release(block)
            return None
        return block

    def _takes(self, fault: str) -> bool:
        name = f"{fault}_{self._given.arm}"
        thrown = bool(self._given.faults[name])
        self._given.faults[name] = 0
        return thrown


@dataclass
class Soak:
    """What was simulated, and the results."""

    cycles: int = 0
    segments: int = 0
    lines: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    lost: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    usage: list[tuple[int, int]] = field(default_factory=list)
    memory: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    """Process → real time in seconds and MB of its private memory."""

    def note_memory(self, pids: dict[str, int | None]) -> None:
        """Record the memory of this process and the others."""
        for name, pid in {"owner": os.getpid(), **pids}.items():
            if pid is not None and (own := own_mb(pid)):
                self.memory.setdefault(name, []).append((time.monotonic(), own))

    def growth_mb(self, name: str) -> float | None:
        """Growth of a process in the second half, by the median of slopes; None: too few values."""
        noted = self.memory[name]
        late = np.array(noted[len(noted) // 2 :])
        if len(noted) < LEAST_SAMPLES:
            return None
        first, second = np.triu_indices(len(late), 1)
        slopes = (late[second, 1] - late[first, 1]) / (late[second, 0] - late[first, 0])
        return float(np.median(slopes) * (late[-1, 0] - late[0, 0]))

    def judge(self) -> None:
        """Report growth as a defect."""
        for name in self.memory:
            growth = self.growth_mb(name)
            if growth is not None and growth > MOST_GROWTH_MB:
                self.wrong.append(f"{name}: grew by {growth:.1f} MB in the second half")

    def __str__(self) -> str:
        handles, threads = self.usage[min(1, len(self.usage) - 1)]
        handles_end, threads_end = self.usage[-1]
        hours = self.lines / SIMULATED_HZ / 3600
        rows = [
            f"cycles   {self.cycles}, {self.lines} lines of each arm = {hours:.2f} hours",
            f"segments {self.segments}",
            f"faults   {dict(self.faults)}; lines lost to them {dict(self.lost)}",
            *(f"memory   {self._memory(name)}" for name in self.memory),
            f"handles  {handles}, {handles_end}; threads {threads}, {threads_end}",
            f"wrong    {len(self.wrong)}",
        ]
        return "\n".join([*rows, *self.wrong])

    def _memory(self, name: str) -> str:
        own = [mb for _, mb in self.memory[name]]
        growth = self.growth_mb(name)
        change = "too short to judge" if growth is None else f"{growth:+.2f} MB in the second half"
        return f"{name:9}{own[0]:.1f} MB first, {own[-1]:.1f} last, {max(own):.1f} most; {change}"


def soak(home: Path, lines: int, line_rate_hz: float, seed: int, cycle_s: float = CYCLE_S) -> Soak:
    """Simulate ``lines`` lines in cycles of arm, record, stop, each with its own faults."""
    chance, found = random.Random(seed), Soak()
    load = Load(8, "uint16", line_rate_hz, substeps=2, stages=8, block_lines=512, ring_slots=1024)
    place = home / "cycle"
    with ProcessPoolExecutor(1, get_context("spawn")) as reader:
        while found.lines < lines:
            place.mkdir()
            seen = _cycle(place / "r.zarr", load, chance, found, cycle_s)
            _examine(seen, reader.submit(check_parts, place).result(), found)
            shutil.rmtree(place)
            found.cycles += 1
            # Count after a collection, since garbage is not a leak.
            gc.collect()
            handles = sum(1 for _ in Path("/proc/self/fd").iterdir())
            found.usage.append((handles, threading.active_count()))
    found.judge()
    return found


def _cycle(path: Path, load: Load, chance: random.Random, found: Soak, cycle_s: float) -> CaptureStatus:
    wire = Wire()
    faults = Counters(tuple(f"{fault}_{arm}" for fault in ("gone", "drop") for arm in ARMS))
    model = TriggerModel(wire, CLOCK_HZ, load.speed)
    trigger = TriggerDriver(partial(TwinTransport, model), TriggerConfig(tag_every_lines=load.block_lines))
    plan = capture_plan(load, wire)
    openers: dict[str, CameraOpener] = {
        arm: FaultyOpener(opener, faults, arm) for arm, opener in plan.openers.items()
    }
    plan = replace(
        plan, openers=openers, reopen_timeout_s=20.0, stall_timeout_s=25.0, realtime=False, continues=True
    )
    capture = Capture(plan, trigger)
    try:
        capture.arm()
        capture.start(Begin(path, recording_spec(load, capture.clock)))
        _throw(capture, faults, chance, found, time.monotonic() + cycle_s, plan.ring_s)
        found.note_memory(capture.pids)
        capture.stop("end of the cycle")
        _until(lambda: capture.poll().done)
    finally:
        capture.close()
        trigger.close()
        wire.close()
        faults.close()
    return capture.poll()


def has_gone_on(now: CaptureStatus, before: CaptureStatus) -> bool:
    """Whether it continues in a further segment, or has ended for a reason that the ledger gives."""
    return now.done or (now.path != before.path and now.committed_lines > 0)


def _stop_recorder(capture: Capture, chance: random.Random, *, until_full: bool) -> None:
    pid, before = capture.pids["recorder"], capture.poll()
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    if until_full:
        _until(
            lambda: all(
                ring["drops"] > before.ring[arm]["drops"] for arm, ring in capture.poll().ring.items()
            )
        )
    time.sleep(chance.uniform(0, LONGEST_PAUSE_S))
    os.kill(pid, signal.SIGCONT)
    if until_full:
        _until(lambda: has_gone_on(capture.poll(), before))


def _throw(
    capture: Capture, faults: Counters, chance: random.Random, found: Soak, until_s: float, ring_s: float
) -> None:
    note_s = time.monotonic() + SAMPLE_S
    while (now_s := time.monotonic()) < until_s:
        if now_s >= note_s:
            note_s = now_s + SAMPLE_S
            found.note_memory(capture.pids)
        time.sleep(chance.uniform(0.2, 1.0))
        fault = chance.choice(FAULTS)
        found.faults[fault] += 1
        if fault in ("pause", "freeze"):  # as a slow disk does
            _stop_recorder(capture, chance, until_full=fault == "freeze" and ring_s < LONGEST_RING_S)
        else:
            faults[f"{fault}_{chance.choice(ARMS)}"] = 1


@dataclass
class Parts:
    """Check a recording with its further segments: their lines, and their defects."""

    count: int = 0
    lines: int = 0
    stored: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)


def check_parts(place: Path) -> Parts:
    """Check every recording in a directory."""
    found = Parts()
    for path in sorted(place.glob("*.zarr")):
        recording = open_recording(path)
        found.count += 1
        found.lines += recording.lines
        found.stored.update({arm: recording.attrs["ledger"][arm]["stored"] for arm in ARMS})
        found.wrong += [f"{path.name}: {fault}" for fault in check_recording(path)]
    return found


def _examine(seen: CaptureStatus, parts: Parts, found: Soak) -> None:
    """Account for every line, as delivered and as recorded."""
    wrong = [*parts.wrong, *([seen.fault] if seen.fault else [])]
    for name, account in seen.accounts.items():
        if not account.balanced or account.stored != parts.stored[name]:
            wrong.append(f"arm {name}: {account}, but {parts.stored[name]} lines are recorded")
        found.lost.update({cause: lines for cause, lines in account.lost.items() if lines})
    found.wrong += [f"cycle {found.cycles}: {text}" for text in wrong]
    found.lines += parts.lines
    found.segments += parts.count


def own_mb(pid: int) -> float:
    """MB of a process's private memory, shared with no process or file; 0 once it has ended."""
    try:
        _, resident, shared, *_ = Path(f"/proc/{pid}/statm").read_text().split()
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return (int(resident) - int(shared)) * os.sysconf("SC_PAGESIZE") / 1e6


def _until(condition: Any) -> None:
    deadline = time.monotonic() + WAIT_S
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"waited {WAIT_S:g} s")
        time.sleep(0.02)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=8.0, help="simulated hours")
    parser.add_argument("--minutes", type=float, default=4.0, help="real minutes of recording")
    parser.add_argument("--cycle", type=float, default=CYCLE_S, help="real seconds per recording")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    lines = round(options.hours * 3600 * SIMULATED_HZ)
    with tempfile.TemporaryDirectory(prefix="acquire-soak-") as home:
        found = soak(Path(home), lines, lines / (60 * options.minutes), options.seed, options.cycle)
    print(found)
    return 1 if found.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
