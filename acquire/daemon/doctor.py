"""Is this host fit to capture? One finding per subject, with advice. Nothing is changed.

Limits are judged by the needs of the rig, if one is given: a host that only simulates needs little.
"""

from __future__ import annotations

import ctypes
import os
import re
import resource
import shutil
import socket
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from acquire import __version__
from acquire.camera.aravis.stream import RECEIVE_BYTES
from acquire.cores import usable_cores
from acquire.lines import ARMS
from acquire.plugins import GROUPS, OURS
from acquire.processes.rank import sessions_share
from acquire.processes.shared import available_bytes
from acquire.store.remote import shares_disk

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.config import RigConfig

Level = Literal["good", "warning", "bad"]
LEAST_DESCRIPTORS = 4096
# The kernel's default of 16 is less than the buffers of one camera; their makers recommend this number.
USB_BUFFER_MB = 1000
DISK_GB = 50.0
"""Less than this is soon full."""
SPARE_MEMORY = 1.5
"""Required memory relative to that of the rings, to leave some for the rest of the capture."""
NETWORK_DISKS = ("nfs", "nfs4", "cifs", "smb3", "fuse.sshfs", "9p", "ceph")
# TIME_ERROR and STA_UNSYNC of the kernel's timex.h.
_TIME_ERROR = 5
_STA_UNSYNC = 0x40


@dataclass(frozen=True, slots=True)
class CheckResult:
    """What was examined, its condition, and what to do if it is not good."""

    name: str
    level: Level
    text: str
    todo: str = ""


def examine(rig: RigConfig | None, running: str | None, *, has_rings: bool = False) -> Iterator[CheckResult]:
    """Yield all findings about the host; devices are examined elsewhere.

    ``running`` is the version of the daemon that runs here, if any; ``has_rings``: its run is armed.
    """
    text = f"acquire {__version__} on Python {sys.version.split()[0]}, numpy {np.__version__}"
    yield CheckResult("versions", "good", text)
    yield _foreign_package()
    yield _plugins()
    yield _descriptors()
    cores = usable_cores()
    if cores >= 4:
        yield CheckResult("processors", "good", f"{cores} can be used")
    else:
        text, todo = f"{cores} can be used: enough to simulate", "four or more for two cameras"
        yield CheckResult("processors", "warning", text, todo)
    yield _governor()
    yield _realtime(rig)
    yield _sessions(rig)
    yield _memory(None if has_rings else rig)
    yield from _disk(Path() if rig is None else rig.recording.directory)
    if rig is not None and shares_disk(rig.recording.upload_to, rig.recording.directory.absolute()):
        yield CheckResult(
            "uploads",
            "warning",
            f"{rig.recording.upload_to} is on the disk of the recordings: every line takes its room twice, "
            "and a broken disk takes both copies",
            "recording.upload_to on another disk or in an object store",
        )
    yield _clock()
    yield from _network(rig)
    yield from _usb(rig)
    yield from _producers(rig)
    yield from _port(rig)
    if running is None:
        yield CheckResult("daemon", "good", "none is running")
    elif running != __version__:
        text = f"the one that runs is acquire {running}, and this is {__version__}"
        yield CheckResult("daemon", "warning", text, "restart it")
    else:
        yield CheckResult("daemon", "good", f"acquire {running} is running")


def _foreign_package() -> CheckResult:
    """Find other distributions with a package `acquire`, of which PyPI has one: they break each other."""
    owners = set(metadata.packages_distributions().get("acquire", ()))
    # PyPI's acquire-imaging is one.
    others = sorted(owners - {"tdi-acquire"})
    if not others:
        return CheckResult("package", "good", "no other distribution installs a package `acquire`")
    return CheckResult(
        "package",
        "bad",
        f"{', '.join(others)} installs a package `acquire`, too: one hides the other",
        f"pip uninstall {' '.join(others)}, and reinstall tdi-acquire; or an environment for each",
    )


def _plugins() -> CheckResult:
    """Check the plug-ins of other distributions; those of this one are part of the installation."""
    others = [(group, each) for group in GROUPS for each in group.found() if each.distribution != OURS]
    broken = [f"{group.what} {each.name} of {each.origin}" for group, each in others if group.trouble(each)]
    if broken:
        text = f"cannot be used: {', '.join(broken)}"
        return CheckResult("plug-ins", "warning", text, "acquire plugins, which says why")
    text = f"{len(others)} of other distributions, all work" if others else "no other distribution brings any"
    return CheckResult("plug-ins", "good", text)


