"""Live video: pictures per second, their age and cost, and lines lost by the recording.

    python tools/bench_glimpse.py [--seconds 20] [--busy 2]

A daemon with cameras of stored lines records 100 000 sub-steps per second; one process makes pictures of the
latest lines, as it does for the page. Each row is one size of sensor. ``--busy`` runs that many other
processes at the same time, to which the pictures give way.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil

from acquire.client import Client
from acquire.errors import AcquireError
from acquire.web.frames import HEAD
from tools.results import Run, add_option, recorded

SIZES = ((64, 3), (128, 1), (128, 3), (256, 1))
"""Stages, and sub-steps per line."""
SUBSTEPS_HZ = 100_000
WAIT_S = 60.0


@contextlib.contextmanager
def armed(directory: Path, stages: int, substeps: int) -> Iterator[Client]:
    """Run a daemon with such a sensor, whose cameras take hardly any processor time."""
    socket = directory / "c.sock"
    settings = {
        "geometry.stages": stages,
        "geometry.substeps": substeps,
        "trigger.substep_ticks": 90_000_000 // SUBSTEPS_HZ,
        "cameras.a.driver": "'pattern'",
        "cameras.b.driver": "'pattern'",
        "check.enable": "false",
        "recording.directory": f"'{directory}'",
    }
    words = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
    command = [sys.executable, "-m", "acquire", "serve", "-c", "rig-demo", "--socket", str(socket), *words]
    with (directory / "serve.log").open("wb") as log:
        daemon = subprocess.Popen(command, stderr=log, stdout=log)
    try:
        until = time.monotonic() + WAIT_S
        while True:
            try:
                client = Client(socket)
                client.status()
                break
            except AcquireError:
                if time.monotonic() > until or daemon.poll() is not None:
                    raise
                time.sleep(0.1)
        client.arm(force=True)
        yield client
        client.disarm()
    finally:
        daemon.terminate()
        daemon.wait(WAIT_S)


class Viewer:
    """Reader of the process's output, except the first glimpse, which loads the loops."""

    def __init__(self, socket: Path) -> None:
        command = [sys.executable, "-m", "acquire.web.glimpse", str(socket)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.seen = [self._next()]
        self._begun_s, self._used_s = time.monotonic(), self._processor_s()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _next(self) -> dict[str, float]:
        assert self._process.stdout is not None
        header, body = HEAD.unpack(self._process.stdout.read(HEAD.size))
        found: dict[str, float] = json.loads(self._process.stdout.read(header))
        self._process.stdout.read(body)
        return found

    def _read(self) -> None:
        with contextlib.suppress(Exception):  # the process ended in the middle of a message
            while True:
                self.seen.append(self._next())

    def _processor_s(self) -> float:
        return sum(psutil.Process(self._process.pid).cpu_times()[:2])

    def close(self) -> dict[str, float]:
        seconds, used_s = time.monotonic() - self._begun_s, self._processor_s() - self._used_s
        ages = [each["age_s"] for each in self.seen[1:]] or [float("nan")]
        self._process.kill()
        self._thread.join()
        return {
            "per_s": (len(self.seen) - 1) / seconds,
            "age_median_s": float(np.median(ages)),
            "age_worst_s": max(ages),
            "cores": used_s / seconds,
        }


def compute() -> None:
    while True:
        np.linalg.svd(np.ones((100, 100)))


@contextlib.contextmanager
def neighbours(count: int) -> Iterator[None]:
    busy = [multiprocessing.Process(target=compute, daemon=True) for _ in range(count)]
    for one in busy:
        one.start()
    yield
    for one in busy:
        one.kill()


def measure(run: Run, seconds: float, busy: int) -> None:
    for stages, substeps in SIZES:
        with tempfile.TemporaryDirectory() as place, armed(Path(place), stages, substeps) as client:
            client.start(Path(place) / "r.zarr")
            viewer = Viewer(Path(place) / "c.sock")
            with neighbours(busy):
                time.sleep(seconds)
                figures = viewer.close()
            status = client.stop()
            assert status.last is not None
            lost = sum(sum(arm.lost.values()) for arm in status.arms.values())
            case = f"{stages} stages x {substeps}, {busy} busy neighbours"
            run.add(case, **figures, recorded_lines=status.last.lines, lost=lost)
            print(
                f"{case}: {figures['per_s']:.2f} per second, age {figures['age_median_s']:.2f} s, at worst "
                f"{figures['age_worst_s']:.2f} s, {figures['cores']:.2f} cores; "
                f"{lost} of {status.last.lines} lines lost",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--busy", type=int, default=0, help="number of other busy processes")
    add_option(parser)
    options = parser.parse_args()
    with recorded("bench_glimpse", keep=options.record) as run:
        measure(run, options.seconds, options.busy)


if __name__ == "__main__":
    main()
