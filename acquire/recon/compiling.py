"""Time that this process has spent compiling.

The loops are compiled when they are first called and cached next to their source. This happens once after an
installation, takes ten seconds or more, and does not count as time of a reconstruction.
"""

from __future__ import annotations

import time
from typing import Any

from numba.core import event


class _Stopwatch(event.Listener):
    """Runs while a loop is compiled. Numba compiles one at a time; the loops that it calls are nested."""

    def __init__(self) -> None:
        self._total_s, self._depth, self._begun = 0.0, 0, 0.0

    @property
    def total_s(self) -> float:
        return self._total_s + (time.monotonic() - self._begun if self._depth else 0.0)

    def on_start(self, _: Any) -> None:
        if not self._depth:
            self._begun = time.monotonic()
        self._depth += 1

    def on_end(self, _: Any) -> None:
        self._depth -= 1
        if not self._depth:
            self._total_s += time.monotonic() - self._begun


_stopwatch = _Stopwatch()
# This happens at import, before any loop of this package is called: every compilation counts.
event.register("numba:compile", _stopwatch)  # type: ignore[no-untyped-call]


def compiled_s() -> float:
    """Wall time that this process has spent compiling so far, in seconds."""
    return _stopwatch.total_s
