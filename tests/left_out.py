"""Tests that need what a machine lacks are left out there, and the summary says so.

What is missing is found once, by the process that was started, and handed to its workers (pytest-xdist), so
that all of them leave out the same tests; each worker reports what it left out, for the one summary.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import tempfile
from collections import Counter
from pathlib import Path
from shutil import which
from typing import Any

import pytest
from frozen_disk import can_freeze
from memory_group import can_limit_memory
from throttle import can_throttle
from umockdev_here import missing as missing_for_umockdev

from acquire.arrays import open_arrays
from acquire.camera import aravis
from acquire.errors import CameraError, UsageError
from acquire.sim.gentl.build import compiler

FAKE_GIGE = "arv-fake-gv-camera-0.8"
_HAVE_GENICAM = importlib.util.find_spec("genicam") is not None


def _have_aravis() -> bool:
    try:
        aravis.load()
    except CameraError:
        return False
    return True


def _lacks_browser() -> str | None:
    if which("chromium") is None:
        return "Debian's chromium"
    return "the package playwright" if importlib.util.find_spec("playwright") is None else None


def _have_gpu() -> bool:
    try:
        open_arrays("gpu")
    except UsageError:
        return False
    return True


def _is_checkout() -> bool:
    """Not an unpacked source distribution."""
    return (Path(__file__).parents[1] / ".git").exists()


def _can_mount() -> bool:
    """A file system of a few MB that is really full is one that is mounted here."""
    with tempfile.TemporaryDirectory() as place:
        command = ["mount", "-t", "tmpfs", "-o", "size=64k", "none", place]
        if os.geteuid() != 0 or which("mount") is None or subprocess.run(command, check=False).returncode:
            return False
        subprocess.run(["umount", place], check=True)
        return True


NEEDS = {
    "needs_aravis": "loads Aravis' shared library",
    "needs_gige_camera": "runs Aravis' GigE Vision camera on loopback",
    "needs_chromium": "drives the operator's page in a browser",
    "needs_compiler": "builds the simulated GenTL producer",
    "needs_dask": "spreads work over a Dask cluster",
    "needs_git": "compares with what git keeps",
    "needs_gpu": "computes on CUDA",
    "needs_fish": "completes words in fish",
    "needs_zsh": "completes words in zsh",
    "needs_freeze": "freezes a file system of its own",
    "needs_memory_group": "has the kernel kill for want of memory",
    "needs_mount": "fills a small file system of its own",
    "needs_systemd": "has systemd read the unit",
    "needs_throttle": "has the kernel slow a disk down for a process",
    "needs_umockdev": "runs libusb on a made-up bus",
    "needs_genicam": "loads a GenTL producer",
    "needs_user": "has a file that it may not read",
}
"""Marker → what a test that carries it does."""

_missing: dict[str, str] = {}
"""Marker → what this machine lacks for it."""
_left_out: Counter[str] = Counter()
"""Line of the summary → tests; 0 where they were not even collected."""


def find_missing() -> dict[str, str]:
    lacks: dict[str, str | bool | None] = {
        "needs_aravis": not _have_aravis() and "Aravis' library",
        "needs_gige_camera": not (_have_aravis() and which(FAKE_GIGE)) and f"Aravis and {FAKE_GIGE}",
        "needs_chromium": _lacks_browser(),
        "needs_compiler": not (compiler() and _HAVE_GENICAM) and "a C compiler and the genicam package",
        "needs_dask": importlib.util.find_spec("distributed") is None and "dask.distributed",
        "needs_gpu": not _have_gpu() and "CuPy and a GPU",
        "needs_git": not (which("git") and _is_checkout()) and "a checkout, and git",
        "needs_fish": which("fish") is None and "fish, the shell",
        "needs_zsh": which("zsh") is None and "zsh, the shell",
        "needs_freeze": not can_freeze() and "the right to mount a file system and to freeze it",
        "needs_memory_group": not can_limit_memory() and "the right to limit the memory of processes",
        "needs_mount": not _can_mount() and "the right to mount a small file system",
        "needs_systemd": which("systemd-analyze") is None and "systemd-analyze",
        "needs_throttle": not can_throttle(Path(tempfile.gettempdir())) and "the right to slow a disk down",
        "needs_umockdev": missing_for_umockdev(),
        "needs_genicam": not _HAVE_GENICAM and "the genicam package",
        "needs_user": os.geteuid() == 0 and "a user who is not root",
    }
    return {marker: str(what) for marker, what in lacks.items() if what}


def leave_out_folder(folder: str, reason: str) -> None:
    """A folder whose tests cannot even be imported here: its conftest.py ignores it, the summary names it."""
    _left_out[f"{folder} was left out: {reason}"] = 0


def pytest_configure(config: pytest.Config) -> None:
    for marker, does in NEEDS.items():
        config.addinivalue_line("markers", f"{marker}: {does}")
    handed = getattr(config, "workerinput", None)
    _missing.update(find_missing() if handed is None else handed["missing"])


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    node.workerinput["missing"] = _missing


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    out: list[pytest.Item] = []
    for item in items:
        wants = next((marker for marker in _missing if item.get_closest_marker(marker)), None)
        if wants:
            out.append(item)
            _left_out[f"left out, for want of {_missing[wants]}"] += 1
    if out:
        config.hook.pytest_deselected(items=out)
        items[:] = [item for item in items if item not in out]


def pytest_sessionfinish(session: pytest.Session) -> None:
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["left_out"] = dict(_left_out)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Every worker collects every test, so that one's numbers are those of all."""
    for line, count in getattr(node, "workeroutput", {}).get("left_out", {}).items():
        _left_out[line] = count


def pytest_terminal_summary(terminalreporter: Any) -> None:
    for line, count in _left_out.items():
        terminalreporter.write_line(f"{line}: {count} tests" if count else line, yellow=True)
