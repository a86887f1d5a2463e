"""Who stands back for the capture: with the processors, and where memory ends."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

FIRST, EARLY = 1000, 500
"""Whom the kernel kills first where memory ends, and whom next: see proc(5), oom_score_adj."""


def stand_back(nice: int, oom_score: int) -> None:
    """From now on, with all that this process starts. What it does can be done again; lines come once."""
    os.nice(nice)
    with contextlib.suppress(OSError):  # a kernel without it, or a service that may not
        Path("/proc/self/oom_score_adj").write_text(str(oom_score), encoding="ascii")
