"""``acquire calibrate delay`` on a running daemon, interrupted half-way, then evaluated again."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from live_daemon import COMMAND, Daemon, until_gone
from waiting import until

from acquire.calibrate import Measured, open_calibration, save_calibration
from acquire.calibrate.exposure import open_exposure
from acquire.cli.calibrate_delay import _found
from acquire.errors import UsageError

SCENE = """
kind = "leds"
[[leds]]
name = "all"
shape = "square"
row = 0.5
column = 0.5
size = 1.0
drive = { waveform = "constant", level = 0.5 }
[[effects]]
kind = "shot_noise"
[[effects]]
kind = "delays"
light_s = 4.0e-6
a_s = 1.0e-6
"""
LATE = (270, 360)
"""Ticks, of arms a and b."""


def test_an_interrupted_sweep_keeps_its_recordings(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    scene = f"simulation.scene='{tmp_path}/scene.toml'"
    daemon = Daemon(tmp_path, "trigger.substep_ticks=900", scene)
    try:
        words = [*COMMAND, "calibrate", "delay", "--out", "cal.zarr", "--yes", "--lines", "4096"]
        environment = os.environ | {"ACQUIRE_SOCKET": str(daemon.socket)}
        with subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=environment
        ) as sweeping:
            assert sweeping.stderr is not None
            for line in sweeping.stderr:
                if "recordings of 4096 lines" in line:
                    break
            third = tmp_path / "calibration-recordings" / "delay-3.zarr"
            until(lambda: third.exists() or sweeping.poll() is not None)
            sweeping.send_signal(signal.SIGINT)
            out, said = sweeping.communicate(timeout=300)
        assert sweeping.returncode == 0, said
        assert "trigger.light.lead_ticks = " in out
        late = open_calibration(tmp_path / "cal.zarr").quantities["light_late_ticks"]
        assert late.value == pytest.approx(LATE, abs=5 * late.uncertainty.max())
        assert late.uncertainty.max() < 60
        with daemon.client() as client:
            assert client.status().state == "idle"
        taken = sorted(path.name for path in (tmp_path / "calibration-recordings").iterdir())
        assert 3 <= len(taken) < 7, said
        places = [f"calibration-recordings/{name}" for name in taken]
        again = json.loads(daemon("calibrate", "delay", *places, "--out", "again.zarr", "--json").out)
        assert again["light_late_ticks"] == pytest.approx(late.value.tolist())
        _is_not_replaced_by_less(tmp_path, places)
    finally:
        daemon.close()


PAGE = """
import subprocess, sys, threading

step = subprocess.Popen([sys.executable, "-m", "acquire.web.worker", *sys.argv[1:]], process_group=0)
print(step.pid, flush=True)
for _ in range(16):
    threading.Thread(target=threading.Event().wait).start()
"""
"""Of many threads, as the page has: the kernel tells the step of the death of each of them."""


def test_a_step_whose_page_is_killed_leaves_the_instrument_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    daemon = Daemon(tmp_path, "trigger.substep_ticks=900", f"simulation.scene='{tmp_path}/scene.toml'")
    try:
        words = ["calibrate", "delay", "--out", "cal.zarr", "--yes", "--lines", "1024"]
        with subprocess.Popen(
            [sys.executable, "-c", PAGE, *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            cwd=tmp_path,
            env=os.environ | {"ACQUIRE_SOCKET": str(daemon.socket)},
        ) as page:
            assert page.stdout is not None
            step = psutil.Process(int(page.stdout.readline()))
            second = tmp_path / "calibration-recordings" / "delay-2.zarr"
            until(lambda: second.exists() or not step.is_running())
            with daemon.client() as client:
                until(lambda: client.status().busy is not None or not step.is_running())  # often an arm
            page.kill()
            until_gone([step])
        with daemon.client() as client:
            status = client.status()
            assert (status.state, status.busy) == ("idle", None)
    finally:
        daemon.close()


def _is_not_replaced_by_less(home: Path, places: list[str]) -> None:
    """A partial sweep does not replace a result with a smaller uncertainty."""
    cal, exposures = home / "again.zarr", [open_exposure(home / place) for place in places]
    known = open_calibration(cal)
    late = known.quantities["light_late_ticks"]
    surer = Measured(late.value + 1.0, 0.01 * late.uncertainty)
    save_calibration(cal, replace(known, quantities={**known.quantities, "light_late_ticks": surer}))
    with pytest.raises(UsageError, match="has an uncertainty of"):
        _found(str(cal), exposures, whole=False)
    assert open_calibration(cal).quantities["light_late_ticks"].value == pytest.approx(surer.value)
    assert _found(str(cal), exposures, whole=True).quantities["light_late_ticks"].value == pytest.approx(
        late.value
    )
