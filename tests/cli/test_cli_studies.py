"""`acquire paper` and `acquire tradeoff`: what is refused at once, and which runs are repeats of one case."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from acquire.config import load_rig
from acquire.config.scene import SineDrive
from acquire.sim.leds import LedConfig, LedSceneConfig
from acquire.simulate import simulate

Cli = Callable[..., Any]


@pytest.mark.parametrize("words", [("paper", "fig9"), ("tradeoff", "scene-leds"), ("demo",)])
def test_a_directory_that_cannot_be_created_says_so(cli: Cli, words: tuple[str, ...]) -> None:
    """Only the system's words were passed on: what cannot be done was not said, nor what to try."""
    answer = cli(*words, "--out", "/proc/acquire-page")
    assert answer.code == 2
    assert "/proc/acquire-page cannot be created: " in answer.err
    assert "another path" in answer.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--preset", "quick"), "preset 'quick' is not known"),
        (("--solver", "none"), "solver 'none' is not known"),
        (("--budget", "0s"), "a budget of 0 s is out of range"),
        (("--first-line", "5"), "--first-line has no effect without --recording"),
    ],
)
def test_a_mistake_is_refused_before_a_scene_is_recorded(
    cli: Cli, tmp_path: Path, words: tuple[str, ...], said: str
) -> None:
    answer = cli("paper", "fig9", "--out", tmp_path / "page", *words)
    assert answer.code == 2
    assert said in answer.err
    assert not (tmp_path / "page").exists()


def test_recordings_of_the_same_name_are_two_cases(cli: Cli, tmp_path: Path) -> None:
    """They were taken for repeats of one, and the page showed the truth of the last beside all."""
    rig = load_rig("rig-demo", {"geometry.stages": 12, "geometry.substeps": 2})
    drive = SineDrive(waveform="sine", frequency_hz=500.0, low=0.1)
    led = LedConfig(name="x", shape="square", row=0.5, column=0.5, size=0.5, drive=drive)
    one, other = tmp_path / "monday" / "run.zarr", tmp_path / "tuesday" / "run.zarr"
    one.parent.mkdir()
    simulate(rig, LedSceneConfig(kind="leds", title="one LED", leds=(led,)), one, 300)
    shutil.copytree(one, other)
    words = (
        "--voxels",
        "2x1",
        "--solver",
        "admm",
        "--preset",
        "fast",
        "--lines",
        60,
        "--repeats",
        1,
        "--no-learn",
    )
    answer = cli("tradeoff", one, other, "--out", tmp_path / "t", *words, "--json")
    assert answer.code == 0, answer.err
    assert {row["case"] for row in answer.json["rows"]} == {str(one), str(other)}
