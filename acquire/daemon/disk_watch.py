"""Whether recordings can begin in the configured directory, and how long its disk lasts.

A query of a file system that is gone, such as a network share whose server does not answer, may block for
ever. So a separate thread makes it, and the status keeps the latest answer.
"""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from acquire.daemon.messages import DiskStatus
from acquire.daemon.usable import Place, Trouble, trouble, unreachable
from acquire.errors import StoreError
from acquire.lines import ARMS
from acquire.store.remote import shares_disk

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from acquire.config import RigConfig
    from acquire.daemon.journal import Claim

log = logging.getLogger("acquire.daemon")

LOOK_EVERY_S = 2.0
WINDOW_S = 60.0
"""The rate at which the disk fills is the mean over this time."""
LEAST_S = 5.0
"""Duration of a recording before its measured rate is used."""
SILENT_S = 10.0
"""Time after which a disk that does not answer is reported."""
REFUSAL_S = 1.0
"""Time that a start waits for the disk's answer: it may have gone, or come back, since the last one."""


def disk_watch(config: RigConfig, claim: Claim | None = None) -> DiskWatch:
    """Return the watch of the rig's directory, which ``claim`` keeps from other daemons."""
    line_bytes = config.pixels * np.dtype(config.cameras.a.dtype).itemsize
    per_s = len(ARMS) * line_bytes * config.passing_hz
    if shares_disk(config.recording.upload_to, config.recording.directory.absolute()):
        per_s *= 2  # the copies fill it as well
    directory = config.recording.directory.absolute()
    place = Place(directory, claim)
    reserve_bytes = config.recording.reserve_bytes
    return DiskWatch(directory, reserve_bytes, per_s, look=place.look, take_other=place.take_other)


class DiskWatch:
    """Queries the directory and its disk from time to time; `check` never waits.

    Parameters
    ----------
    directory : directory of recordings for which no path is given
    reserve_bytes : bytes of its disk that recordings leave free
    expected_bytes_per_s : uncompressed rate of the cameras, and of the copies on the same disk
    free_bytes, now_s : as measured by the disk and the clock
    look, take_other : see `Place`
    """

    def __init__(
        self,
        directory: Path,
        reserve_bytes: int,
        expected_bytes_per_s: float,
        *,
        free_bytes: Callable[[Path], int] = lambda path: shutil.disk_usage(path).free,
        now_s: Callable[[], float] = time.monotonic,
        look: Callable[[], Trouble | None] = lambda: None,
        take_other: Callable[[], bool] = lambda: False,
    ) -> None:
        self._directory = directory
        self._reserve_bytes = reserve_bytes
        self._expected = expected_bytes_per_s
        self._free_bytes = free_bytes
        self._look = look
        self._take_other = take_other
        self._is_other = False
        self._trouble: Trouble | None = None
        self._was_away = False
        self._now_s = now_s
        self._looks: deque[tuple[float, int]] = deque()
        self._changing = threading.Lock()
        """Held while `_looks` is changed, and never during a query."""
        self._asked_s = -LOOK_EVERY_S
        self._thread: threading.Thread | None = None

    def keep(self, reserve_bytes: int) -> None:
        """Set the bytes that recordings leave free from now on."""
        self._reserve_bytes = reserve_bytes

    def check(self, *, recording: bool) -> None:
        """Query again, if it is time and the last query was answered."""
        if not recording:
            with self._changing:
                while len(self._looks) > 1:  # other programs' writes do not predict the next recording
                    self._looks.popleft()
        # One query at a time: each that hangs would leave another thread behind.
        if self._thread is not None and self._thread.is_alive():
            return
        if self._now_s() - self._asked_s < LOOK_EVERY_S:
            return
        self._begin()

    def refuse(self, path: Path) -> None:
        """Raise StoreError if ``path`` is in the directory, and no recording can begin there now."""
        if not path.is_relative_to(self._directory):
            return
        if self._thread is None or not self._thread.is_alive():
            self._begin()
        assert self._thread is not None
        self._thread.join(REFUSAL_S)
        if (found := self.trouble) is not None:
            raise StoreError(found.text, hint=found.hint)

    def came_back(self) -> bool:
        """Return whether the directory can be used again, once after each time that it could not."""
        back = self._was_away and self.trouble is None
        self._was_away = self.trouble is not None
        return back

    def other(self) -> str:
        """Log and return a sentence if the directory is another one than before, once each time; else ""."""
        with self._changing:
            is_other, self._is_other = self._is_other, False
        if not is_other:
            return ""
        anew = f"{self._directory} is another directory than before, or its disk was mounted anew"
        text = f"{anew}: recordings begin in what is there now"
        log.warning("%s", text)
        return text

    def _begin(self) -> None:
        self._asked_s = self._now_s()
        self._thread = threading.Thread(target=self._ask, name="disk-watch", daemon=True)
        self._thread.start()

    def _ask(self) -> None:
        free = 0
        try:
            found = self._look()
            free = 0 if found else self._free_bytes(self._directory)
        except OSError as error:
            found = unreachable(self._directory, error)
        is_other = self._take_other()
        with self._changing:
            self._trouble = found
            if is_other:
                self._is_other = True
                self._looks.clear()  # of another disk
            if found is not None:
                self._looks.clear()  # another disk may come back
                return
            self._looks.append((self._now_s(), free))
            while self._looks[0][0] < self._looks[-1][0] - WINDOW_S:
                self._looks.popleft()

    @property
    def status(self) -> DiskStatus | None:
        """Latest answer; None before the first one, and while no recording can begin there."""
        with self._changing:
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

    @property
    def trouble(self) -> Trouble | None:
        """Why no recording can begin in the directory, and what helps; None if one can."""
        silent_s = self._now_s() - self._asked_s
        if self._thread is not None and self._thread.is_alive() and silent_s > SILENT_S:
            why = f"its disk has not answered for {silent_s:.0f} s"
            return trouble(self._directory, why, "the kernel's log, and the disk's cable or server")
        return self._trouble

    def close(self) -> None:
        """Wait a moment for the current query; a thread that hangs is left behind."""
        if self._thread is not None:
            self._thread.join(1.0)
