"""Grabbers run soon after they wake up, and processes that stand back do not interrupt the capture."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import pytest

from acquire.processes.rank import hold_back, sessions_share


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


def test_a_child_with_a_session_of_its_own_is_held_back_as_a_whole_session() -> None:
    """Where the kernel has autogroups, a nice child of its own session gets as much as all grabbers."""
    with subprocess.Popen(
        [sys.executable, "-c", "input()"], stdin=subprocess.PIPE, start_new_session=True
    ) as it:
        nice = min(19, os.getpriority(os.PRIO_PROCESS, 0) + 7)
        hold_back(it.pid, 7)
        assert os.getpriority(os.PRIO_PROCESS, it.pid) == nice
        group = Path(f"/proc/{it.pid}/autogroup")
        if group.exists() and group.read_text().strip():
            assert group.read_text().split()[-1] == str(nice)
        it.communicate(b"\n")
    hold_back(it.pid, 7)  # it has ended


@pytest.mark.parametrize(
    ("switch", "groups", "weighed", "shares"),
    [
        ("1", "0::/", "", True),
        ("0", "0::/", "", False),
        ("1", "0::/", "cpu.weight", False),  # a container
        ("1", "0::/system.slice/acquire.service", "system.slice/cpu.weight", False),
        ("1", "0::/system.slice/acquire.service", "", True),
        ("1", "4:memory:/\n1:cpu,cpuacct:/docker/1\n0::/", "", False),
        ("1", "4:memory:/docker/1\n1:cpu:/\n0::/", "", True),
        ("", "", "", False),
    ],
)
def test_where_the_kernel_shares_the_processors_among_sessions_is_found_out(
    tmp_path: Path, switch: str, groups: str, weighed: str, shares: bool
) -> None:
    proc, root = tmp_path / "proc", tmp_path / "groups"
    for path, text in (("sys/kernel/sched_autogroup_enabled", switch), ("self/cgroup", groups)):
        (proc / path).parent.mkdir(parents=True)
        if text:
            (proc / path).write_text(text + "\n")
    if weighed:
        (root / weighed).parent.mkdir(parents=True)
        (root / weighed).touch()
    assert sessions_share(proc, root) is shares
