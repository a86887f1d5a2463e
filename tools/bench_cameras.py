"""Cameras through harvesters and our GenTL producer into the ring: lost or torn lines, cores, latency.

::

    pattern ──▶ CameraMemory ──▶ producer (C thread) ──▶ harvesters ──▶ grabber ──▶ ring ──▶ check, here
                                └──────────── one process per camera ───────────┘

``python tools/bench_cameras.py`` runs two cameras of 4640 px at 100 klines/s, then of 54 px at 600 klines/s,
and measures the cost of a bare copy of the same bytes. ``--cycles 1000`` starts and stops one camera instead.
The producer's thread takes the place of grabber card and DMA: its share of the process is reported
separately.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import psutil

from acquire.camera.harvesters import HarvestersCamera, HarvestersOpener
from acquire.camera.settings import Setting
from acquire.camera.spec import GenicamSpec
from acquire.processes.messages import Ready
from acquire.processes.shared import Counters
from acquire.processes.worker import Worker
from acquire.sim.gentl.bench import GentlBench
from acquire.sim.gentl.models import CameraModel
from acquire.stream import grabber
from acquire.stream.ring import Ring, RingShape
from tools.results import Run, add_option, recorded

if TYPE_CHECKING:
    from acquire.processes.worker import Mailbox
    from acquire.sim.gentl.memory import CameraMemory

COLUMNS = 5
"""Pixels of every line that are compared."""


@dataclass(frozen=True)
class Load:
    """Two cameras: pixels per line, lines per second, lines per buffer."""

    width: int
    rate_hz: float
    height: int

    @property
    def period_ns(self) -> float:
        return 1e9 / self.rate_hz

    @property
    def title(self) -> str:
        mb = 2 * self.width * self.rate_hz / 1e6
        return f"2 x {self.width} px x {self.rate_hz / 1e3:g} klines/s = {mb:.0f} MB/s"


LOADS = (Load(4640, 100_000.0, 256), Load(54, 600_000.0, 1536))


def pattern(capacity: int, width: int) -> np.ndarray:
    """Line k shows row k mod capacity."""
    return (np.arange(capacity)[:, None] * 13 + np.arange(width) * 7).astype(np.uint8)


def feed_pattern(mailbox: Mailbox, memory: CameraMemory, load: Load) -> None:
    """Run a feeder that writes pixels once and then only numbers the lines when they are due."""
    capacity = len(memory.lines)
    memory.lines[:] = pattern(capacity, load.width)
    mailbox.post(Ready())
    wanted, start_ns, line = False, 0, 0
    while True:
        mailbox.take()
        if memory.request_pending:
            # The ring keeps its position: line 0 of a session is the next row at which the pattern begins.
            wanted = memory.acknowledge(memory["SESSION"])
            memory["HEAD"] = memory["TAIL"] = memory["HEAD"] // capacity * capacity + capacity
            start_ns, line = time.monotonic_ns(), 0
        due = int((time.monotonic_ns() - start_ns) / load.period_ns) if wanted else 0
        room = capacity - (memory["HEAD"] - memory["TAIL"])
        count = min(due - line, room)
        if count > 0:
            numbers = np.arange(line, line + count)
            slots = (memory["HEAD"] + np.arange(count)) % capacity
            memory.headers[slots, 0] = numbers
            memory.headers[slots, 1] = start_ns + (numbers * load.period_ns).astype(np.int64)
            memory["HEAD"] += count
            line += count
        time.sleep(0.0005)


class Side:
    """Check the output of one camera's ring."""

    def __init__(
        self, memory: CameraMemory, ring: Ring, counters: Counters, worker: Worker, load: Load
    ) -> None:
        self.memory, self.worker = memory, worker
        self._ring, self._counters, self._load = ring, counters, load
        self._next_line: int | None = None
        self.lost = self.torn = self.lines = 0
        self.latencies_ms: list[float] = []

    def settle(self) -> bool:
        """Discard the lines gathered since the camera was armed; True once lines arrive on time."""
        waited = sum(len(lines) for lines in self._ring.empty())
        return waited < 2 * self._load.height and self.memory["HEAD"] > 0

    def take(self) -> bool:
        block = self._ring.acquire()
        if block is None:
            return False
        numbers = np.arange(block.first_line, block.end_line)
        at = np.linspace(0, self._load.width - 1, COLUMNS).astype(int)
        expected = (numbers[:, None] % len(self.memory.lines) * 13 + at * 7).astype(np.uint8)
        self.torn += int((block.pixels[:, at] != expected).any(axis=1).sum())
        self.lost += block.first_line - (block.first_line if self._next_line is None else self._next_line)
        self._next_line = block.end_line
        self.lines += len(block.flags)
        self.latencies_ms.append((block.time_ns - self._due_ns(block.first_line)) / 1e6)
        self._ring.release()
        return True

    def _due_ns(self, line: int) -> float:
        """Time at which the sensor had the line; lines are evenly spaced, so any header gives all times."""
        number, time_ns = self.memory.headers[0].tolist()
        return time_ns + (line - number) * self._load.period_ns

    def losses(self) -> dict[str, int]:
        found = {str(cause): self._counters[cause] for cause in grabber.CAMERA_CAUSES}
        return found | {"ring_full": self._ring.statistics().dropped_lines}


