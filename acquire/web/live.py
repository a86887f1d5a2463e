"""The live picture: a thread that reads the rings while a page is watching, and keeps two seconds.

All pages read the same messages, each from its own position. A page that is too slow misses messages that are
no longer kept, and continues with newer ones. If no page is watching, the rings are not even mapped.
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
from acquire.text import cause_in_words
from acquire.web.decimate import Decimator, Scale
from acquire.web.frames import rows_message
from acquire.web.places import shape_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.daemon.facts import Rings, Setup

TURN_S = 0.05
"""Twenty pictures a second."""
RECORDING_TURN_S = 0.1
"""The same during a recording, which takes precedence. A turn costs more than the pixels in it: since the one
before, the lines have displaced everything else from the processors' caches."""
KEPT_S = 2.0
RETRY_S = 1.0
"""Time between two tries to read rings that could not be read."""
MOST_BLOCKS = 4096
"""Largest number of blocks read per turn; the rest waits for the next."""

log = logging.getLogger("acquire.web")


class Live:
    """The event loop calls `watch`, `leave`, `show` and `after`; everything else runs in the thread."""

    def __init__(self, wake: Callable[[], None]) -> None:
        """``wake`` is called from the thread when there is something new."""
        self._wake = wake
        self._messages: deque[tuple[int, bytes]] = deque(maxlen=round(2 * KEPT_S / TURN_S))
        self._lock = threading.Lock()
        self._count = 0
        self._watchers = 0
        self._wanted: tuple[Rings, Setup] | None = None
        self._changed = threading.Event()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="live", daemon=True)
        self.turn_s = TURN_S
        """Time between two pictures; may be set at any time."""
        self.error = ""
        """The reason why there is no picture; empty once there is one, and while none is to be shown."""

    def begin(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """End the thread and release the rings."""
        self._ended = True
        self._changed.set()
        self._thread.join(10.0)

    def show(self, rings: Rings | None, setup: Setup | None) -> None:
        """Read these rings from now on, or none."""
        self._wanted = (rings, setup) if rings is not None and setup is not None and rings.arms else None
        self.error = ""
        self._changed.set()

    def watch(self) -> int:
        """Register a watcher and return the number of the next message."""
        self._watchers += 1
        self._changed.set()
        return self._count

    def leave(self) -> None:
        self._watchers -= 1
        self._changed.set()

    def after(self, number: int) -> tuple[int, list[bytes]]:
        """Return the next number, and the messages from ``number`` on that are still kept."""
        # A deque to which the thread appends while it is walked through raises RuntimeError.
        with self._lock:
            return self._count, [content for k, content in self._messages if k >= number]

    # ---- the thread

    def _run(self) -> None:
        while not self._ended:
            # Read before the wait: a change that comes in between has set `_changed`.
            wanted = self._wanted if self._watchers else None
            if wanted is None:
                self._changed.wait()
                self._changed.clear()
                continue
            try:
                self._read(*wanted)
            except AcquireError as error:
                # It is tried again every second, and logged once.
                if str(error) != self.error:
                    log.warning("live picture: %s", error)
                self._fail(str(error))
            # The thread is the only one that reads the rings: without it, pages would show nothing, for ever.
            except Exception as error:
                if (said := cause_in_words(error)) != self.error:
                    log.exception("live picture")
                self._fail(said)

    def _fail(self, why: str) -> None:
        """Say why there is no picture, and wait before the next try."""
        self.error = why
        self._wake()
        self._changed.wait(RETRY_S)
        self._changed.clear()

    def _read(self, rings: Rings, setup: Setup) -> None:
        """Read rings until others are wanted, or none. Raises DeviceError if they cannot be mapped."""
        arms: dict[str, _ArmReader] = {}
        try:
            for arm, place in rings.arms.items():
                arms[arm] = _ArmReader(arm, place.path, shape_of(place), setup)
            while not self._ended and self._watchers and self._wanted == (rings, setup):
                began_s = time.monotonic()
                for reader in arms.values():
                    if (content := reader.read()) is not None:
                        with self._lock:
                            self._messages.append((self._count, content))
                            self._count += 1
                self.error = ""  # not before: what fails in every turn would be told and withdrawn in turns
                self._wake()
                left_s = self.turn_s - (time.monotonic() - began_s)
                if left_s > 0:
                    time.sleep(left_s)
        finally:
            for reader in arms.values():
                reader.close()


class _ArmReader:
    """Reads the ring of one arm."""

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

    def read(self) -> bytes | None:
        """Return a message with the rows completed since the last call; None if there are none."""
        newest_ns = 0
        for _ in range(MOST_BLOCKS):
            block = self._peek.next()
            if block is None:
                break
            first_line, flags, lost = block.first_line, block.flags.copy(), bool(block.losses)
            lines = self._decimator.sampled_lines(first_line, len(flags))
            pixels = block.pixels[lines - first_line]  # a copy, because the block may be overwritten any time
            newest_ns = block.committed_ns
            del block  # a view of the ring would keep its memory mapped
            if self._peek.took():  # the block was not overwritten while it was copied
                self._decimator.add(first_line, flags, lines, pixels, lost=lost)
        rows = self._decimator.take()
        if rows is None:
            return None
        age_ms = (time.monotonic_ns() - newest_ns) / 1e6 if newest_ns else 0.0
        return rows_message(self._arm, rows, {**self._facts, "lapped": self._peek.lapped, "age_ms": age_ms})

    def close(self) -> None:
        self._peek.close()
