"""Waits with a limit, for what other threads and processes do."""

from __future__ import annotations

import time
from collections.abc import Callable


def until(condition: Callable[[], object], what: str = "it", limit_s: float = 300.0) -> None:
    """Look again and again until ``condition`` holds; fail after ``limit_s``, which is against hanging."""
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline, f"waited {limit_s:g} s for {what} in vain"
        time.sleep(0.005)