def spec_of(model: CameraModel, load: Load, cti: str) -> GenicamSpec:
    settings = (
        Setting("remote", "PixelFormat", "Mono8"),
        Setting("stream", "BufferHeight", load.height),
    )
    return GenicamSpec(
        model.serial,
        settings=settings,
        pixels=load.width,
        line_rate_hz=load.rate_hz,
        cti=cti,
        frame_id_first=0,
    )


def grabber_plan(model: CameraModel, load: Load, cti: str) -> grabber.GrabberPlan:
    return grabber.GrabberPlan("a", HarvestersOpener(spec_of(model, load, cti)), 0, 256, 1 << 30)


def models(load: Load) -> list[CameraModel]:
    return [
        CameraModel(f"SIM-{arm}", load.width, bits=8, pixel_format="Mono8", line_rate_hz=load.rate_hz)
        for arm in "AB"
    ]


def capture(load: Load, seconds: float, run: Run) -> None:
    """Run two grabbers as in a capture; this process is a recorder that checks and discards."""
    print(load.title)
    cameras = models(load)
    with GentlBench(dict.fromkeys(cameras, load), feed_pattern) as bench:
        rings = [Ring(model.serial, RingShape(64, load.height, load.width, "uint8")) for model in cameras]
        counts = [Counters(grabber.COUNTERS) for _ in cameras]
        workers = [
            Worker(
                f"grabber {model.serial}",
                grabber.grab,
                (grabber_plan(model, load, str(bench.cti)), ring, counters),
            )
            for model, ring, counters in zip(cameras, rings, counts, strict=True)
        ]
        for worker in workers:
            worker.expect(Ready, time.monotonic() + 30)
        try:
            _watch(load, seconds, bench, list(zip(cameras, rings, counts, workers, strict=True)), run)
        finally:
            for worker in workers:
                worker.end(time.monotonic() + 5)
            for ring, counters in zip(rings, counts, strict=True):
                ring.close()
                counters.close()


