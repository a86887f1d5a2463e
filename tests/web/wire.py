"""Between a browser and the page's server: connections that can be cut without either end being told."""

from __future__ import annotations

import contextlib
import socket
import threading
from urllib.parse import urlsplit


class Wire:
    """Passes bytes on, both ways; `cut` forgets those connections that there are, and later ones work."""

    def __init__(self, address: str) -> None:
        self._far = (urlsplit(address).hostname or "", urlsplit(address).port or 0)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"http://127.0.0.1:{self._listener.getsockname()[1]}/"
        self._cut = threading.Event()
        self._sockets: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def cut(self) -> None:
        before, self._cut = self._cut, threading.Event()
        before.set()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # closed
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(self._far)
                self._sockets += [near, far]
                for ends in ((near, far), (far, near)):
                    self._threads.append(threading.Thread(target=_pass_on, args=(*ends, self._cut)))
                    self._threads[-1].start()

    def close(self) -> None:
        for one in (self._listener, *self._sockets):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        for thread in self._threads:
            thread.join()


def _pass_on(near: socket.socket, far: socket.socket, cut: threading.Event) -> None:
    with contextlib.suppress(OSError):
        while part := near.recv(2**16):
            if not cut.is_set():
                far.sendall(part)
        if not cut.is_set():
            far.shutdown(socket.SHUT_WR)
