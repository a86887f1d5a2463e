"""The page's process ends while one client follows its stream and another is in the middle of a request."""

from __future__ import annotations

import contextlib
import signal
import socket
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from live_daemon import Daemon
from page_server import PageServer


@pytest.mark.parametrize("reads", [True, False])
def test_pending_requests_do_not_fail_when_the_page_ends(tmp_path: Path, reads: bool) -> None:
    server = PageServer(tmp_path / "c.sock", tmp_path)
    place = urlsplit(server.address)
    head = f"Host: {place.netloc}\r\nAuthorization: Bearer {server.operator}\r\n"
    with contextlib.ExitStack() as stack:
        stack.callback(server.close)
        follows, halts = (
            stack.enter_context(socket.create_connection((place.hostname, place.port), 60)) for _ in range(2)
        )
        follows.sendall(f"GET /api/live HTTP/1.1\r\n{head}\r\n".encode())
        assert follows.recv(12) == b"HTTP/1.1 200"
        halts.sendall(f"POST /api/mark HTTP/1.1\r\n{head}Content-Length: 100\r\n\r\n".encode() + b"{")
        if reads:
            follows.recv(2**16)
        server.close()
        with contextlib.suppress(ConnectionError):
            assert halts.recv(2**16) == b""
    log = server.log.read_text()
    assert "Traceback" not in log, log
    assert "timeout graceful shutdown" not in log


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_page_that_is_told_to_end_has_succeeded(tmp_path: Path, number: int) -> None:
    """systemd, and any script, took the death by a signal for a failure."""
    with contextlib.closing(PageServer(tmp_path / "c.sock", tmp_path)) as server:
        # Until then the signals are not its own. It yields to other programs: five seconds were too few.
        assert httpx.get(server.address, timeout=60).status_code == 200
        server.process.send_signal(number)
        assert server.process.wait(60) == 0


def test_the_link_leads_to_the_page_that_the_daemon_has_started(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with contextlib.closing(Daemon(tmp_path, f"web.port={port}")) as daemon:
        assert daemon("web", "--link").out.startswith(f"http://127.0.0.1:{port}/#token=")
        elsewhere = daemon("web", "--link", "--port", port + 1)
        assert elsewhere.out.startswith(f"http://127.0.0.1:{port + 1}/#token=")
        assert daemon("web", "--link", "--config", "rig-demo").out.startswith("http://127.0.0.1:8300/#token=")
        unknown = daemon("web", "--link", "--port", 0)
        assert unknown.code == 2
        assert "the page listens on any free port (web.port = 0)" in unknown.err
    nowhere = daemon("web", "--link")
    assert nowhere.out.startswith("http://127.0.0.1:8300/#token=")
    assert "no daemon listens on" in nowhere.err
