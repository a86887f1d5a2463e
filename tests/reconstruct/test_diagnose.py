"""Recordings that contradict their description: made by the simulator, diagnosed by `acquire diagnose`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from two_squares import record_two_squares

from acquire.config.effect import EffectConfig
from acquire.config.scene import ArmOptics
from acquire.recon.diagnosis import Diagnosis
from acquire.recon.hypotheses import Hypothesis, Turn
from acquire.recon.search import Standing
from acquire.reconstruct.diagnose import diagnose_recording, diagnosed_range
from acquire.sim.effects.image import StrayLight
from acquire.sim.effects.light import CodeErrors
from acquire.sim.effects.stream import DroppedLines
from acquire.store import open_recording

LINES = 150
Told = Callable[..., Diagnosis]


@pytest.fixture
def told(tmp_path: Path) -> Told:
    """Simulate a recording with a fault and diagnose it."""

    def tell(*effects: EffectConfig, b: ArmOptics | None = None, lines: int = LINES) -> Diagnosis:
        path = record_two_squares(tmp_path / "run.zarr", lines, effects, b)
        return diagnose_recording(open_recording(path), None, None)

    return tell


def test_a_correct_description(told: Told) -> None:
    found = told()
    assert found.standing is Standing.RIGHT
    assert not found.sentences
    assert found.rows[0].name == "as described"


def test_late_light(told: Told) -> None:
    """The recording has the code's bits before the segment, so no sub-step has to be guessed."""
    found = told(CodeErrors(kind="code_errors", late_substeps=3))
    assert found.standing is Standing.NAMED
    assert found.hypothesis == Hypothesis(late=(3, 3))
    assert "3 sub-steps late" in found.sentence


def test_light_later_than_the_search_reaches(told: Told) -> None:
    found = told(CodeErrors(kind="code_errors", late_substeps=60), lines=2500)
    assert found.standing is Standing.NAMED, found.sentence
    assert "60 sub-steps late" in found.sentence


def test_late_light_despite_lost_lines(told: Told) -> None:
    """A missing line is no dark line."""
    lost = DroppedLines(kind="dropped_lines", rate=0.2)
    found = told(CodeErrors(kind="code_errors", late_substeps=60), lost, lines=2500)
    assert found.standing is Standing.NAMED, found.sentence
    assert "60 sub-steps late" in found.sentence


def test_a_mirrored_arm(told: Told) -> None:
    found = told(b=ArmOptics(turn_deg=270, mirror=True))
    assert found.standing is Standing.NAMED
    assert found.hypothesis is not None
    assert found.hypothesis.turn == Turn(pixels=True)


def test_ambient_light_does_not_contradict_the_code(told: Told) -> None:
    found = told(StrayLight(kind="stray_light", ambient=0.2))
    assert found.standing in (Standing.RIGHT, Standing.UNCLEAR)


def test_the_middle_of_a_long_recording_is_diagnosed(recording_path: Path) -> None:
    recording = open_recording(recording_path)
    assert diagnosed_range(recording, None, None) == (recording.first_line + 40, 320)
    assert diagnosed_range(recording, recording.first_line + 5, 30) == (recording.first_line + 5, 30)