def _watch(load: Load, seconds: float, bench: GentlBench, arms: list[Any], run: Run) -> None:
    """Read and check for ``seconds``, starting when all rings are empty."""
    sides = [
        Side(bench.cameras[model.serial], ring, counts, worker, load) for model, ring, counts, worker in arms
    ]
    while not all(tuple(side.settle() for side in sides)):
        time.sleep(0.0005)
    before = [(threads_of(side.worker.pid), side.losses()) for side in sides]
    begin = time.monotonic()
    while time.monotonic() - begin < seconds:
        if not any(tuple(side.take() for side in sides)):
            time.sleep(0.0005)
    elapsed_s = time.monotonic() - begin
    for side, (threads, losses) in zip(sides, before, strict=True):
        own, producer = share(threads, threads_of(side.worker.pid), side.worker.pid, elapsed_s)
        why = {
            cause: count - losses[cause] for cause, count in side.losses().items() if count > losses[cause]
        }
        late = np.array(side.latencies_ms)
        print(
            f"  {side.memory.model.serial}  {side.lines} lines in {elapsed_s:.1f} s, lost {side.lost}"
            f" {why or ''}, torn {side.torn}\n"
            f"         core: grabber {own:.3f}, producer's thread {producer:.3f};"
            f" first line of a block to ring: median {np.median(late):.2f},"
            f" p99 {np.percentile(late, 99):.2f}, most {late.max():.1f} ms"
        )
        run.add(
            f"{load.title}, {side.memory.model.serial}",
            lines=side.lines,
            lost=side.lost,
            torn=side.torn,
            grabber_cores=own,
            producer_cores=producer,
            median_ms=np.median(late),
            p99_ms=np.percentile(late, 99),
            worst_ms=late.max(),
        )


def threads_of(pid: int | None) -> dict[int, float]:
    return {thread.id: thread.user_time + thread.system_time for thread in psutil.Process(pid).threads()}


def share(
    before: dict[int, float], after: dict[int, float], pid: int | None, elapsed_s: float
) -> tuple[float, float]:
    """Cores of the process's main thread, and of its others."""
    used = {thread: (time_s - before.get(thread, 0.0)) / elapsed_s for thread, time_s in after.items()}
    return used.pop(pid or 0), sum(used.values())


def bare_copy(load: Load, run: Run) -> None:
    """Copy the same bytes with numpy, and search them for their maximum."""
    source = [np.ones((load.height, load.width), np.uint8) for _ in range(64)]
    target = [np.ones((load.height, load.width), np.uint8) for _ in range(64)]
    blocks = max(64, round(load.rate_hz / load.height))
    began, used = time.perf_counter(), time.process_time()
    for k in range(blocks):
        target[k % 64][:] = source[k % 64]
    copied_s, wall_s = time.process_time() - used, time.perf_counter() - began
    used = time.process_time()
    for k in range(blocks):
        source[k % 64].max()
    looked_s = time.process_time() - used
    rate = blocks * load.height / load.rate_hz
    print(
        f"  bare memcpy of one camera's lines: core {copied_s / rate:.3f}"
        f" ({blocks * load.height * load.width / wall_s / 1e9:.1f} GB/s), maximum {looked_s / rate:.3f}"
    )
    run.add(
        f"bare memcpy of one camera's lines, {load.title}",
        cores=copied_s / rate,
        gb_s=blocks * load.height * load.width / wall_s / 1e9,
        cores_of_a_maximum=looked_s / rate,
    )


def cycles(count: int, run: Run) -> None:
    """Arm and disarm one camera; print memory, descriptors and threads before and after."""
    load = Load(512, 10_000.0, 64)
    model = models(load)[0]
    with GentlBench({model: load}, feed_pattern) as bench:
        camera = HarvestersCamera(spec_of(model, load, str(bench.cti)))
        process = psutil.Process()
        for k in range(count + 1):
            if k % max(1, count // 10) == 0:
                mb, fds = process.memory_info().rss / 1e6, process.num_fds()
                print(f"  {k:5d} cycles: {mb:.1f} MB, {fds} descriptors, {process.num_threads()} threads")
                run.add(f"after {k} cycles", memory_mb=mb, descriptors=fds, threads=process.num_threads())
            camera.arm()
            camera.disarm()
        camera.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--cycles", type=int, default=0)
    add_option(parser)
    options = parser.parse_args()
    with recorded("bench_cameras", keep=options.record) as run:
        if options.cycles:
            cycles(options.cycles, run)
            return
        for load in LOADS:
            capture(load, options.seconds, run)
            bare_copy(load, run)


if __name__ == "__main__":
    main()
