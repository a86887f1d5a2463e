"""Grabbers run soon after they wake up, and processes that stand back do not interrupt the capture."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys

import pytest


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


def test_a_prompt_process_keeps_its_niceness_and_runs_in_short_slices() -> None:
    program = """
import os
from pathlib import Path
from acquire.processes.rank import become_prompt
print(become_prompt(), os.getpriority(os.PRIO_PROCESS, 0))
shown = Path("/proc/self/sched")
print(shown.read_text() if shown.exists() else "")
"""
    took, nice, *rest = subprocess.check_output([sys.executable, "-c", program], text=True).split()
    assert took == "True"
    assert int(nice) == os.getpriority(os.PRIO_PROCESS, 0)
    version = tuple(int(number) for number in re.findall(r"\d+", platform.release())[:2])
    if version < (6, 12) or "se.slice" not in rest:
        pytest.skip("Linux ignores the slice that a process asks for before 6.12, or does not show it here")
    assert int(rest[rest.index("se.slice") + 2]) == 100_000
