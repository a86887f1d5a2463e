"""The page's process ends while one client follows its stream and another is in the middle of a request."""

from __future__ import annotations

import contextlib
import socket
from pathlib import Path
from urllib.parse import urlsplit

import pytest
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
