"""Tests that need what a machine lacks are left out there, and the summary says so."""

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
from throttle import can_throttle

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


def _have_gpu() -> bool:
    try:
        open_arrays("gpu")
    except UsageError:
        return False
    return True


def _can_mount() -> bool:
    """A file system of a few MB that is really full is one that is mounted here."""
    with tempfile.TemporaryDirectory() as place:
        command = ["mount", "-t", "tmpfs", "-o", "size=64k", "none", place]
        if os.geteuid() != 0 or which("mount") is None or subprocess.run(command, check=False).returncode:
            return False
        subprocess.run(["umount", place], check=True)
        return True


MISSING = {
    "needs_aravis": not _have_aravis() and "Aravis' library",
    "needs_gige_camera": not (_have_aravis() and which(FAKE_GIGE)) and f"Aravis and {FAKE_GIGE}",
    "needs_compiler": not (compiler() and _HAVE_GENICAM) and "a C compiler and the genicam package",
    "needs_dask": importlib.util.find_spec("distributed") is None and "dask.distributed",
    "needs_gpu": not _have_gpu() and "CuPy and a GPU",
    "needs_mount": not _can_mount() and "the right to mount a small file system",
    "needs_throttle": not can_throttle(Path(tempfile.gettempdir())) and "the right to slow a disk down",
    "needs_genicam": not _HAVE_GENICAM and "the genicam package",
}
_left_out: Counter[str] = Counter()


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "needs_compiler: builds the simulated GenTL producer")
    config.addinivalue_line("markers", "needs_dask: spreads work over a Dask cluster")
    config.addinivalue_line("markers", "needs_gpu: computes on CUDA")
    config.addinivalue_line("markers", "needs_mount: fills a small file system of its own")
    config.addinivalue_line("markers", "needs_throttle: has the kernel slow a disk down for a process")
    config.addinivalue_line("markers", "needs_genicam: loads a GenTL producer")
    config.addinivalue_line("markers", "needs_aravis: loads Aravis' shared library")
    config.addinivalue_line("markers", "needs_gige_camera: runs Aravis' GigE Vision camera on loopback")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    out: list[pytest.Item] = []
    for item in items:
        wants = next((m for m, what in MISSING.items() if what and item.get_closest_marker(m)), None)
        if wants:
            out.append(item)
            _left_out[str(MISSING[wants])] += 1
    if out:
        config.hook.pytest_deselected(items=out)
        items[:] = [item for item in items if item not in out]


def pytest_terminal_summary(terminalreporter: Any) -> None:
    for what, count in _left_out.items():
        terminalreporter.write_line(f"left out, for want of {what}: {count} tests")
