"""Handling of Ctrl-C: the first one is acknowledged and ends the work properly, the second ends it now."""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

from acquire.cli.output import note
from acquire.errors import EXIT_INTERRUPTED

if TYPE_CHECKING:
    from collections.abc import Iterator

END_NOW = "acquire-end-now"
GRACE_S = 3.0
"""Time after the second Ctrl-C in which unfinished output is removed."""
SAME_S = 1.0
"""Interrupts this close together count as one Ctrl-C: when a parent of many threads is killed, the kernel
sends its death signal once for each thread, and some wrappers forward a signal that the terminal has already
sent."""


class _Presses:
    """Counts how often a person has pressed Ctrl-C, whichever handler is installed at the time."""

    def __init__(self) -> None:
        self._counted_at = -math.inf

    def another(self) -> bool:
        """Whether this interrupt is a new one, and not an echo of the last."""
        now = time.monotonic()
        counts = now - self._counted_at >= SAME_S
        if counts:
            self._counted_at = now
        return counts


_presses = _Presses()


@contextmanager
def stop_on_interrupt(finishing: str) -> Iterator[threading.Event]:
    """Set the event at the first Ctrl-C, so that the work ends with the best result so far.

    The second Ctrl-C ends the program now. ``finishing`` states the work that is still done after the first,
    such as "finishing the current segment".
    """
    stop_requested = threading.Event()

    def interrupted(_number: int, _frame: object) -> None:
        if not _presses.another():
            return
        if stop_requested.is_set():
            _end_now()
        stop_requested.set()
        note(f"{finishing}; press Ctrl-C again to end now")

    with _handled_by(interrupted):
        yield stop_requested


@contextmanager
def interrupts_handled() -> Iterator[None]:
    """Acknowledge the first Ctrl-C and raise KeyboardInterrupt; a proper end may take some time."""
    stop_requested = threading.Event()

    def interrupted(_number: int, _frame: object) -> None:
        if not _presses.another():
            return
        if stop_requested.is_set():
            _end_now()
        stop_requested.set()
        note("interrupted, ending; press Ctrl-C again to end now")
        raise KeyboardInterrupt

    try:
        with _handled_by(interrupted):
            yield
    finally:  # unfinished output is removed by now, so the process need not be killed any more
        for thread in threading.enumerate():
            if isinstance(thread, threading.Timer) and thread.name == END_NOW:
                thread.cancel()


@contextmanager
def _handled_by(handler: signal._HANDLER) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread can install handlers; other callers stop the work in their own way
        return
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _end_now() -> None:
    """Kill our child processes and end this one: by an exception first, so that unfinished output is removed.

    If that takes longer than `GRACE_S`, the process exits without it.
    """
    processes = sys.modules.get("multiprocessing")  # it is loaded if any child was started
    for child in processes.active_children() if processes else ():
        child.kill()
    # os._exit, since sys.exit would end the timer's own thread only.
    timer = threading.Timer(GRACE_S, os._exit, (EXIT_INTERRUPTED,))
    # A daemon thread: for any other the interpreter would wait at its end.
    timer.name, timer.daemon = END_NOW, True
    timer.start()
    raise KeyboardInterrupt
