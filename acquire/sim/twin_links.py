"""Links to a twin of the trigger: a call in this process, or a pseudo-terminal that acts as a real port."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import tty
from typing import Protocol

from acquire.errors import TriggerError

_POLL_S = 0.005
"""Interval at which a twin is polled for bytes that are due."""
_END_S = 5.0


class Twin(Protocol):
    """Bytes in, bytes out, as in `TriggerModel`; neither call waits for anything outside."""

    @property
    def busy(self) -> bool:
        """True if `take` must be called again at once, because the twin's time passes only within it."""
        ...

    def feed(self, data: bytes) -> None:
        """Take bytes that the host has sent."""

    def take(self) -> bytes:
        """Return the bytes for the host, as many as there are by now."""
        ...


class TwinTransport:
    """A twin reached by function calls; `unplug` simulates an unplugged cable."""

    def __init__(self, twin: Twin, name: str = "simulated trigger") -> None:
        self.name = name
        self.bytes_per_s = float("inf")
        self._twin = twin
        self._fed = threading.Event()
        self._unplugged = False

    def read(self) -> bytes:
        self._demand_plugged()
        data = self._twin.take()
        if not data and self._fed.wait(_POLL_S):
            # Before `take`: a request that comes in between is answered now or sets it again.
            self._fed.clear()
            data = self._twin.take()
        return data

    def write(self, data: bytes) -> None:
        self._demand_plugged()
        self._twin.feed(data)
        self._fed.set()

    def close(self) -> None:
        """Do nothing: there is nothing to release."""

    def unplug(self) -> None:
        self._unplugged = True
        self._fed.set()

    def _demand_plugged(self) -> None:
        if self._unplugged:
            raise TriggerError(f"{self.name} is gone: unplugged", hint="check cable and power")


class PtyTwin:
    """Owns a thread that carries bytes between a twin and a pseudo-terminal; ``path`` names the port.

    `close` ends the thread and removes the port, which a driver sees as unplugged. Idempotent.
    """

    def __init__(self, twin: Twin) -> None:
        self._twin = twin
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        # Held open until a driver opens it: a terminal that nobody holds open reads as hung up.
        self._slave = slave
        # A driver that does not read must not stop the thread in which the twin lives.
        os.set_blocking(self._master, False)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._carry_bytes, name="acquire-pty-twin", daemon=True)
        self._thread.start()

    def close(self) -> None:
        if not self._ending.is_set():
            self._ending.set()
            self._thread.join(_END_S)
            os.close(self._slave)
            os.close(self._master)

    def _carry_bytes(self) -> None:
        out = b""
        while not self._ending.is_set():
            writers = [self._master] if out else []
            wait_s = 0 if self._twin.busy and not out else _POLL_S
            readable, writable, _ = select.select([self._master], writers, [], wait_s)
            if readable:
                self._twin.feed(os.read(self._master, 4096))
            if writable:
                with contextlib.suppress(BlockingIOError):  # the terminal's buffer of 20 KB is full
                    out = out[os.write(self._master, out) :]
            if not out:  # otherwise tags wait in the trigger's own queue, and are lost there when it is full
                out = self._twin.take()
