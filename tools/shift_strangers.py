"""Disturbances for `tools/shifts.py`: clients that stall, flood and lie, and browsers that come and go."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from shutil import which
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import random
    from collections import Counter
    from collections.abc import Callable

    from tools.shift_host import Host

CONNECT_S = 5.0
FLOOD_S = 6.0
STALL_S = (2.0, 40.0)
SEEN_MS = 30_000
ADDRESSES = {"stall": "127.0.0.11", "flood": "127.0.0.12", "lie": "127.0.0.13"}
"""Each client has its own address, as if on another computer: rates are limited by address."""


def stall(host: Host, counts: Counter[str], chance: random.Random, ending: threading.Event) -> None:
    """Request the stream of pictures or events, and never read it."""
    while not ending.is_set():
        with contextlib.suppress(OSError), _connected(host, chance, ADDRESSES["stall"]) as connection:
            by_page = connection.family == socket.AF_INET
            path = "/api/live?pictures=true" if by_page else "/events?status_s=0.1"
            head = [f"GET {path} HTTP/1.1", "Host: 127.0.0.1", f"Authorization: Bearer {host.token}"]
            connection.sendall("\r\n".join([*head, "", ""]).encode())
            counts["stalled"] += 1
            ending.wait(chance.uniform(*STALL_S))
        ending.wait(1.0)


def flood(host: Host, counts: Counter[str], chance: random.Random, ending: threading.Event) -> None:
    """Send as many requests as possible for some seconds, half of them with the token."""
    while not ending.wait(chance.uniform(5.0, 25.0)):
        end_s, with_token = time.monotonic() + FLOOD_S, chance.random() < 0.5
        while time.monotonic() < end_s and not ending.is_set():
            with contextlib.suppress(OSError), _connected(host, chance, ADDRESSES["flood"]) as connection:
                by_page = connection.family == socket.AF_INET
                path = "/api/status" if by_page else "/status"
                word = f"Authorization: Bearer {host.token}\r\n" if with_token else ""
                request = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n{word}\r\n".encode()
                for _ in range(chance.randint(1, 40)):
                    connection.sendall(request)
                    counts["flooded"] += 1
                    answer = connection.recv(2**16)
                    if not answer:
                        break
                    _note_failure(answer, counts)
            ending.wait(0.005)


def lie(host: Host, counts: Counter[str], chance: random.Random, ending: threading.Event) -> None:
    """Send invalid or incomplete requests, or invalid JSON."""
    while not ending.wait(chance.uniform(0.2, 2.0)):
        with contextlib.suppress(OSError), _connected(host, chance, ADDRESSES["lie"]) as connection:
            prefix = "/api" if connection.family == socket.AF_INET else ""
            connection.sendall(_lie(host, chance, prefix))
            counts["lied"] += 1
            if chance.random() < 0.3:
                ending.wait(chance.uniform(0.0, 15.0))  # and stays connected
            connection.settimeout(0.5)
            _note_failure(connection.recv(2**16), counts)


def _lie(host: Host, chance: random.Random, prefix: str) -> bytes:
    head = f"Host: 127.0.0.1\r\nAuthorization: Bearer {host.token}\r\nContent-Type: application/json\r\n"
    body = chance.choice(
        [
            '{"path":',
            "[]",
            "null",
            '{"lines": -1}',
            '{"lines": 1e99}',
            '{"path": "/etc/shadow/x.zarr"}',
            '"\\ud800"',
            "{" * 5000,
        ]
    )
    path = chance.choice(["start", "mark", "arm", "jobs", "calibration", "recordings/..%2f..%2fetc/hold"])
    whole = f"POST {prefix}/{path} HTTP/1.1\r\n{head}Content-Length: {len(body)}\r\n\r\n{body}".encode()
    return chance.choice(
        [
            whole if path != "arm" else whole.replace(b"/arm", b"/mark"),  # an operator's work is left alone
            whole[: chance.randint(1, len(whole) - 1)],
            f"POST {prefix}/mark HTTP/1.1\r\n{head}Content-Length: 99999999999\r\n\r\n{{".encode(),
            f"GET {prefix}/recordings/{'x' * 20000}/picture HTTP/1.1\r\n{head}\r\n".encode(),
            f"GET {prefix}/videos/%00/frames?first=-1&count=9999999 HTTP/1.1\r\n{head}\r\n".encode(),
            os.urandom(chance.randint(1, 4000)),
            b"\r\n" * 200,
        ]
    )


def browse(host: Host, counts: Counter[str], chance: random.Random, ending: threading.Event) -> None:
    """Open one to three tabs for a while, on any screen."""
    from playwright.sync_api import Error, sync_playwright

    screens = ("watch", "aim", "recordings", "health", "setup")
    with sync_playwright() as playwright:
        flags = ["--no-sandbox"] if os.geteuid() == 0 else []
        while not ending.wait(chance.uniform(5.0, 30.0)):
            browser = playwright.chromium.launch(
                executable_path=which("chromium"), args=[*flags, "--disable-gpu"]
            )
            with contextlib.suppress(Error):  # the page was killed in the meantime, or the host is too busy
                context = browser.new_context()
                for _ in range(chance.randint(1, 3)):
                    tab = context.new_page()
                    tab.on("pageerror", lambda error: counts.update([f"page error: {error}"]))
                    tab.goto(f"{host.address}/#token={host.token}", timeout=SEEN_MS)
                    tab.wait_for_selector("body[data-state]", timeout=SEEN_MS)
                    tab.goto(f"{host.address}/#/{chance.choice(screens)}", timeout=SEEN_MS)
                    counts["tabs"] += 1
                ending.wait(chance.uniform(1.0, 20.0))
            browser.close()


def _connected(host: Host, chance: random.Random, address: str) -> socket.socket:
    """Connect to the page or to the daemon's socket."""
    if chance.random() < 0.6:
        return socket.create_connection(("127.0.0.1", host.port), CONNECT_S, (address, 0))
    connection = socket.socket(socket.AF_UNIX)
    connection.settimeout(CONNECT_S)
    try:
        connection.connect(str(host.socket))
    except OSError:
        connection.close()
        raise
    return connection


def _note_failure(answer: bytes, counts: Counter[str]) -> None:
    """A failing server answers 5xx; 503 means that there is no daemon behind the page."""
    status = answer[9:12] if answer.startswith(b"HTTP/1.1 ") else b""
    if status.startswith(b"5") and status != b"503":
        words = answer.partition(b"\r\n\r\n")[2][:200].decode(errors="replace")
        counts[f"answered {status.decode()}: {words}"] += 1


STRANGERS: dict[str, Callable[[Host, Counter[str], random.Random, threading.Event], None]] = {
    "stall": stall,
    "flood": flood,
    "lie": lie,
    "browser": browse,
}
