"""Ranks of processes on the host, for processors and when memory runs out: lines come first.

    urgent      grabbers with `stream.realtime`: ahead of everything else
    prompt      every grabber: the next to run once it wakes up, for as little as it has to do
    important   the recorder of a rig with `stream.realtime`: more processor time than others
    back        what can be repeated: the page, its jobs, copies, recoveries

Threads and processes that are started later inherit a rank.

Kernels with autogroups share the processors among sessions first (setsid(2), so every terminal is one), and
nice counts only within a session: what stands back must be in the session of the grabbers. Services of
systemd have no autogroups.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
from pathlib import Path

FIRST, EARLY = 1000, 500
"""Scores of processes that the kernel kills first, and next, when memory runs out: see proc(5),
oom_score_adj.
"""
_IMPORTANT = -15
"""Niceness of what others must not keep from running; the service's unit permits as much (LimitNICE)."""
_SLICE_NS = 100_000
"""The shortest that Linux allows (kernel/sched/syscalls.c), and more than copying a block of lines takes."""
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
"""Numbers of a system call that the C library offers only since glibc 2.41."""


class _Attributes(ctypes.Structure):
    """``struct sched_attr`` of sched_setattr(2), in its first version."""

    _fields_ = (
        ("size", ctypes.c_uint32),
        ("policy", ctypes.c_uint32),
        ("flags", ctypes.c_uint64),
        ("nice", ctypes.c_int32),
        ("priority", ctypes.c_uint32),
        ("runtime_ns", ctypes.c_uint64),
        ("deadline_ns", ctypes.c_uint64),
        ("period_ns", ctypes.c_uint64),
    )


def become_urgent() -> bool:
    """Run ahead of everything else on the host, in real time; return whether that is allowed here.

    Only for processes that wait most of the time and do little at once: others would starve the host.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except PermissionError:
        return False
    return True


def become_prompt() -> bool:
    """Ask for the processor in short slices, and therefore soon; return whether the kernel took the request.

    Shares of the processors stay the same, and no right is needed. Without it, the process that runs when a
    block of lines arrives may run on to the end of a slice of a few milliseconds. Linux before 6.12 does not
    know the request.
    """
    number = _SCHED_SETATTR.get(platform.machine())
    if number is None or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return False
    wanted = _Attributes(
        size=ctypes.sizeof(_Attributes), policy=os.SCHED_OTHER, nice=os.nice(0), runtime_ns=_SLICE_NS
    )
    answer: int = ctypes.CDLL(None).syscall(number, 0, ctypes.byref(wanted), 0)
    return answer == 0


def become_important() -> bool:
    """Get more processor time than other processes; return whether that is allowed here."""
    try:
        os.setpriority(os.PRIO_PROCESS, 0, _IMPORTANT)
    except PermissionError:
        return False
    return True


def stand_back(nice: int, oom_score: int) -> None:
    """Lower the rank of this process and all that it starts: its work can be repeated, lines cannot."""
    os.nice(nice)
    # Then it never interrupts a running grabber when it wakes up. Its share of the processors stays the same.
    with contextlib.suppress(OSError):  # refused in a restricted service
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    with contextlib.suppress(OSError):  # refused there, too, or unknown to the kernel
        Path("/proc/self/oom_score_adj").write_text(str(oom_score), encoding="ascii")


def hold_back(pid: int, nice: int) -> None:
    """Lower the rank of a child that has a session of its own, and of all that it starts from now on."""
    lower = min(19, os.getpriority(os.PRIO_PROCESS, 0) + nice)
    with contextlib.suppress(OSError):  # it has ended, has become another user, or there are no autogroups
        os.setpriority(os.PRIO_PROCESS, pid, lower)
        Path(f"/proc/{pid}/autogroup").write_text(str(lower), encoding="ascii")


def sessions_share(proc: Path = Path("/proc"), groups: Path = Path("/sys/fs/cgroup")) -> bool:
    """Whether the kernel shares the processors among sessions here: see the module."""
    try:
        if (proc / "sys/kernel/sched_autogroup_enabled").read_text(encoding="ascii").strip() != "1":
            return False
        lines = (proc / "self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return False
    # Autogroups are for processes in no control group for processors: hierarchy, controllers, path.
    for _, controllers, path in (line.split(":", 2) for line in lines):
        if "cpu" in controllers.split(","):
            return path == "/"
        if not controllers and any(
            (groups / part.lstrip("/") / "cpu.weight").exists()
            for part in (path, *map(str, Path(path).parents))
        ):
            return False
    return True
