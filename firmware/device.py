"""The compiled gateware as a device at the end of a link: bytes in, bytes out, with simulated time.

Its time runs independently: as many clocks as this machine can compute, about two million per second, while
it is busy, few while it is idle, none while the host takes no bytes.
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

from firmware.cxxrtl import Pin, Twin
from firmware.top import Build

if TYPE_CHECKING:
    from collections.abc import Callable

_SLICE_CLOCKS = 4000
"""Clocks between two polls of the link: at most those of one answer."""
_IDLE_CLOCKS = 400
_WORK_S = 0.01


class RtlDevice:
    """The interface of a twin for `acquire.sim.twin_links`. Thread-safe.

    Parameters
    ----------
    watch : called with the twin after every slice of time, and wherever a run begins or ends
    """

    def __init__(self, build: Build | None = None, watch: Callable[[Twin], None] | None = None) -> None:
        self.twin = Twin(build or Build(), record=False)
        self._watch = watch
        self._lock = threading.Lock()

    @property
    def busy(self) -> bool:
        """Whether the device is active: pauses between calls would slow it down."""
        return self.twin.link_busy or bool(self.twin.pins & Pin.RUNNING)

    def feed(self, data: bytes) -> None:
        """Take bytes from the host; their transmission takes simulated time."""
        with self._lock:
            self.twin.feed(data)

    def take(self) -> bytes:
        """Simulate for at most 10 ms of the host's time, until there are bytes for the host; return them."""
        limit_s = time.monotonic() + _WORK_S
        with self._lock:
            while True:
                clocks = _SLICE_CLOCKS if self.busy else _IDLE_CLOCKS
                while clocks > 0:  # `advance` stops where a run begins or ends: `watch` is called at each
                    clocks -= self.twin.advance(clocks)
                    if self._watch is not None:
                        self._watch(self.twin)
                data = self.twin.take()
                if data or not self.busy or time.monotonic() > limit_s:
                    return data

    def set(self, name: str, level: bool) -> None:
        """Set an input pin."""
        with self._lock:
            self.twin.set(name, level)

    def close(self) -> None:
        """Close the device, which must not be used any more. Idempotent."""
        with self._lock:
            self.twin.close()
