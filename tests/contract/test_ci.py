"""`.ci/run` installs what it may, and runs the tests whatever becomes of that."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("may_install", [True, False])
def test_packages_are_asked_for_and_the_tests_run_without_them(tmp_path: Path, may_install: bool) -> None:
    """On a Debian of which nothing is installed; with the tests themselves put off."""
    log = tmp_path / "log"
    programs = {
        "apt-get": f'echo "apt-get $*" >>{log}; exit {0 if may_install else 100}',
        "dpkg-query": "exit 1",
        "sudo": 'shift; exec "$@"',
        "python3": f'echo "python3 $*" >>{log}; exit 7',
    }
    for name, text in programs.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    run = subprocess.run(
        [ROOT / ".ci" / "run"],
        env=os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    asked, last = log.read_text().splitlines()[:-1], log.read_text().splitlines()[-1]
    assert last == "python3 -m venv .venv"
    assert run.returncode == 7
    for package in ("libaravis-0.8-0", "aravis-tools", "umockdev"):
        assert any(line.endswith(f" {package}") for line in asked), asked
        assert (f"{package} could not be installed" in run.stderr) == (not may_install)
