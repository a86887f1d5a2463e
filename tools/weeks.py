"""Weeks of short recordings in minutes: does anything grow with the number of recordings?

``python -m tools.weeks --minutes 12`` runs a real daemon with its page and makes short recordings one after
the other. Meanwhile clients subscribe, stall and leave, the page shows pictures, lists, details and
thumbnails, jobs cut lines, the rig file is reloaded, and the instrument is disarmed and armed again. The
oldest recordings are deleted, so that all is as on the first day but for the number of recordings made.

It prints, for every process, what 1000 recordings add to its private memory, descriptors, threads and live
Python objects: the median of slopes in the second half, with all growth of descriptors and threads. Shared
memory in /dev/shm is counted, too. ``--types`` names the types whose objects became more.

``tools/soak.py`` has long recordings with faults, and ``tools/shifts.py`` kills processes; here nothing dies.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from shutil import rmtree
from typing import Any

import httpx
import numpy as np
import psutil

from acquire.client import Client
from acquire.errors import AcquireError
from tools.results import ROOT, add_option, recorded
from tools.shift_host import Host, left_in_shared_memory, mapped
from tools.shift_strangers import lie, stall
from tools.soak import own_mb

EVERY = 20
"""Recordings between two looks at the processes."""
ARM_EVERY, RELOAD_EVERY, JOB_EVERY, PAGE_EVERY = 200, 10, 25, 5
MARKS, RELOADS = 2100, 130
"""As many as fill the daemon's news, a recorder's notes, and the standard library's caches."""
LONG = 400
"""Recordings from which on a slope is judged; a shorter life may still load modules and fill caches."""
MOST_IN_1000 = {"memory_mb": 2.0, "descriptors": 2.0, "threads": 1.0, "files in /dev/shm": 1.0}
"""What 1000 recordings may add to a process."""
KEPT = 30
"""Recordings that are not deleted."""
LEAST_LOOKS = 8
LOOK_S = 5.0
WAIT_S = 120.0
COUNT_OBJECTS = """
import collections, gc, json, os, signal
def count(*_):
    gc.collect()
    found = gc.get_objects()
    types = collections.Counter(f"{type(one).__module__}.{type(one).__qualname__}" for one in found)
    place = os.environ["ACQUIRE_WEEKS"] + f"/objects-{os.getpid()}.json"
    with open(place + ".new", "w") as file:
        json.dump([len(found), types.most_common(400)], file)
    os.replace(place + ".new", place)
signal.signal(signal.SIGUSR2, count)
"""
"""Loaded by every process of the daemon, as its ``sitecustomize``."""


