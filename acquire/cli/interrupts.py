"""Handling of Ctrl-C: the first one is acknowledged and ends the work properly, the second ends it now.

So do SIGTERM (of `timeout`, a batch system or a shutdown) and SIGHUP (of a terminal that is closed): a
command that has armed the instrument with the light off must not leave it like that, nor half a file behind.
"""

from __future__ import annotations

import math
import os
import signal
import stat
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
UNLESS_IGNORED = (signal.SIGTERM, signal.SIGHUP)
"""Signals that end the work like Ctrl-C, unless whoever started the process ignores them (nohup)."""


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

    def interrupted(number: int, _frame: object) -> None:
        if not _presses.another():
            return
        if stop_requested.is_set():
            _end_now()
        stop_requested.set()
        _acknowledge(number, finishing)

    with _handled_by(interrupted):
        yield stop_requested


@contextmanager
def interrupts_handled() -> Iterator[None]:
    """Acknowledge the first Ctrl-C and raise KeyboardInterrupt; a proper end may take some time."""
    stop_requested = threading.Event()

    def interrupted(number: int, _frame: object) -> None:
        if not _presses.another():
            return
        if stop_requested.is_set():
            _end_now()
        stop_requested.set()
        _acknowledge(number, "interrupted, ending")
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
    # A script's background job is started with SIGINT ignored; the page still stops such jobs by it.
    numbers = [signal.SIGINT, *(one for one in UNLESS_IGNORED if signal.getsignal(one) != signal.SIG_IGN)]
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def leave_signals_to_the_server() -> None:
    """Let SIGTERM and SIGHUP end this process as usual, until a server installs handlers of its own."""
    for number in UNLESS_IGNORED:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)


def _acknowledge(number: int, doing: str) -> None:
    """Say that the work ends, to whoever pressed Ctrl-C; other signals come from programs."""
    if number == signal.SIGINT:
        note(f"{doing}; press Ctrl-C again to end now")
    elif number == signal.SIGHUP:
        # Nothing is written to the terminal any more: its end would be an error in the middle of putting
        # things in order.
        nowhere = os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
        for fd in (1, 2):
            if stat.S_ISCHR(os.fstat(fd).st_mode):
                os.dup2(nowhere, fd)
        os.close(nowhere)


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
