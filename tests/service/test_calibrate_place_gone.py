"""A calibration that vanishes while it is recorded: the recordings stay, and how to use them is said."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from live_daemon import COMMAND, Daemon
from test_calibrate_linearity import SCENE, SETTINGS
from waiting import until

from acquire.calibrate import open_calibration


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    (tmp_path / "scene.toml").write_text(SCENE)
    bright = [f"cameras.{arm}.responsivity_dn=160.0" for arm in "ab"]
    rig = (*SETTINGS, *bright, f"simulation.scene='{tmp_path}/scene.toml'")
    with contextlib.closing(Daemon(tmp_path, *rig)) as made:
        yield made


def interfered(daemon: Daemon, words: list[str], recording: str, interfere: Callable[[], object]) -> str:
    """Calibrate, interfere once a recording has begun, and return what was said with the exit code 5."""
    command = subprocess.Popen(
        [*COMMAND, "calibrate", *words, "--yes", "--out", "results/cal.zarr"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=daemon.home,
        env=os.environ | {"ACQUIRE_SOCKET": str(daemon.socket), "COLUMNS": "10000"},
    )
    until((daemon.home / "calibration-recordings" / recording).exists)
    interfere()
    said = command.communicate(timeout=240)[1]
    assert command.returncode == 5, said
    return said


def advised(said: str) -> list[str]:
    """The words of the command that evaluates the recordings later."""
    found = re.search(r"then acquire (calibrate .* --out \S+)", said)
    assert found, said
    return shlex.split(found[1])


def test_a_recording_whose_result_finds_no_place_is_evaluated_as_advised(daemon: Daemon) -> None:
    results = daemon.home / "results"
    results.mkdir()
    words = ["all", "--only", "dark", "--lines", "8192"]
    said = interfered(daemon, words, "dark-1.zarr", results.rmdir)
    assert "the directory results does not exist; the recording is kept" in said
    assert "create it first; then" in said
    results.mkdir()
    done = daemon(*advised(said))
    assert done.code == 0, done.err
    known = open_calibration(results / "cal.zarr")
    assert Path(known.steps["dark"]["recording"]).name == "dark-1.zarr"

    # A ramp needs the dark that was there when it was begun.
    away = daemon.home / "away"
    said = interfered(daemon, ["linearity", "--lines", "256"], "ramp-3.zarr", lambda: results.rename(away))
    assert "results/cal.zarr does not exist; the 16 recordings are kept" in said
    away.rename(results)
    done = daemon(*advised(said))
    assert done.code == 0, done.err
    assert list(open_calibration(results / "cal.zarr").steps) == ["dark", "linearity", "transfer"]


def test_a_sequence_does_not_say_that_a_calibration_that_is_gone_has_its_steps(daemon: Daemon) -> None:
    results = daemon.home / "results"
    results.mkdir()
    words = ["all", "--only", "dark", "--only", "flat", "--lines", "4096"]
    said = interfered(daemon, words, "flat-1.zarr", lambda: shutil.rmtree(results))
    assert "results/cal.zarr does not exist; the recording is kept" in said
    flat = daemon.home / "calibration-recordings" / "flat-1.zarr"
    commands = [f"acquire calibrate {step} {flat} --out results/cal.zarr" for step in ("flat", "transfer")]
    assert f"then {' && '.join(commands)}" in said
    assert "has dark" not in said
