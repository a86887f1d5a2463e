"""A user without a home that takes files, as a service's account, computes and draws all the same."""

from __future__ import annotations

import os
import pwd
import subprocess
import sys
from pathlib import Path

import pytest

from acquire.config import load_rig
from acquire.daemon.unit import unit_text
from acquire.reconstruct.learned import learned_path, recall

COMPILE = """
import pathlib, subprocess, sys
import numba

def refused(x):
    return x
try:
    numba.njit(cache=True)(refused)
except RuntimeError as error:
    print(type(error).__name__)

from acquire.loops import compiled, how_often

@compiled(nogil=True)
def double(x):
    return 2 * x
print(double(21))
print(how_often())
print(numba.config.CACHE_DIR, flush=True)
subprocess.run([sys.executable, "-c", "import numba; print(numba.config.CACHE_DIR)"], check=True)
print(len(list(pathlib.Path(numba.config.CACHE_DIR).rglob("*.nbc"))))
"""
DRAW = """
import os
import acquire.evaluate.themed
print(os.environ.get("MPLCONFIGDIR", "its own"))
"""


def run(code: str, tmp_path: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a script from a file: numba keeps nothing of what has none."""
    script = tmp_path / "script.py"
    script.write_text(code, encoding="utf-8")
    cleared = {"MPLCONFIGDIR", "NUMBA_CACHE_DIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME"}
    kept = {name: value for name, value in os.environ.items() if name not in cleared}
    here = str(Path(__file__).parents[1])
    return subprocess.run(
        [sys.executable, str(script)],
        env=kept | {"PYTHONPATH": here} | environment,
        capture_output=True,
        text=True,
        check=True,
    )


def test_loops_that_no_directory_keeps_are_compiled_for_the_run(tmp_path: Path) -> None:
    """Every command that computes was a RuntimeError of numba's."""
    # Without the package's directory and the user's home, which take nothing.
    done = run(COMPILE, tmp_path, NUMBA_CACHE_LOCATOR_CLASSES="UserProvidedCacheLocator")
    refused, answer, often, own, childs, kept = done.stdout.splitlines()
    assert (refused, answer, kept) == ("RuntimeError", "42", "1")
    assert often.startswith("in every run, unless NUMBA_CACHE_DIR names")
    assert childs == own
    assert not Path(own).exists(), "it is removed at the end"
    assert done.stderr == ""


def test_matplotlib_is_silent_about_a_home_that_takes_nothing(tmp_path: Path) -> None:
    """It printed two lines on a directory that it had made itself."""
    home = tmp_path / "home"
    home.touch()
    done = run(DRAW, tmp_path, HOME=str(home))
    assert done.stderr == ""
    assert not Path(done.stdout.strip()).exists()


def test_matplotlib_keeps_its_files_in_a_home_that_takes_them(tmp_path: Path) -> None:
    (home := tmp_path / "home").mkdir()
    done = run(DRAW, tmp_path, HOME=str(home))
    assert (done.stdout.strip(), done.stderr) == ("its own", "")
    assert (home / ".config" / "matplotlib").is_dir()


def test_a_user_who_is_in_no_list_of_accounts_has_no_home(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a container; it was a RuntimeError of pathlib's."""
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(pwd, "getpwuid", {}.__getitem__)  # which raises KeyError, as for such a user
    assert not learned_path().exists()
    assert recall() == []
    unit = unit_text(load_rig("rig-demo"), tmp_path / "rig.toml", user=False)
    assert f"User={os.geteuid()}\n" in unit
