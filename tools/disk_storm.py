"""Record on disks with moods, with random ends, extensions, stops and kills of the recorder.

::

    a run: a ring, a disk ─▶ some recordings, one after the other: with an end or without, stopped, prolonged,
                             their recorder killed (kill -9) ─▶ closed
    then:  every recording with an end has ended within `END_S`; nothing is left unsealed but what is named
           to be recovered; without a kill, nothing is missing; the ledgers balance

``python -m tools.disk_storm --runs 40`` prints what it did and what was wrong. The disks are slower than the
lines or about as fast, and silent for up to seconds, so that recordings pause, continue in further segments,
end while they pause, and lose their recorder with full rings.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from acquire.capacity.load import CLOCK_HZ, Load, recording_spec
from acquire.capacity.run import capture_plan
from acquire.config.device import TriggerConfig
from acquire.errors import AcquireError
from acquire.sim.clock import Wire
from acquire.sim.trigger_model import TriggerModel
from acquire.sim.twin_links import TwinTransport
from acquire.store import open_recording, verify
from acquire.stream import Begin, Capture
from acquire.trigger.driver import TriggerDriver
from tools.moody_disk import MoodyDisk

if TYPE_CHECKING:
    from collections.abc import Callable

LOAD = Load(64, "uint16", 20_000.0, substeps=2, stages=8, block_lines=64, ring_slots=100, chunk_lines=512)
RING_SLOTS = (50, 100, 400)
SHARES = (0.3, 0.8, 1.5, 10.0)
"""Bytes per second that a disk takes, relative to those that come."""
NAPS = (0.0, 0.02, 0.1)
LONGEST_NAPS_S = (0.5, 2.0, 6.0)
LINES = (None, 2000, 10_000, 40_000)
END_S = 120.0
"""Time for a recording of up to 40 000 lines (2 s) to end, whatever the disk does."""
TAKES = 4


@dataclass
class Outcome:
    """What happened, and what was wrong (nothing, if all is well)."""

    runs: int = 0
    ends: Counter[str] = field(default_factory=Counter)
    killed: int = 0
    refused: int = 0
    faults: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        rows = [
            f"runs        {self.runs}, {self.killed} recorders killed, {self.refused} starts refused",
            f"ends        {dict(self.ends)}",
            f"wrong       {len(self.faults)}",
        ]
        return "\n".join([*rows, *self.faults])


def run(home: Path, seed: int, outcome: Outcome) -> None:
    """Make one run, in a directory of its own."""
    chance = random.Random(seed)
    disk = MoodyDisk(
        chance.choice(SHARES) * LOAD.bytes_per_s, chance.choice(NAPS), chance.choice(LONGEST_NAPS_S)
    )
    kills, continues = chance.random() < 0.4, chance.random() < 0.8
    wire = Wire()
    model = TriggerModel(wire, CLOCK_HZ, LOAD.speed)
    trigger = TriggerDriver(partial(TwinTransport, model), TriggerConfig(tag_every_lines=LOAD.block_lines))
    plan = capture_plan(replace(LOAD, ring_slots=chance.choice(RING_SLOTS)), wire)
    capture = Capture(replace(plan, realtime=False, disk=disk, continues=continues), trigger)
    try:
        capture.arm()
        for number in range(TAKES):
            if not _take(capture, home / f"take{number}.zarr", chance, kills=kills, outcome=outcome):
                outcome.faults.append(f"seed {seed}: take {number} has not ended in {END_S:g} s")
                break
        capture.close()
    finally:
        capture.close()
        trigger.close()
        wire.close()
    outcome.runs += 1
    seen = capture.poll()
    wrong = [
        f"the ledger of arm {arm} does not balance" for arm, a in seen.accounts.items() if not a.balanced
    ]
    left = {orphan.path for orphan in seen.orphans}
    for path in sorted(home.glob("*.zarr")):
        if path not in left:
            wrong += _examine(path, kills=kills)
    outcome.faults += [f"seed {seed}: {each}" for each in wrong]


def _take(capture: Capture, path: Path, chance: random.Random, *, kills: bool, outcome: Outcome) -> bool:
    """Make one recording; return whether it ended in time."""
    lines = chance.choice(LINES)
    spec = replace(recording_spec(LOAD, capture.clock), fsync=chance.choice(["seal", "commit"]))
    try:
        capture.start(Begin(path, spec, lines))
    except AcquireError:
        outcome.refused += 1
        return True

    due = _actions(capture, chance, lines, kills=kills, outcome=outcome)
    began_s = time.monotonic()
    while not (seen := capture.poll()).done:
        passed_s = time.monotonic() - began_s
        if seen.fault is not None or (seen.orphans and not seen.recording):
            break
        if passed_s > END_S:
            return False
        for action in [each for each in due if each[0] <= passed_s]:
            due.remove(action)
            action[1]()
        time.sleep(0.01)
    outcome.ends[str(seen.condition)] += 1
    return True


def _actions(
    capture: Capture, chance: random.Random, lines: int | None, *, kills: bool, outcome: Outcome
) -> list[tuple[float, Callable[[], None]]]:
    """Return what is to be done to a recording, and after how many seconds."""

    def kill() -> None:
        if pid := capture.pids["recorder"]:
            os.kill(pid, signal.SIGKILL)
            outcome.killed += 1

    def extend() -> None:
        capture.extend((capture.poll().first_line or 0) + (lines or 0) + 5000)

    due: list[tuple[float, Callable[[], None]]] = []
    if lines is None or chance.random() < 0.2:
        due.append((chance.uniform(0.2, 6), capture.stop))
    if kills:
        due.append((chance.uniform(0.1, 4), kill))
    if chance.random() < 0.3:
        due.append((chance.uniform(0, 3), extend))
    return due


def _examine(path: Path, *, kills: bool) -> list[str]:
    try:
        recording = open_recording(path)
        intact = verify(path).intact
    except AcquireError as error:
        return [f"{path.name}: {error}"]
    wrong = [] if recording.state == "sealed" else [f"{path.name} is not sealed"]
    wrong += [] if intact else [f"{path.name} is damaged"]
    wrong += [f"{path.name}: lines are missing: {recording.gaps[:3]}"] if recording.gaps and not kills else []
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1, help="of the first run")
    asked = parser.parse_args()
    outcome = Outcome()
    for seed in range(asked.seed, asked.seed + asked.runs):
        with tempfile.TemporaryDirectory(prefix="disk-storm-") as home:
            run(Path(home), seed, outcome)
    sys.stdout.write(f"{outcome}\n")
    return bool(outcome.faults)


if __name__ == "__main__":
    sys.exit(main())