@dataclass
class Life:
    """What a process used, by the number of recordings made."""

    looks: list[dict[str, float]] = field(default_factory=list)
    types: list[dict[str, int]] = field(default_factory=list)

    def slopes(self) -> dict[str, float]:
        """Return what 1000 recordings add, as the median of slopes in the second half."""
        late = self.looks[len(self.looks) // 2 :]
        at = np.array([look["recordings"] for look in late])
        first, second = np.triu_indices(len(late), 1)
        found = {}
        for name in (name for name in late[0] if name != "recordings"):
            values = np.array([look.get(name, np.nan) for look in late])
            slopes = (values[second] - values[first]) / (at[second] - at[first])
            found[name] = 1000 * float(np.nanmedian(slopes))
        return found

    def grown_types(self) -> list[tuple[str, int]]:
        early, late = self.types[len(self.types) // 2], self.types[-1]
        grown = {name: count - early.get(name, 0) for name, count in late.items()}
        return sorted(((name, n) for name, n in grown.items() if n > 0), key=lambda one: -one[1])[:12]


class Weeks:
    """The work of weeks, on one host."""

    def __init__(self, host: Host, seed: int) -> None:
        self._host, self._chance = host, random.Random(seed)
        self._page = httpx.Client(
            base_url=host.address, headers={"Authorization": f"Bearer {host.token}"}, timeout=WAIT_S
        )
        self.done: Counter[str] = Counter()
        self.lives: dict[str, Life] = {}
        self._shared: set[str] = set()
        self.wrong: list[str] = []

    def work(self, until_s: float) -> None:
        with Client(self._host.socket) as client:
            client.arm(force=True)
            for number in range(RELOADS):
                # A directory on the path that has changed is looked through again.
                (self._host.home / "touched").touch()
                (self._host.home / "touched").unlink()
                self._reload(client, number)
            self._fill(client)
            while time.monotonic() < until_s:
                try:
                    self._record(client)
                    self._others(client)
                except (AcquireError, httpx.HTTPError) as error:
                    self.wrong.append(f"after {self.done['recordings']} recordings: {error}")
            client.disarm()

    def _fill(self, client: Client) -> None:
        """Fill the logs that are bounded, so that they do not grow during the first weeks either."""
        for number in range(MARKS):
            client.mark(f"before {number}")

    def _reload(self, client: Client, number: int) -> None:
        rig = self._host.home / "rig.toml"
        text = rig.read_text().partition("[service]")[0]
        rig.write_text(f'{text}[service]\nlog_level = "{("info", "warning")[number % 2]}"\n')
        client.reload()
        self.done["reloads"] += 1

    def _record(self, client: Client) -> None:
        number = self.done["recordings"]
        client.start(self._host.home / f"take-{number}.zarr", lines=self._chance.randint(100, 1500))
        client.mark(f"number {number}")
        client.wait(("armed",), WAIT_S)  # type: ignore[arg-type]
        self.done["recordings"] += 1
        if number >= KEPT:
            for path in self._host.home.glob(f"*take-{number - KEPT}.*"):
                rmtree(path) if path.is_dir() else path.unlink()

    def _others(self, client: Client) -> None:
        number = self.done["recordings"]
        if number % PAGE_EVERY == 0:
            self._browse(number)
        if number % RELOAD_EVERY == 0:
            self._reload(client, number // RELOAD_EVERY)
        if number % JOB_EVERY == 0:
            asked = {"kind": "cut", "recording": f"take-{number - 1}.zarr", "lines": 32}
            first = self._get(f"/api/recordings/take-{number - 1}.zarr")["first_line"]
            self._page.post("/api/jobs", json={**asked, "first_line": first}).raise_for_status()
            self.done["jobs"] += 1
        if number % ARM_EVERY == 0:
            client.disarm()
            client.arm(force=True)
            self.done["arms"] += 1
            self._fill(client)
        if number % EVERY == 0:
            self._look(client)

    def _get(self, path: str) -> Any:
        answer = self._page.get(path)
        answer.raise_for_status()
        return answer.json()

    def _browse(self, number: int) -> None:
        """See what a browser shows of the recordings, and the live picture for a moment."""
        for path in ("recordings", "videos", "jobs", "setup", "health", "calibration"):
            self._get(f"/api/{path}")
        self._page.get(f"/api/recordings/take-{number - 1}.zarr/picture").raise_for_status()
        self._page.get("/api/metrics").raise_for_status()
        with self._page.stream("GET", "/api/live", params={"pictures": "true"}) as stream:
            for k, _ in enumerate(stream.iter_raw()):
                if k > 3:
                    break
        self.done["looks of a browser"] += 1

    def _look(self, client: Client) -> None:
        """Record what every process uses; each counts its objects itself."""
        named = {pid: name for name, pid in client.status().processes.items() if pid}
        named |= {self._host.pid: "daemon", self._host.page_pid or -1: "page"}
        processes = [psutil.Process(self._host.pid), *psutil.Process(self._host.pid).children(recursive=True)]
        for process in processes:
            with contextlib.suppress(psutil.Error):
                name = named.get(process.pid) or ("nursery" if process.ppid() == self._host.pid else None)
                if name is None:  # a job, which ends soon
                    continue
                look = {
                    "recordings": float(self.done["recordings"]),
                    "memory_mb": own_mb(process.pid),
                    "descriptors": float(process.num_fds()),
                    "threads": float(process.num_threads()),
                }
                life = self.lives.setdefault(f"{name} {process.pid}", Life())
                if (counted := self._objects(process.pid)) is not None:
                    look["objects"] = counted[0]
                    life.types.append(dict(counted[1]))
                life.looks.append(look)
        shared = Life() if "host 0" not in self.lives else self.lives["host 0"]
        self._shared |= mapped(process.pid for process in processes)
        files = len(left_in_shared_memory(self._shared))
        shared.looks.append({"recordings": float(self.done["recordings"]), "files in /dev/shm": files})
        self.lives["host 0"] = shared

    def _objects(self, pid: int) -> tuple[int, list[tuple[str, int]]] | None:
        place = self._host.home / f"objects-{pid}.json"
        place.unlink(missing_ok=True)
        os.kill(pid, signal.SIGUSR2)
        deadline = time.monotonic() + LOOK_S
        while not place.exists():
            if time.monotonic() > deadline:
                return None
            time.sleep(0.02)
        count, types = json.loads(place.read_text())
        return count, types


def report(weeks: Weeks, run: Any, *, types: bool) -> list[str]:
    """Print and keep what every process used; return what grew."""
    wrong = []
    print(dict(weeks.done))
    for name, life in weeks.lives.items():
        if len(life.looks) < LEAST_LOOKS:
            continue
        role = name.split()[0]
        span = round(life.looks[-1]["recordings"] - life.looks[0]["recordings"])
        ends = {what: f"{life.looks[0][what]:.5g} → {n:.5g}" for what, n in life.looks[-1].items()}
        del ends["recordings"]
        slopes = life.slopes()
        told = ", ".join(f"{what} {ends[what]} ({slope:+.3g})" for what, slope in slopes.items())
        print(f"{role:9} {span:5} recordings; (in 1000): {told}")
        if span >= LONG:
            wrong += [
                f"{role}: 1000 recordings add {slope:.3g} {what}"
                for what, slope in slopes.items()
                if slope > MOST_IN_1000.get(what, math.inf)
            ]
        columns = {f"{what.replace(' ', '_')}_in_1000": slope for what, slope in slopes.items()}
        run.add(f"{role}, {span} recordings", **columns)
        if types and life.types:
            print("         ", life.grown_types())
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=12.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--types", action="store_true")
    add_option(parser)
    options = parser.parse_args()
    with (
        recorded("weeks", keep=options.record) as run,
        tempfile.TemporaryDirectory(prefix="acquire-weeks-") as place,
    ):
        home = Path(place)
        (home / "objects").mkdir()
        (home / "objects/sitecustomize.py").write_text(COUNT_OBJECTS)
        os.environ |= {"PYTHONPATH": f"{home / 'objects'}:{ROOT}", "ACQUIRE_WEEKS": place}
        host, ending, counts = Host(home), threading.Event(), Counter[str]()
        strangers = [
            threading.Thread(target=each, args=(host, counts, random.Random(k), ending))
            for k, each in enumerate((stall, stall, lie))
        ]
        for each in strangers:
            each.start()
        weeks = Weeks(host, options.seed)
        try:
            weeks.work(time.monotonic() + 60 * options.minutes)
        finally:
            ending.set()
            for each in strangers:
                each.join()
            wrong = weeks.wrong + host.failures_in_log() + host.close()
        wrong += report(weeks, run, types=options.types)
        print(f"strangers {dict(counts)}", *wrong, f"wrong     {len(wrong)}", sep="\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
