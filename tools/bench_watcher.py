"""Cost and delay of the check of the exposure code: ``python tools/bench_watcher.py``.

One process puts lines of a simulated scene through real rings at the camera's rate; the watcher checks them
in another. Half-way, arm b slips by one line. Prints the cores used by the watcher, and by the process that
copies the lines into the rings (one bare copy of every line, paced) in the same run; the verdicts; the time
from the slip to the verdict; and the ring slots that the watcher lost.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from acquire.config import RigConfig, load_rig, load_scene
from acquire.daemon.watching import judge_of
from acquire.lines import ARMS
from acquire.processes.messages import Ready
from acquire.processes.shared import Counters
from acquire.processes.worker import Worker
from acquire.sim.pipeline import Bench
from acquire.stream.messages import Checked
from acquire.stream.ring import Ring, RingShape
from acquire.stream.threshold import ThresholdPlan
from acquire.stream.watcher import COUNTERS, WatchPlan, watch
from tools.results import Figure, add_option, recorded

BLOCK_LINES = 256
SLOTS = 512
CHECK_LINES = 8192
CODE_DEGREE = 15
CODE_PERIOD = 2**CODE_DEGREE - 1


@dataclass(frozen=True)
class Case:
    name: str
    stages: int
    line_rate_hz: float
    threshold: bool = False


CASES = (
    Case("64 px x 33 klines/s", 64, 33_333.0),
    Case("54 px x 600 klines/s", 54, 600_000.0),
    Case("the same, with a threshold on every line", 54, 600_000.0, threshold=True),
)


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--seconds", type=float, default=4.0, help="seconds of lines per case")
    add_option(words)
    options = words.parse_args()
    with recorded("bench_watcher", keep=options.record) as run:
        for case in CASES:
            print(case.name)
            found = measure(case, options.seconds)
            for name, value in found.items():
                print(f"  {name:<40} {f'{value:.3f}' if isinstance(value, float) else value}")
            run.add(case.name, **found)


def measure(case: Case, seconds: float) -> dict[str, Figure]:
    """Figures by name; ``noticed_after_s`` is None if the slip was not noticed."""
    rig = load_rig("rig-demo", {"geometry.stages": case.stages, "code.degree": CODE_DEGREE})
    lines = simulated(rig, int(seconds * case.line_rate_hz) // BLOCK_LINES * BLOCK_LINES)
    shape = RingShape(SLOTS, BLOCK_LINES, case.stages, "uint16", observers=2)
    rings = {arm: Ring(arm, shape) for arm in ARMS}
    counters = Counters(COUNTERS)
    threshold = ThresholdPlan("a", 1e9, 1.0, rising=True, average_lines=64) if case.threshold else None
    check_lines = min(CHECK_LINES, int(case.line_rate_hz / 4))
    plan = WatchPlan(judge_of(rig), check_lines, {"a": 0.0, "b": 0.0}, threshold)
    worker = Worker("watcher", watch, plan, rings, counters)
    context = multiprocessing.get_context("fork")  # the lines need not be copied
    copying = context.Value("d", 0.0)
    producer = context.Process(target=produce, args=(rings, lines, case.line_rate_hz, copying))
    try:
        worker.expect(Ready, time.monotonic() + 30)
        before_s, begun_s = cpu_s(worker.pid), time.monotonic()
        producer.start()
        received, slip_s = [], begun_s + seconds / 2
        while producer.is_alive():
            if isinstance(message := worker.message(0.01), Checked):
                received.append((time.monotonic(), message))
        used_s, took_s = cpu_s(worker.pid) - before_s, time.monotonic() - begun_s
    finally:
        producer.join()
        lost = counters["lapped_a"] + counters["lapped_b"]
        checks = counters["checks_a"]
        worker.end(time.monotonic() + 5)
        counters.close()
        for ring in rings.values():
            ring.close()
    slipped = [at - slip_s for at, message in received if message.doubtful]
    return {
        "watcher_cores": used_s / took_s,
        "copying_both_arms_cores": copying.value,
        "checks": checks,
        "noticed_after_s": slipped[0] if slipped else None,
        "slots_lost": lost,
        "verdicts": "; ".join(message.text for _, message in received),
    }


def simulated(rig: RigConfig, count: int) -> dict[str, np.ndarray]:
    """Lines of both arms of a still under a repeating code; arm b is one line late from the middle on."""
    cameras = {arm: rig.cameras.arm(arm) for arm in ARMS}
    bench, code = Bench(load_scene("scene-usaf"), rig.geometry, cameras, 1e-5), rig.code.build()
    lines = {}
    for arm in ARMS:
        period = bench.camera(arm, code).read(CODE_PERIOD, CODE_PERIOD).pixels
        lines[arm] = np.tile(period, (-(-count // CODE_PERIOD), 1))[:count]
    lines["b"][count // 2 :] = lines["b"][count // 2 - 1 : -1].copy()
    return lines


def produce(rings: dict[str, Ring], lines: dict[str, np.ndarray], line_rate_hz: float, cores: Any) -> None:
    """Put the lines into the rings at their rate; store the cores used in ``cores`` (a shared double)."""
    begun_s, used_s = time.monotonic(), time.process_time()
    for at in range(0, len(lines["a"]), BLOCK_LINES):
        while time.monotonic() < begun_s + (at + BLOCK_LINES) / line_rate_hz:
            time.sleep(0.0005)
        for arm, ring in rings.items():
            slot = ring.claim(at, BLOCK_LINES)
            assert slot is not None
            slot.pixels[:] = lines[arm][at : at + BLOCK_LINES]
            slot.flags[:] = 0
            ring.commit(slot)
            ring.acquire()
            ring.release()
    cores.value = (time.process_time() - used_s) / (time.monotonic() - begun_s)


def cpu_s(pid: int | None) -> float:
    """User and system time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
