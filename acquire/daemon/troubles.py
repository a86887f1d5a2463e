"""Unforeseen failures: logged with their traceback, counted, and listed in the status.

A defect in one thread must neither end the service nor go unnoticed. The error of a command is returned to
its client; this is for everything that runs outside commands.
"""

from __future__ import annotations

import logging
import threading
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from acquire.daemon.messages import TroubleStatus
from acquire.text import shortened

if TYPE_CHECKING:
    import asyncio
    from typing import Any

MOST_LISTED = 16

log = logging.getLogger("acquire.daemon")


class Troubles:
    """All methods may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._found: dict[str, TroubleStatus] = {}

    @property
    def statuses(self) -> list[TroubleStatus]:
        """All failures, the latest last."""
        with self._lock:
            return list(self._found.values())

    def note(self, where: str, error: BaseException) -> None:
        """Log and list a failure; a repeated one is counted."""
        log.error("%s failed: %s", where, type(error).__name__, exc_info=error)
        text = f"{where}: {type(error).__name__}: {shortened(error, 400)}"
        with self._lock:
            before = self._found.pop(text, None)
            times = 1 if before is None else before.times + 1
            self._found[text] = TroubleStatus(text=text, times=times, last=datetime.now(UTC))
            while len(self._found) > MOST_LISTED:
                del self._found[next(iter(self._found))]

    def in_thread(self, failed: threading.ExceptHookArgs) -> None:
        """Handle `threading.excepthook`."""
        if failed.exc_value is not None and not isinstance(failed.exc_value, SystemExit):
            self.note(f"thread {failed.thread.name if failed.thread else '?'}", failed.exc_value)

    def in_loop(self, _loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Handle `loop.set_exception_handler`. A failed connection is logged without a traceback."""
        error = context.get("exception")
        if error is None or isinstance(error, OSError):
            log.warning("%s: %s", context["message"], error)
        else:
            self.note(context["message"], error)
