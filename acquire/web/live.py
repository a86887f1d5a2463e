"""The live picture: a thread that looks at the rings while somebody watches, and keeps two seconds.

Every page reads the same messages, each from its own place; one that is too slow finds that what it has not
read is gone, and goes on with what is new. Nobody watching: nothing is looked at, nothing mapped.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from typing import TYPE_CHECKING

from acquire.errors import AcquireError
from acquire.stream.peek import Peek
from acquire.stream.ring import RingShape
from acquire.web.decimate import Decimator, Scale
from acquire.web.frames import rows_message
from acquire.web.places import shape_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.daemon.facts import Rings, Setup

TURN_S = 0.05
"""Twenty pictures a second."""
KEPT_S = 2.0
MOST_BLOCKS = 4096
"""Looked at in one turn; the rest waits for the next."""

log = logging.getLogger("acquire.web")


class Live:
    """`watch`, `leave`, `show` and `after` are for the event loop's thread; the rest is the looker's."""

    def __init__(self, wake: Callable[[], None]) -> None:
        """``wake``: called from the looking thread when there is something new."""
        self._wake = wake
        self._messages: deque[tuple[int, bytes]] = deque(maxlen=round(2 * KEPT_S / TURN_S))
        self._lock = threading.Lock()
        self._count = 0
        self._watchers = 0
        self._wanted: tuple[Rings, Setup] | None = None
        self._changed = threading.Event()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="live", daemon=True)
        self.error = ""
        """Why there is no picture, in words."""

    def begin(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """End the thread and release the rings."""
        self._ended = True
        self._changed.set()
        self._thread.join(10.0)

    def show(self, rings: Rings | None, setup: Setup | None) -> None:
        """Look at these rings from now on; None: at none."""
        self._wanted = (rings, setup) if rings is not None and setup is not None and rings.arms else None
        self._changed.set()

    def watch(self) -> int:
        """Somebody watches; the place in the stream of pictures that comes next."""
        self._watchers += 1
        self._changed.set()
        return self._count

    def leave(self) -> None:
        self._watchers -= 1
        self._changed.set()

    def after(self, number: int) -> tuple[int, list[bytes]]:
        """Messages from place ``number`` on, as far as they are kept, and the next place."""
        with self._lock:
            return self._count, [one for k, one in self._messages if k >= number]

    # ---- the thread that looks

    def _run(self) -> None:
        while not self._ended:
            wanted = self._wanted if self._watchers else None
            if wanted is None:
                self._changed.wait()
                self._changed.clear()
                continue
            try:
                self._look_at(*wanted)
            except AcquireError as error:
                if str(error) != self.error:
                    log.warning("live picture: %s", error)
                self.error = str(error)
                self._changed.wait(1.0)
                self._changed.clear()

    def _look_at(self, rings: Rings, setup: Setup) -> None:
        """Until other rings are wanted, or none. Raises DeviceError where they cannot be had."""
        eyes: dict[str, _Eye] = {}
        try:
            for arm, place in rings.arms.items():
                eyes[arm] = _Eye(arm, place.path, shape_of(place), setup)
            self.error = ""
            while not self._ended and self._watchers and self._wanted == (rings, setup):
                began_s = time.monotonic()
                for eye in eyes.values():
                    if (told := eye.look()) is not None:
                        with self._lock:
                            self._messages.append((self._count, told))
                            self._count += 1
                self._wake()
                left_s = TURN_S - (time.monotonic() - began_s)
                if left_s > 0:
                    time.sleep(left_s)
        finally:
            for eye in eyes.values():
                eye.close()


class _Eye:
    """On one arm."""

    def __init__(self, arm: str, path: str, shape: RingShape, setup: Setup) -> None:
        self._arm = arm
        self._peek = Peek(arm, path, shape)
        line_bytes = shape.width * (1 if shape.dtype == "uint8" else 2)
        self._scale = Scale.of(setup.line_rate_hz, line_bytes, setup.white_dn)
        self._decimator = Decimator(self._scale, shape.width)
        self._facts = {
            "step": self._scale.step,
            "row_s": self._scale.step / setup.line_rate_hz,
            "white_dn": setup.white_dn,
        }

    def look(self) -> bytes | None:
        """What has come since the last time."""
        newest_ns = 0
        for _ in range(MOST_BLOCKS):
            block = self._peek.next()
            if block is None:
                break
            first_line, count, lost = block.first_line, len(block.flags), bool(block.losses)
            lines = self._decimator.sampled_lines(first_line, count)
            pixels = block.pixels[lines - first_line]  # a copy: the block may be overwritten at any moment
            newest_ns = block.time_ns
            del block  # a view of the ring keeps its memory mapped
            if self._peek.took():
                self._decimator.add(first_line, count, lines, pixels, lost=lost)
        rows = self._decimator.take()
        if rows is None:
            return None
        age_ms = (time.monotonic_ns() - newest_ns) / 1e6 if newest_ns else 0.0
        return rows_message(self._arm, rows, {**self._facts, "lapped": self._peek.lapped, "age_ms": age_ms})

    def close(self) -> None:
        self._peek.close()
