"""The end that always comes: what does not end in order ends by force, with a word about what it hung on.

A thread that waits for the system, such as one that opens a named pipe somebody left where a file should be,
cannot be interrupted. Neither a signal nor the end of the interpreter may wait for it.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
import traceback
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

END_S = 15.0
"""For a daemon that records nothing, and for one that was told twice."""
LINGER_S = 2.0
"""For threads that are still at work when all else has ended."""
FORCED = 1
"""Exit code of an end by force."""

log = logging.getLogger("acquire.daemon")


class LastResort:
    """Ends the process when its time is up, wherever its threads are. Only the kernel is needed for that.

    Recorder and grabbers are processes of their own: they see that their owner has gone, seal what they
    hold, and end.
    """

    def __init__(self, clean_up: Callable[[], None]) -> None:
        self._clean_up = clean_up
        self._timer: threading.Timer | None = None

    def within(self, seconds: float) -> None:
        """The process ends within this time, unless `cancel` is called. A later call changes the time."""
        self.cancel()
        self._timer = threading.Timer(seconds, self._end, args=(seconds,))
        self._timer.name, self._timer.daemon = "last-resort", True
        self._timer.start()

    def cancel(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _end(self, seconds: float) -> None:
        log.error("not ended after %g s, ending by force: %s", seconds, "; ".join(busy_threads()))
        self._clean_up()
        logging.shutdown()
        os._exit(FORCED)


def leave(code: int) -> int:
    """The exit code, once every thread has ended; threads that do not end are left behind by force."""
    deadline = time.monotonic() + LINGER_S
    for thread in _others():
        thread.join(max(0.0, deadline - time.monotonic()))
    if _others():
        log.warning("ended without waiting for %s", "; ".join(busy_threads()))
        logging.shutdown()
        sys.stdout.flush()
        os._exit(code)
    return code


def busy_threads() -> list[str]:
    """Threads whose end the interpreter would wait for, and the line of code that each is at."""
    frames = sys._current_frames()
    told = []
    for thread in threading.enumerate():
        frame = frames.get(thread.ident or 0)
        if frame is not None and not thread.daemon:
            at = traceback.extract_stack(frame)[-1]
            told.append(f"thread {thread.name} at {at.filename}:{at.lineno} ({at.name})")
    return told


def _others() -> list[threading.Thread]:
    here = (threading.main_thread(), threading.current_thread())
    return [one for one in threading.enumerate() if one not in here and not one.daemon]
