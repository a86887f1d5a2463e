"""Cost of the operator's page for the capture, and its speed: with and without clients, in one run.

``python tools/bench_page.py --out DIR`` runs a daemon with cameras of stored lines and the page's process. It
records without clients and then with five that follow the live picture, one of which never reads, alternating
``--rounds`` times. It prints the lost lines, the latency of the grabbers' blocks and the page's processor
time. Then it opens the page in Debian's chromium, if that and playwright are installed, and measures the time
to the first picture and the delay of the state. The clients run in a process of the lowest priority, since
real ones run on other computers. ``--small`` is 2 x 512 px x 33 klines/s, with pictures of 2 x 1 MB/s; the
default is 928 MB/s in total.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import re
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from shutil import rmtree, which
from typing import Any

import numpy as np
import psutil

from acquire.capacity.latency import Latencies, TimedOpener
from acquire.client import Client
from acquire.config import RigConfig, load_rig
from acquire.daemon.endpoint import Endpoint
from acquire.daemon.plan import Run, worker_modules
from acquire.daemon.server import Daemon
from acquire.daemon.service import Service
from acquire.processes.nursery import warm_up
from acquire.rig import Rig
from acquire.web.tokens import load_tokens
from tools.results import add_option, recorded

CLIENTS = 4
"""Clients that read; one more does not."""
COMMON: dict[str, Any] = {
    "cameras.a.driver": "pattern",
    "cameras.b.driver": "pattern",
    "cameras.a.pixel_format": "Mono8",
    "cameras.b.pixel_format": "Mono8",
    "recording.codec": "none",
    "check.enable": False,
}
FULL = {
    "geometry.stages": 4096,
    "geometry.substeps": 1,
    "trigger.substep_ticks": 794,
    "stream.block_lines": 1024,
}
SMALL = {"geometry.stages": 512}


class TimedRig:
    """A rig whose cameras record the latency of their blocks."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self.latencies = {arm: Latencies() for arm in "ab"}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._rig, name)

    def openers(self) -> dict[str, Any]:
        return {arm: TimedOpener(opener, self.latencies[arm]) for arm, opener in self._rig.openers().items()}


def rig_of(directory: Path, *, small: bool, realtime: bool) -> RigConfig:
    changes = COMMON | (SMALL if small else FULL) | {"stream.realtime": realtime}
    ring: dict[str, Any] = {} if small else {"stream.ring_slots": 64}
    config = load_rig("rig-demo", {**changes, **ring, "recording.directory": str(directory)})
    return (
        config
        if small
        else config.model_copy(
            update={"stream": config.stream.model_copy(update={"ring_seconds": None, "ring_slots": 64})}
        )
    )


def beside_a_daemon(config: RigConfig, socket_path: Path, measure: Callable[[TimedRig], None]) -> None:
    """Run ``measure`` in a thread; the daemon has the main thread, for its signals, and ends with it."""
    with contextlib.closing(Endpoint(socket_path)) as endpoint, Rig(config) as plain:
        rig = TimedRig(plain)
        warm_up(*worker_modules(plain), "acquire.capacity.latency")
        service = Service(config, lambda _="rig": Run(config, rig))  # type: ignore[arg-type,misc]

        def measured() -> None:
            try:
                measure(rig)
            finally:
                os.kill(os.getpid(), signal.SIGTERM)

        with ThreadPoolExecutor(1) as threads:
            measuring = threads.submit(measured)
            asyncio.run(Daemon(service, endpoint).run())
            measuring.result()


@contextlib.contextmanager
def page(socket_path: Path, directory: Path) -> Iterator[tuple[psutil.Process, str]]:
    given = {"socket": str(socket_path), "directory": str(directory), "web": {"port": 0}}
    words = [sys.executable, "-m", "acquire", "web", "--owned", "--given", json.dumps(given)]
    log = directory / "web.log"
    with log.open("wb") as file:
        process = subprocess.Popen(words, stdin=subprocess.PIPE, stderr=file)
    while not (found := re.findall(r"page: http://127.0.0.1:(\d+)/", log.read_text())):
        time.sleep(0.05)
    token = load_tokens(socket_path.with_name(socket_path.name + ".tokens")).operator
    yield psutil.Process(process.pid), f"http://127.0.0.1:{found[0]}/#token={token}"
    process.communicate()


def follow(address: str, bytes_read: Any, ending: Any) -> None:
    """Follow the live picture with all clients until the end; the last one never reads."""
    os.nice(19)
    port, token = re.findall(r":(\d+)/#token=(\S+)", address)[0]
    head = f"GET /api/live HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nAuthorization: Bearer {token}\r\n\r\n"
    with contextlib.ExitStack() as stack:
        clients = [socket.create_connection(("127.0.0.1", int(port))) for _ in range(CLIENTS + 1)]
        for client in clients:
            stack.enter_context(client)
            client.sendall(head.encode())
        while not ending.is_set():
            for client in select.select(clients[:CLIENTS], [], [], 0.2)[0]:
                bytes_read.value += len(client.recv(2**18))


@contextlib.contextmanager
def followers(address: str) -> Iterator[Any]:
    """Total number of bytes that they have read so far."""
    spawn = get_context("spawn")
    bytes_read, ending = spawn.Value("q", 0), spawn.Event()
    process = spawn.Process(target=follow, args=(address, bytes_read, ending))
    process.start()
    try:
        yield bytes_read
    finally:
        ending.set()
        process.join()


