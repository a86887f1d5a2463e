"""How long the disk of the recordings lasts.

A file system that is gone, as a server that does not answer, holds whoever asks it for ever: a thread of its
own asks, and the status goes on with what it learnt last.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from acquire.daemon.messages import DiskStatus
from acquire.lines import ARMS

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from acquire.config import RigConfig

LOOK_EVERY_S = 2.0
WINDOW_S = 60.0
LEAST_S = 5.0
"""Of a recording, before its own rate is believed."""


def disk_watch(config: RigConfig) -> DiskWatch:
    """Of the rig's directory."""
    line_bytes = config.pixels * np.dtype(config.cameras.a.dtype).itemsize
    per_s = len(ARMS) * line_bytes * config.line_rate_hz * config.simulation.speed
    return DiskWatch(config.recording.directory.absolute(), round(config.recording.reserve_gb * 1e9), per_s)


class DiskWatch:
    """The directory's disk, looked at now and then; `check` never waits.

    Parameters
    ----------
    directory : of recordings without a path of their own
    reserve_bytes : of its disk that recordings leave free
    expected_bytes_per_s : of the cameras, not compressed
    """

    def __init__(
        self,
        directory: Path,
        reserve_bytes: int,
        expected_bytes_per_s: float,
        free_bytes: Callable[[Path], int] = lambda path: shutil.disk_usage(path).free,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._directory = directory
        self._reserve_bytes = reserve_bytes
        self._expected = expected_bytes_per_s
        self._free_bytes = free_bytes
        self._now_s = now_s
        self._looks: deque[tuple[float, int]] = deque()
        self._asked_s = -LOOK_EVERY_S
        self._thread: threading.Thread | None = None

    def keep(self, reserve_bytes: int) -> None:
        """Recordings leave so much free from now on."""
        self._reserve_bytes = reserve_bytes

    def check(self, *, recording: bool) -> None:
        """Ask again, if it is time and the last question was answered."""
        if not recording:
            while len(self._looks) > 1:  # what others write says nothing of the next recording
                self._looks.popleft()
        if self._thread is not None and self._thread.is_alive():
            return
        if self._now_s() - self._asked_s < LOOK_EVERY_S:
            return
        self._asked_s = self._now_s()
        self._thread = threading.Thread(target=self._ask, name="disk-watch", daemon=True)
        self._thread.start()

    def _ask(self) -> None:
        try:
            free = self._free_bytes(self._directory)
        except OSError:  # gone, or not to be asked: nothing is known of it, which the status says
            self._looks.clear()
            return
        self._looks.append((self._now_s(), free))
        while self._looks[0][0] < self._looks[-1][0] - WINDOW_S:
            self._looks.popleft()

    @property
    def status(self) -> DiskStatus | None:
        """None before the first answer, and where the disk cannot be asked."""
        looks = list(self._looks)
        if not looks:
            return None
        (first_s, first), (last_s, free) = looks[0], looks[-1]
        falling = (first - free) / (last_s - first_s) if last_s - first_s >= LEAST_S else 0.0
        rate = falling if falling > 0 else self._expected
        return DiskStatus(
            directory=self._directory,
            free_bytes=free,
            reserve_bytes=self._reserve_bytes,
            bytes_per_s=rate,
            seconds_to_full=max(0, free - self._reserve_bytes) / rate,
        )

    def close(self) -> None:
        """Wait for the question under way, a moment: a thread that hangs is left."""
        if self._thread is not None:
            self._thread.join(1.0)
