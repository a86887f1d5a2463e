"""`acquire paper` and `acquire tradeoff`: what is refused at once, and which runs are repeats of one case."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from acquire.config import load_rig
from acquire.config.scene import SineDrive
from acquire.evaluate import tradeoff
from acquire.evaluate.paper import page as page_module
from acquire.evaluate.paper.studio import PaperFigure, Studio
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


def interrupting(after: int, real: Callable[..., Any]) -> Callable[..., Any]:
    """A function that Ctrl-C ends at its call number ``after``."""
    calls = iter(range(after))

    def run(*words: Any, **named: Any) -> Any:
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return real(*words, **named)

    return run


@pytest.mark.parametrize("runs", [0, 1])
def test_an_interrupted_study_has_its_runs_and_says_so_or_is_not_there(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runs: int
) -> None:
    """Hours of runs were lost, and a directory without a page remained."""
    monkeypatch.setattr(tradeoff, "measure", interrupting(runs, tradeoff.measure))
    out, words = tmp_path / "study", ("--solver", "twist", "--lines", 120, "--repeats", 2, "--voxels", "6x6")
    answer = cli("tradeoff", "splash", *words, "--preset", "fast", "--budget", "0.2s", "--out", out)
    assert answer.code == 130
    assert out.exists() == bool(runs)
    if runs:
        assert "Interrupted after 1 of 2 runs" in (out / "index.html").read_text(encoding="utf-8")
        assert "no preset is learned from them" in answer.err
        assert "learned  " not in answer.out


@pytest.mark.parametrize("figures", [0, 1])
def test_interrupted_figures_are_named_as_missing_or_nothing_is_left(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, figures: int
) -> None:
    """Half of the files of a figure remained, and nothing said that figures had been asked for."""
    out = tmp_path / "page"

    def make(name: str, studio: Studio) -> PaperFigure:
        (out / f"{name}.zarr").mkdir()
        (out / f"{name}.png").touch()
        return PaperFigure(name, "a title", "a setup", (), (), {"all": 1.0})

    monkeypatch.setattr("acquire.evaluate.paper.make", interrupting(figures, make) if not figures else make)
    drawn = interrupting(figures, page_module.draw)
    monkeypatch.setattr(page_module, "draw", drawn)
    answer = cli("paper", "fig7", "fig8", "--out", out)
    assert answer.code == 130
    assert out.exists() == bool(figures)
    if figures:
        assert "fig8 had not been made" in (out / "index.html").read_text(encoding="utf-8")
        assert json.loads((out / "summary.json").read_text(encoding="utf-8"))["missing"] == ["fig8"]
        assert {path.name for path in out.iterdir()} == {
            "index.html",
            "summary.json",
            "fig7.zarr",
            "fig7.png",
        }
