"""A guaranteed end of the process: if it does not end in order it ends by force, and logs what it hung on.

A thread that waits for the kernel, such as one that opens a named pipe left in the place of a file, cannot be
interrupted. Neither a signal nor the end of the interpreter may wait for it.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
import traceback
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

END_S = 15.0
"""Time for a daemon that records nothing, and for one that got a second signal."""
LINGER_S = 2.0
"""Time for threads that are still at work when everything else has ended."""
FORCED = 1
"""Exit code of a forced end."""

log = logging.getLogger("acquire.daemon")


class LastResort:
    """Ends the process when its time is up, wherever its threads are. That needs only the kernel.

    Recorder and grabbers are separate processes: they detect that their owner is gone, seal their lines, and
    end.
    """

    def __init__(self, clean_up: Callable[[], None]) -> None:
        self._clean_up = clean_up
        self._timer: threading.Timer | None = None

    def within(self, seconds: float) -> None:
        """End the process after this time, unless `cancel` is called. A later call changes the time."""
        self.cancel()
        self._timer = threading.Timer(seconds, self._end, args=(seconds,))
        self._timer.name, self._timer.daemon = "last-resort", True
        self._timer.start()

    def cancel(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _end(self, seconds: float) -> None:
        _not_for_ever()
        # Logged first: once the process has ended, nothing shows which thread hung.
        log.error("not ended after %g s, ending by force: %s", seconds, "; ".join(busy_threads()))
        self._clean_up()
        logging.shutdown()
        os._exit(FORCED)


def leave(code: int) -> int:
    """Return the exit code once every thread has ended; if some do not, exit without waiting for them."""
    deadline = time.monotonic() + LINGER_S
    for thread in _others():
        thread.join(max(0.0, deadline - time.monotonic()))
    if _others():
        _not_for_ever()
        log.warning("ended without waiting for %s", "; ".join(busy_threads()))
        # `os._exit` flushes nothing.
        logging.shutdown()
        sys.stdout.flush()
        os._exit(code)
    return code


def busy_threads() -> list[str]:
    """Return the threads for which the interpreter would wait, each with its current line of code."""
    frames = sys._current_frames()
    found = []
    for thread in threading.enumerate():
        frame = frames.get(thread.ident or 0)
        if frame is not None and not thread.daemon:
            at = traceback.extract_stack(frame)[-1]
            found.append(f"thread {thread.name} at {at.filename}:{at.lineno} ({at.name})")
    return found


def _not_for_ever() -> None:
    """Have the kernel end the process (SIGALRM) if it is still there after `LINGER_S`."""
    # What remains to be done may wait without limit, too: a file is removed from a disk that does not answer.
    signal.setitimer(signal.ITIMER_REAL, LINGER_S)


def _others() -> list[threading.Thread]:
    here = (threading.main_thread(), threading.current_thread())
    return [one for one in threading.enumerate() if one not in here and not one.daemon]
