"""``acquire diagnose`` as a user types it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from acquire.config import load_rig
from acquire.effect_config import CodeErrors
from acquire.scene_config import ConstantDrive, LedConfig, LedSceneConfig, SineDrive
from acquire.simulate import simulate

Cli = Callable[..., Any]


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its light is two sub-steps late."""
    rig = load_rig("rig-demo", {"geometry.stages": 24, "geometry.substeps": 2})
    slow = SineDrive(waveform="sine", frequency_hz=200.0, low=0.3)
    still = ConstantDrive(waveform="constant", level=0.9)
    leds = (
        LedConfig(name="slow", shape="square", row=0.25, column=0.3, size=0.3, drive=slow),
        LedConfig(name="still", shape="square", row=0.75, column=0.6, size=0.2, drive=still),
    )
    scene = LedSceneConfig(kind="leds", leds=leds, effects=(CodeErrors(kind="code_errors", late_substeps=2),))
    path = tmp_path_factory.mktemp("late") / "run.zarr"
    simulate(rig, scene, path, 150)
    return path


def test_what_is_wrong_is_said_with_its_evidence(cli: Cli, late: Path) -> None:
    answer = cli("diagnose", late)
    assert answer.code == 1, answer.err
    assert "named: the lines are 2 sub-steps late against the code" in answer.out
    assert "likelier by" in answer.out


def test_the_same_for_programs(cli: Cli, late: Path) -> None:
    answer = cli("diagnose", late, "--lines", 100, "--json")
    assert answer.code == 1
    assert answer.json["standing"] == "named"
    assert answer.json["lines"] == 100
    best = answer.json["hypotheses"][0]
    assert "2 sub-steps late" in best["name"]
    assert best["log_likelihood"] > 0


def test_lines_that_are_not_there(cli: Cli, late: Path) -> None:
    answer = cli("diagnose", late, "--first-line", 100_000_000)
    assert answer.code == 2
    assert "not there" in answer.err
