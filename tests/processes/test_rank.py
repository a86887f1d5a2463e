"""Grabbers run soon after they wake up, and processes that stand back do not interrupt the capture."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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


def test_a_prompt_process_runs_in_short_slices_and_keeps_its_niceness() -> None:
    program = """
import os
from acquire.processes.rank import become_prompt
print(become_prompt(), os.getpriority(os.PRIO_PROCESS, 0))
print(open("/proc/self/sched").read())
"""
    shown = Path("/proc/self/sched")
    if not shown.exists() or "se.slice" not in shown.read_text(encoding="ascii"):
        pytest.skip("a kernel without slices of a process's own, or that does not show them")
    took, nice, *rest = subprocess.check_output([sys.executable, "-c", program], text=True).split()
    assert (took, int(nice)) == ("True", os.getpriority(os.PRIO_PROCESS, 0))
    assert int(rest[rest.index("se.slice") + 2]) == 100_000


def test_a_session_that_stands_back_does_so_before_other_sessions_as_well() -> None:
    program = """
from acquire.processes.rank import EARLY, stand_back
stand_back(7, EARLY)
print(open("/proc/self/autogroup").read())
"""
    if not Path("/proc/self/autogroup").exists():
        pytest.skip("a kernel where sessions do not share the processors")
    words = [sys.executable, "-c", program]
    group = subprocess.check_output(words, text=True, start_new_session=True)
    expected = min(19, os.getpriority(os.PRIO_PROCESS, 0) + 7)
    assert group.split()[-2:] == ["nice", str(expected)]
    before = Path("/proc/self/autogroup").read_text(encoding="ascii")
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    assert Path("/proc/self/autogroup").read_text(encoding="ascii") == before  # its own session only
