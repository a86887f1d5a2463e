"""Ctrl-C is answered at once, in words: the first one ends in good order, the second one ends now."""

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
"""After the second Ctrl-C, for what is half-made to be removed."""
SAME_S = 1.0
"""Interrupts this close together are one Ctrl-C: where a parent of many threads is killed, the kernel sends
its death signal once for each of them, and some wrappers hand on what the terminal has sent already."""


class _Presses:
    """Of Ctrl-C, as a person presses it, whoever answers at the time."""

    def __init__(self) -> None:
        self._counted_at = -math.inf

    def another(self) -> bool:
        """Whether this interrupt is another one, not the last one's echo."""
        now = time.monotonic()
        counts = now - self._counted_at >= SAME_S
        if counts:
            self._counted_at = now
        return counts


_presses = _Presses()


@contextmanager
def first_interrupt_asks(finishing: str) -> Iterator[threading.Event]:
    """The first Ctrl-C sets the event, by which the work ends with the best so far; the second ends now.

    ``finishing`` says what is still done after the first: "finishing what is being solved".
    """
    asked = threading.Event()

    def interrupted(_number: int, _frame: object) -> None:
        if not _presses.another():
            return
        if asked.is_set():
            _end_now()
        asked.set()
        note(f"{finishing}; Ctrl-C once more to end now")

    with _handled_by(interrupted):
        yield asked


@contextmanager
def interrupts_answered() -> Iterator[None]:
    """The first Ctrl-C raises KeyboardInterrupt and says so, since to end in good order may take its time."""
    asked = threading.Event()

    def interrupted(_number: int, _frame: object) -> None:
        if not _presses.another():
            return
        if asked.is_set():
            _end_now()
        asked.set()
        note("interrupted, ending; Ctrl-C once more to end now")
        raise KeyboardInterrupt

    try:
        with _handled_by(interrupted):
            yield
    finally:  # all is removed by now
        for thread in threading.enumerate():
            if isinstance(thread, threading.Timer) and thread.name == END_NOW:
                thread.cancel()


@contextmanager
def _handled_by(handler: signal._HANDLER) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield  # a caller in a thread has its own ways to end this
        return
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _end_now() -> None:
    """End our processes, and this one: by an exception, so that what is half-made is removed, or without."""
    processes = sys.modules.get("multiprocessing")  # who has started one has loaded it
    for child in processes.active_children() if processes else ():
        child.kill()
    timer = threading.Timer(GRACE_S, os._exit, (EXIT_INTERRUPTED,))
    timer.name, timer.daemon = END_NOW, True
    timer.start()
    raise KeyboardInterrupt