def _descriptors() -> CheckResult:
    # The hard limit, to which the daemon raises its soft one (`connections.raise_descriptor_limit`).
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard == resource.RLIM_INFINITY or hard >= LEAST_DESCRIPTORS:
        return CheckResult("descriptors", "good", f"a process may have {'any number' if hard < 0 else hard}")
    return CheckResult(
        "descriptors",
        "warning",
        f"a process may have only {hard}",
        "LimitNOFILE=65536 in the unit, or nofile in /etc/security/limits.d/",
    )


def _governor() -> CheckResult:
    files = sorted(Path("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor"))
    found = {_read(path) for path in files}
    slow = sorted(found - {"performance", "schedutil", ""})
    if not slow:
        return CheckResult(
            "frequency", "good", f"governor {', '.join(sorted(found)) or 'not reported by this kernel'}"
        )
    return CheckResult(
        "frequency",
        "warning",
        f"governor {', '.join(slow)}: slow to wake",
        "cpupower frequency-set -g performance",
    )


def _realtime(rig: RigConfig | None) -> CheckResult:
    soft, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    allowed = soft != 0 or os.geteuid() == 0  # root has CAP_SYS_NICE, for which there is no limit
    wanted = rig is not None and rig.stream.realtime
    if allowed:
        return CheckResult("real time", "good", "this user may run grabbers in real time")
    level: Level = "bad" if wanted else "warning"
    why = ", and stream.realtime asks for it" if wanted else "; without it, others may delay them"
    todo = "LimitRTPRIO=1 in the unit (acquire install-service), or rtprio in /etc/security/limits.d/"
    return CheckResult("real time", level, f"this user may not run grabbers in real time{why}", todo)


def _sessions(rig: RigConfig | None) -> CheckResult:
    if not sessions_share():
        return CheckResult(
            "sessions", "good", "the kernel shares the processors among processes, by their nice"
        )
    if rig is not None and rig.stream.realtime:
        return CheckResult("sessions", "good", "grabbers in real time run ahead of all sessions")
    return CheckResult(
        "sessions",
        "warning",
        "the kernel shares the processors among sessions: a program in another terminal gets as much as the "
        "whole capture, however nice it is",
        "sysctl -w kernel.sched_autogroup_enabled=0, stream.realtime, or a service (acquire install-service)",
    )


def _memory(rig: RigConfig | None) -> CheckResult:
    there = available_bytes()
    if rig is None:
        return CheckResult("memory", "good", f"{there / 1e9:.1f} GB are available")
    line_bytes = rig.pixels * np.dtype(rig.cameras.a.dtype).itemsize
    rings = len(ARMS) * rig.ring_slots * rig.stream.block_lines * line_bytes
    text = f"{there / 1e9:.1f} GB are available, and the rings need {rings / 1e9:.2f} GB"
    if there > SPARE_MEMORY * rings:
        return CheckResult("memory", "good", text)
    return CheckResult("memory", "bad", text, "a smaller stream.ring_seconds, or end other programs")


def _disk(directory: Path) -> Iterator[CheckResult]:
    path = directory.absolute()
    if not path.is_dir():
        # Where something else is, none can be made.
        make = "" if os.path.lexists(path) else f"mkdir -p {path}, or "
        yield CheckResult("disk", "bad", f"{path} is not a directory", f"{make}recording.directory")
        return
    if os.statvfs(path).f_flag & os.ST_RDONLY:
        text = f"{path} is on a disk that is mounted read-only"
        yield CheckResult("disk", "bad", text, "mount it for writing, or recording.directory on another disk")
        return
    if not os.access(path, os.W_OK | os.X_OK):
        yield CheckResult("disk", "bad", f"{path} is not writable for this user", f"chown or chmod {path}")
        return
    free_gb, kind = shutil.disk_usage(path).free / 1e9, _file_system(path)
    text = f"{path}: {free_gb:.0f} GB free on {kind or 'a file system of unknown type'}"
    if kind in NETWORK_DISKS:
        yield CheckResult(
            "disk", "warning", f"{text}: it waits for a network", "a local disk, and recording.upload_to"
        )
    elif free_gb < DISK_GB:
        yield CheckResult("disk", "warning", text, "remove recordings, or set recording.retention")
    else:
        yield CheckResult("disk", "good", text)


