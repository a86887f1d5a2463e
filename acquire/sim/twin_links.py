"""Ways to a twin of the trigger's device: a call in this process, or a pseudo-terminal like a real port."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import tty
from typing import Protocol

from acquire.errors import TriggerError

_LOOK_S = 0.005
"""A twin is asked this often for what is due."""
_END_S = 5.0


class Twin(Protocol):
    """Bytes in, bytes out, as `TriggerModel`; neither call waits for anything outside."""

    @property
    def busy(self) -> bool:
        """It needs to be asked again at once: its time passes only within `take`."""
        ...

    def feed(self, data: bytes) -> None: ...

    def take(self) -> bytes: ...


class TwinTransport:
    """The twin at the end of a function call; `unplug` does what its name says."""

    def __init__(self, twin: Twin, name: str = "simulated trigger") -> None:
        self.name = name
        self.bytes_per_s = float("inf")
        self._twin = twin
        self._fed = threading.Event()
        self._unplugged = False

    def read(self) -> bytes:
        self._demand_plugged()
        data = self._twin.take()
        if not data and self._fed.wait(_LOOK_S):
            self._fed.clear()
            data = self._twin.take()
        return data

    def write(self, data: bytes) -> None:
        self._demand_plugged()
        self._twin.feed(data)
        self._fed.set()

    def close(self) -> None:
        """Nothing to release."""

    def unplug(self) -> None:
        self._unplugged = True
        self._fed.set()

    def _demand_plugged(self) -> None:
        if self._unplugged:
            raise TriggerError(f"{self.name} is gone: unplugged", hint="check cable and power")


class PtyTwin:
    """Owns a thread that carries the bytes between a twin and a pseudo-terminal, whose ``path`` is a port.

    `close` ends the thread and takes the port away: a driver sees it unplugged. Idempotent.
    """

    def __init__(self, twin: Twin) -> None:
        self._twin = twin
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        # Held open until somebody else may hold it: a terminal without a user reads as hung up.
        self._slave = slave
        os.set_blocking(self._master, False)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._live, name="acquire-pty-twin", daemon=True)
        self._thread.start()

    def close(self) -> None:
        if not self._ending.is_set():
            self._ending.set()
            self._thread.join(_END_S)
            os.close(self._slave)
            os.close(self._master)

    def _live(self) -> None:
        out = b""
        while not self._ending.is_set():
            writers = [self._master] if out else []
            wait_s = 0 if self._twin.busy and not out else _LOOK_S
            readable, writable, _ = select.select([self._master], writers, [], wait_s)
            if readable:
                self._twin.feed(os.read(self._master, 4096))
            if writable:
                with contextlib.suppress(BlockingIOError):  # the terminal's 20 KB are full
                    out = out[os.write(self._master, out) :]
            if not out:  # else the device's own queues have to wait, and to lose
                out = self._twin.take()