def take(client: Client, rig: TimedRig, directory: Path, name: str, seconds: float) -> dict[str, Any]:
    """Make one recording; return its lost lines and the latencies of its blocks."""
    for latencies in rig.latencies.values():
        latencies.clear()
    path = directory / f"{name}.zarr"
    client.start(path)
    time.sleep(seconds)
    late = {arm: one.percentiles_ms() for arm, one in rig.latencies.items()}
    status = client.stop()
    assert status.last is not None
    rmtree(path)
    lost = sum(sum(arm.lost.values()) for arm in status.arms.values())
    rate = min(arm.rate_hz for arm in status.arms.values())
    p999 = max(one["p99.9"] for one in late.values())
    p50 = max(one["p50"] for one in late.values())
    return {
        "lost": lost,
        "condition": status.last.condition,
        **({} if status.last.condition == "GOOD" else {"because": status.last.end_reason}),
        "lines": status.last.lines,
        "rate_hz": rate,
        "p50_ms": p50,
        "p99.9_ms": p999,
    }


def cores(process: psutil.Process, seconds: float) -> float:
    before = sum(process.cpu_times()[:2])
    time.sleep(seconds)
    return (sum(process.cpu_times()[:2]) - before) / seconds


def browse(address: str, client: Client) -> dict[str, float]:
    """Seconds to the first picture, and from a mark to its appearance on the page."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=which("chromium"), args=["--no-sandbox", "--disable-gpu"]
        )
        context = browser.new_context()
        tab = context.new_page()
        tab.goto(address)
        tab.wait_for_selector("#disarm:enabled")
        tab.locator(".none").first.wait_for(state="hidden")
        begun_s = time.perf_counter()
        tab.goto(address.partition("#")[0])
        tab.locator(".none").first.wait_for(state="hidden")
        found = {"first_picture_s": time.perf_counter() - begun_s}
        late = []
        for k in range(10):
            tab.evaluate(
                """text => { const events = document.getElementById("events");
                   window.seen = new Promise((done) => { new MutationObserver((_, one) => {
                     if (events.textContent.includes(text)) { one.disconnect(); done(Date.now()); }
                   }).observe(events, {childList: true, subtree: true}); }); }""",
                f"bench {k}.",
            )
            sent_s = time.time()
            client.mark(f"bench {k}.")
            late.append(tab.evaluate("window.seen") / 1000 - sent_s)
        browser.close()
    return found | {"state_median_s": sorted(late)[5], "state_max_s": max(late)}


def rounds(
    client: Client,
    rig: TimedRig,
    directory: Path,
    address: str,
    process: psutil.Process,
    options: Any,
    run: Any,
) -> tuple[list[float], list[float]]:
    """p99.9 latency of the grabbers' blocks in ms without and with clients, alternating."""
    alone, followed = [], []
    for number in range(options.rounds):
        found = take(client, rig, directory, f"alone-{number}", options.seconds)
        print("without clients:", found, flush=True)
        run.add(f"recorded, no client, round {number + 1}", **found)
        alone.append(found["p99.9_ms"])
        with followers(address) as bytes_read:
            until_read = time.monotonic() + 30
            while not bytes_read.value and time.monotonic() < until_read:
                time.sleep(0.1)
            before, begun_s = bytes_read.value, time.monotonic()
            spent_s = sum(process.cpu_times()[:2])
            found = take(client, rig, directory, f"followed-{number}", options.seconds)
            took_s = time.monotonic() - begun_s
            share = (sum(process.cpu_times()[:2]) - spent_s) / took_s
            mb_s = (bytes_read.value - before) / took_s / CLIENTS / 1e6
        print(
            f"with {CLIENTS + 1}, one of them stopped: {found}; {mb_s:.2f} MB/s of pictures to each,", end=" "
        )
        print(f"the page's process {share:.3f} cores", flush=True)
        clients = f"{CLIENTS + 1} clients, one of them stopped, round {number + 1}"
        run.add(f"recorded, {clients}", **found)
        run.add(f"page's process, {clients}", cores=share, pictures_to_each_mb_s=mb_s)
        followed.append(found["p99.9_ms"])
    return alone, followed


def compared(alone: list[float], followed: list[float]) -> str:
    """Medians, and between which bounds their ratio lies in nine of ten, from drawing the pairs anew."""
    pairs = np.array([alone, followed])
    drawn = np.random.default_rng(1).integers(len(alone), size=(4000, len(alone)))
    without, beside = np.median(pairs, axis=1)
    each = np.median(pairs[:, drawn], axis=2)
    low, high = np.quantile(each[1] / each[0], (0.05, 0.95)) - 1
    return (
        f"p99.9 {without:.2f} ms without clients, {beside:.2f} with: {beside / without - 1:+.1%}"
        f" ({low:+.1%} to {high:+.1%} in nine of ten draws of the {len(alone)} pairs);"
        f" load {os.getloadavg()[0]:.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--realtime", action="store_true", help="grabbers take precedence, as a rig may ask")
    add_option(parser)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    with (
        recorded("bench_page", keep=options.record) as run,
        tempfile.TemporaryDirectory(dir=options.out) as place,
    ):
        directory = Path(place)

        def measure(rig: TimedRig) -> None:
            with page(directory / "c.sock", directory) as (process, address):
                client = Client(directory / "c.sock")
                client.arm(force=True)
                time.sleep(2)
                taken = rounds(client, rig, directory, address, process, options, run)
                print(compared(*taken))
                used = cores(process, 5.0)
                print(f"without clients: {used:.3f} cores of the page's process")
                run.add("page's process, no client", cores=used, pictures_to_each_mb_s=None)
                if which("chromium"):
                    found = browse(address, client)
                    print("browser:", found)
                    run.add("browser", **found)
                client.disarm()

        beside_a_daemon(
            rig_of(directory, small=options.small, realtime=options.realtime), directory / "c.sock", measure
        )


if __name__ == "__main__":
    main()
