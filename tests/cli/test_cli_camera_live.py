"""``acquire camera live``: on the cameras themselves, and on the lines that a daemon passes on."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from rich.console import Console

from acquire.camera.gauge import Reading
from acquire.cli.camera_screen import Screen, bar, reading_text, sparkline
from acquire.config import load_rig
from acquire.rig import Rig
from acquire.sim.lines import StreamingArm

Cli = Callable[..., Any]


@pytest.mark.parametrize(
    "rig", ["rig-demo", pytest.param("rig-demo-gentl", marks=pytest.mark.needs_compiler)]
)
def test_readings_are_those_of_the_lines(cli: Cli, rig: str) -> None:
    answer = cli("camera", "live", "--config", rig, "--code", "steady", "--seconds", "1", "--json")
    turns = [json.loads(line) for line in answer.out.splitlines()]
    assert len(turns) >= 3
    config = load_rig(rig)
    with Rig(config) as made:
        scene = made.scene()
        for arm in "ab":
            steady = load_rig(rig, {"code": {"kind": "constant", "value": 1}}).code.build()
            light = 6.0 * StreamingArm(scene, steady, 64, 3, arm).lines(0, 4096).astype(float)
            seen = [turn[arm] for turn in turns if turn[arm]["lines"] > 2000]
            assert len(seen) >= 2
            level = np.mean([one["level"] for one in seen])
            assert level == pytest.approx(light.mean() / 4095, rel=0.05)
            focus = np.sqrt((np.diff(light, axis=1) ** 2).mean()) / light.mean()
            assert np.mean([one["focus"] for one in seen]) == pytest.approx(focus, rel=0.05)


def test_one_camera_until_ctrl_c() -> None:
    command = [sys.executable, "-m", "acquire", "camera", "live", "SIM-B", "-c", "rig-demo"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as looking:
        assert looking.stdout is not None
        assert "b: level" in looking.stdout.readline()
        children = psutil.Process(looking.pid).children(recursive=True)
        looking.send_signal(signal.SIGINT)
        _, said = looking.communicate(timeout=300)
    assert (looking.returncode, "closing the cameras" in said) == (0, True)
    assert children
    assert not psutil.wait_procs(children, timeout=60)[1]


def test_wrong_arguments(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GENICAM_GENTL64_PATH", raising=False)
    nobody = ("--socket", tmp_path / "none.sock")
    for command, code, text in (
        (nobody, 3, "--config RIG"),
        (("SIM-C", "-c", "rig-demo"), 2, "possible: SIM-A, SIM-B"),
        (("-c", "rig-demo", "--code", "blue"), 2, "is not one of 'rig', 'dark', 'steady'"),
        (("X", *nobody), 5, "GENICAM_GENTL64_PATH"),
    ):
        answer = cli("camera", "live", *command)
        assert (answer.code, text in answer.err) == (code, True), answer.err


def test_the_screen_names_the_problem() -> None:
    screen = Screen({"a": "A\x1b[2J", "b": "B"}, "here", 0.2)
    screen.show({"a": Reading(100, 0, 0.5, 1.0, 0.01, 0.2), "b": Reading(0)})
    shown = _drawn(screen)
    assert "\x1b" not in shown
    assert "saturated: use less light" in shown
    assert "no lines are arriving" in shown
    # The first lines may take seconds, and a camera that is starting was said not to respond.
    assert reading_text(None).startswith("no reading yet: ")
    assert bar(0.5).count("█") == 16
    line = sparkline([1.0, 2.0, 3.0])
    assert (line[0], line[-1]) == ("▁", "█")
    assert set(sparkline([1.0, 1.0001, 0.9999])) <= set("▄▅")  # nothing but noise
    assert reading_text(Reading(9, 0, 0.02, 0.1, 0.0, 0.3)).endswith(
        "focus 30.00% (dim: use more light or a larger aperture)"
    )


def _drawn(screen: Screen) -> str:
    with Path(os.devnull).open("w", encoding="utf-8") as nowhere:
        console = Console(width=100, record=True, file=nowhere)
        console.print(screen)
        return console.export_text()
