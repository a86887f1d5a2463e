"""Ctrl-C in commands whose work so far is worth keeping."""

from __future__ import annotations

import signal
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def first_interrupt_asks() -> Iterator[threading.Event]:
    """The first Ctrl-C sets the event, by which the work ends with the best so far; the second breaks off."""
    asked = threading.Event()

    def interrupted(_number: int, _frame: object) -> None:
        if asked.is_set():
            raise KeyboardInterrupt
        asked.set()

    before = signal.signal(signal.SIGINT, interrupted)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, before)
