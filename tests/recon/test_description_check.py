"""A reconstruction's quality beside the diagnosis of its lines: which of the two is believed."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest

from acquire.lines import Segment
from acquire.recon import description_check
from acquire.recon.clock import IterationClock
from acquire.recon.description_check import DescriptionCheck, check_description
from acquire.recon.diagnosis import UNEXPLAINED, Diagnosis
from acquire.recon.result import Quality
from acquire.recon.search import Standing

LATE = "the lines are 1 sub-step late against the code"


class Leisure:
    def affords(self, seconds: float) -> bool:
        return True


def checked(
    monkeypatch: pytest.MonkeyPatch, standing: Standing, *, misfit: float, prediction: float, noise: float
) -> DescriptionCheck:
    """The check of a reconstruction of this quality, whose lines are diagnosed as ``standing``."""
    sentence = UNEXPLAINED if standing is Standing.UNEXPLAINED else LATE
    monkeypatch.setattr(description_check, "diagnose", lambda segment: Diagnosis(standing, sentence))
    quality = Quality(misfit, prediction, 1.0, noise)
    return check_description(cast(Segment, None), quality, cast(IterationClock, Leisure()))


def test_a_code_that_predicts_held_out_lines_to_their_noise_is_not_foreign(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = checked(monkeypatch, Standing.UNEXPLAINED, misfit=0.0135, prediction=0.0143, noise=0.0140)
    assert found.believed
    assert not found.warnings


@pytest.mark.parametrize(
    ("prediction", "noise"),
    [
        (0.025, 0.014),  # 2 % beyond the noise, as foreign codes leave
        (0.101, 0.100),  # in little light a foreign code looks no worse
        (0.0143, np.nan),
        (np.nan, 0.014),  # the used samples are followed into their noise
    ],
)
def test_a_foreign_code_is_not_believed(
    monkeypatch: pytest.MonkeyPatch, prediction: float, noise: float
) -> None:
    found = checked(monkeypatch, Standing.UNEXPLAINED, misfit=0.0135, prediction=prediction, noise=noise)
    assert not found.believed
    assert found.warnings == (UNEXPLAINED,)


def test_a_better_description_is_named_even_if_lines_are_predicted(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene displaced by a row is predicted as well as the right one."""
    found = checked(monkeypatch, Standing.NAMED, misfit=0.0135, prediction=0.0143, noise=0.0140)
    assert not found.believed
    assert found.warnings == (LATE,)
