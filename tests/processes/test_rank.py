"""Processes that stand back do not interrupt the capture."""

from __future__ import annotations

import os
import subprocess
import sys


def test_a_process_that_stands_back_does_not_interrupt_others_nor_do_those_that_it_starts() -> None:
    program = """
import os, subprocess, sys
from acquire.processes.rank import EARLY, stand_back
stand_back(7, EARLY)
own = "import os; print(os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0))"
exec(own)
print(subprocess.check_output([sys.executable, "-c", own], text=True))
"""
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    words = subprocess.check_output([sys.executable, "-c", program], text=True).split()
    assert words == [str(os.SCHED_BATCH), str(min(19, nice + 7))] * 2