def _file_system(path: Path) -> str:
    """Return the type of the mount with the longest name above the path."""
    best, kind = "", ""
    for line in _read(Path("/proc/self/mounts")).splitlines():
        _, place, found, *_ = line.split(" ")
        # The kernel writes a space in a name as \040, and other odd characters likewise.
        place = re.sub(r"\\([0-7]{3})", lambda code: chr(int(code[1], 8)), place)
        inside = str(path) == place or str(path).startswith(place.rstrip("/") + "/")
        # Of two mounts at one place, the later one hides the earlier.
        if inside and len(place) >= len(best):
            best, kind = place, found
    return kind


class _Timex(ctypes.Structure):
    """The first fields of struct timex; ``rest`` is room for the others, which the kernel writes."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * 256),
    )


def _clock() -> CheckResult:
    timex = _Timex()
    # With `modes` = 0 the call changes nothing, and needs no rights.
    state = ctypes.CDLL(None).adjtimex(ctypes.byref(timex))
    if state < 0:
        return CheckResult("clock", "warning", "the kernel does not report whether the clock is synchronised")
    if state == _TIME_ERROR or timex.status & _STA_UNSYNC:
        return CheckResult(
            "clock",
            "warning",
            "the host's clock is not synchronised: UTC in recordings is as wrong as this clock",
            "chrony or systemd-timesyncd; the lines' own times come from the trigger",
        )
    return CheckResult("clock", "good", f"synchronised, within {timex.maxerror / 1000:.1f} ms")


def _uses(rig: RigConfig | None, *drivers: str) -> bool:
    return rig is not None and any(rig.cameras.arm(arm).driver in drivers for arm in ARMS)


def _network(rig: RigConfig | None) -> Iterator[CheckResult]:
    """Check the size of a socket's buffer: with a small one, GigE Vision loses packets."""
    if not _uses(rig, "aravis"):
        return
    most = int(_read(Path("/proc/sys/net/core/rmem_max")) or 0)
    text = f"a socket may buffer {most / 2**20:.1f} MiB"
    if most >= RECEIVE_BYTES:
        yield CheckResult("network", "good", text)
    else:
        yield CheckResult("network", "warning", text, f"sysctl -w net.core.rmem_max={RECEIVE_BYTES}")


def _usb(rig: RigConfig | None) -> Iterator[CheckResult]:
    path = Path("/sys/module/usbcore/parameters/usbfs_memory_mb")
    if not _uses(rig, "aravis", "harvesters") or not path.exists():
        return
    most = int(_read(path) or 0)
    if most == 0 or most >= USB_BUFFER_MB:  # to the kernel, 0 is no limit
        yield CheckResult("usb", "good", f"usbfs may use {'any memory' if most == 0 else f'{most} MB'}")
    else:
        todo = f"echo {USB_BUFFER_MB} > {path}, or usbcore.usbfs_memory_mb={USB_BUFFER_MB} at boot"
        yield CheckResult("usb", "warning", f"usbfs may use {most} MB, too little for USB3 cameras", todo)


def _producers(rig: RigConfig | None) -> Iterator[CheckResult]:
    if not _uses(rig, "harvesters"):
        return
    assert rig is not None
    given = [rig.cameras.arm(arm).cti for arm in ARMS if rig.cameras.arm(arm).cti]
    places = os.environ.get("GENICAM_GENTL64_PATH", "").split(os.pathsep)
    found = [str(path) for place in places if place for path in Path(place).glob("*.cti")]
    missing = [path for path in given if not Path(path).is_file()]
    if missing:
        yield CheckResult(
            "producer", "bad", f"{', '.join(missing)} is not there", "cameras.a.cti: the maker's GenTL file"
        )
    elif given or found:
        yield CheckResult("producer", "good", ", ".join(given or found))
    else:
        yield CheckResult(
            "producer",
            "bad",
            "no GenTL producer: GENICAM_GENTL64_PATH names no directory with one",
            "install the camera maker's driver, or set cameras.a.cti",
        )


def _port(rig: RigConfig | None) -> Iterator[CheckResult]:
    if rig is None or rig.web is None or rig.web.port == 0:
        return
    family = socket.AF_INET6 if ":" in rig.web.host else socket.AF_INET
    try:
        with socket.socket(family) as probe:  # refused itself where the kernel has no IPv6
            # As the page does, so that connections that have just been closed do not count.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((rig.web.host, rig.web.port))
    except OSError as error:
        text = f"{rig.web.host}:{rig.web.port}: {error.strerror}"
        yield CheckResult("page", "warning", text, "another web.port, unless it is the page that is running")
        return
    yield CheckResult("page", "good", f"{rig.web.host}:{rig.web.port} is free")


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
