"""Lower rank of other processes than the capture's, for processors and when memory runs out."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

FIRST, EARLY = 1000, 500
"""Scores of processes that the kernel kills first, and next, when memory runs out: see proc(5),
oom_score_adj.
"""


def stand_back(nice: int, oom_score: int) -> None:
    """Lower the rank of this process and all that it starts: its work can be repeated, lines cannot."""
    os.nice(nice)
    # Then it never interrupts a running grabber when it wakes up. Its share of the processors stays the same.
    with contextlib.suppress(OSError):  # a service that may not
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    with contextlib.suppress(OSError):  # a kernel without it, or a service that may not
        Path("/proc/self/oom_score_adj").write_text(str(oom_score), encoding="ascii")
