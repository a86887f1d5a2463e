"""Processor time that clients cost: of every process of the daemon, without clients and with five.

``python -m tools.bench_clients --out DIR`` runs a daemon with cameras of stored lines at 928 MB/s and the
page's process, as ``tools/bench_page.py`` does. It measures the processor time and the changes of context of
each process without clients, with five pages that show pictures, and with five clients of the control socket
that follow news and status, one of which never reads; alternating, ``--rounds`` times. Unlike the latency of
the grabbers, this hardly depends on what else the machine does. ``--recording``: while a recording is
written, for which the disk has to be fast enough.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree
from typing import Any

from acquire.client import Client
from tools.bench_page import TimedRig, beside_a_daemon, page, rig_of
from tools.results import add_option, recorded

CLIENTS = 5
SETTLE_S = 3.0
FOLLOW = """
import os, select, socket, sys
os.nice(19)
address, request, clients = sys.argv[1], sys.argv[2], []
for _ in range(int(sys.argv[3])):
    made = socket.socket(socket.AF_INET if address.isdecimal() else socket.AF_UNIX)
    made.connect(("127.0.0.1", int(address)) if address.isdecimal() else address)
    made.sendall(request.encode())
    clients.append(made)
while True:
    for client in select.select(clients[1:], [], [])[0]:
        client.recv(2**18)
"""
"""A program of its own, since real clients run on other computers; the first client never reads."""


@dataclass(frozen=True)
class Cost:
    """Milliseconds of processor time, and changes of context, in a second."""

    ms: float
    switches: float


def _spent(pid: int) -> tuple[float, int]:
    """Return the processor time in seconds and the changes of context of a process with all its threads."""
    # The clock of another process, in nanoseconds: the kernel's MAKE_PROCESS_CPUCLOCK.
    seconds = time.clock_gettime((~pid << 3) | 2)
    switches = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # a thread that has just ended
            lines = (task / "status").read_text().splitlines()
            switches += sum(int(line.split()[1]) for line in lines if "ctxt_switches" in line)
    return seconds, switches


def cost(pids: dict[str, int], seconds: float) -> dict[str, Cost]:
    """Measure each process for some seconds."""
    before, begun_s = {name: _spent(pid) for name, pid in pids.items()}, time.monotonic()
    time.sleep(seconds)
    after, took_s = {name: _spent(pid) for name, pid in pids.items()}, time.monotonic() - begun_s
    return {
        name: Cost(
            1000 * (after[name][0] - before[name][0]) / took_s, (after[name][1] - before[name][1]) / took_s
        )
        for name in pids
    }


@contextlib.contextmanager
def following(address: str, request: str) -> Iterator[None]:
    process = subprocess.Popen([sys.executable, "-c", FOLLOW, address, request, str(CLIENTS)])
    try:
        time.sleep(SETTLE_S)
        yield
    finally:
        process.kill()
        process.wait()


def measure(client: Client, page_pid: int, url: str, socket_path: Path, options: Any, run: Any) -> None:
    """Print and keep the costs of each kind of client, round by round."""
    port, token = re.findall(r":(\d+)/#token=(\S+)", url)[0]
    head = f"Host: 127.0.0.1:{port}\r\nAuthorization: Bearer {token}\r\n\r\n"
    cases: dict[str, tuple[str, str] | None] = {
        "no client": None,
        f"{CLIENTS} pages": (port, f"GET /api/live HTTP/1.1\r\n{head}"),
        f"{CLIENTS} followers": (
            str(socket_path),
            "GET /events?status_s=0.5 HTTP/1.1\r\nHost: acquire\r\n\r\n",
        ),
    }
    workers = {name: pid for name, pid in client.status().processes.items() if pid}
    pids = {"daemon": os.getpid(), "page": page_pid, **workers}
    while_what = "recording" if options.recording else "armed"
    for number in range(options.rounds):
        for name, case in cases.items():
            with following(*case) if case else contextlib.nullcontext():
                found = cost(pids, options.seconds)
            figures = {process: f"{one.ms:.0f} ms, {one.switches:.0f} ×" for process, one in found.items()}
            print(f"{while_what}, {name:12} {figures}", flush=True)
            columns = {f"{process}_ms_per_s": one.ms for process, one in found.items()}
            run.add(f"{while_what}, {name}, round {number + 1}", **columns)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--small", action="store_true", help="512 pixels × 33 klines/s")
    parser.add_argument("--recording", action="store_true", help="during a recording, which needs the disk")
    add_option(parser)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    with (
        recorded("bench_clients", keep=options.record) as run,
        tempfile.TemporaryDirectory(dir=options.out) as place,
    ):
        directory = Path(place)
        socket_path = directory / "c.sock"

        def measured(_: TimedRig) -> None:
            with page(socket_path, directory) as (process, url):
                client = Client(socket_path)
                client.arm(force=True)
                if options.recording:
                    client.start(directory / "r.zarr")
                time.sleep(SETTLE_S)
                measure(client, process.pid, url, socket_path, options, run)
                if options.recording:
                    client.stop()
                    rmtree(directory / "r.zarr")
                client.disarm()

        beside_a_daemon(rig_of(directory, small=options.small, realtime=False), socket_path, measured)


if __name__ == "__main__":
    main()
