"""Contrast of the bars of a target, as Fig. 6c plots it, and the comparison with the paper."""

from __future__ import annotations

import numpy as np
import pytest

from acquire.config import load_rig, load_scene
from acquire.evaluate.paper.bars import contrasts, last_resolved, place_of
from acquire.evaluate.paper.comparison import Row, captured, faster, finer, frequency, same
from acquire.evaluate.paper.fig6 import in_scene_units
from acquire.evaluate.paper.studio import scene_of
from acquire.recon import reconstruct
from acquire.sim.targets import usaf_picture
from acquire.simulate import simulate
from acquire.store import open_recording

GROUPS, FIELD_MM = (2, 3), 6.4


def test_a_sharp_target_is_resolved_and_a_blurred_one_is_not():
    sharp = usaf_picture((2, 3, 4, 5), 768, FIELD_MM)
    assert last_resolved(contrasts(sharp, FIELD_MM, GROUPS)) == "3/6"
    coarse = sharp.reshape(64, 12, 64, 12).mean(axis=(1, 3))
    contrast = contrasts(coarse, FIELD_MM, GROUPS)
    assert contrast["2/1"] > 0.3
    assert contrast["3/4"] < 0.1
    assert contrasts(np.ones((192, 192)), FIELD_MM, GROUPS)["2/1"] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("name", ["", "-interline"])
def test_pictures_of_both_kinds_of_tdi_are_as_bright_as_the_scene(name, tmp_path) -> None:
    rig = load_rig("rig-interline" if name else "rig-fast", {"geometry.stages": 12})
    simulate(rig, load_scene(f"scene-usaf{name}"), tmp_path / "r.zarr", 80)
    recording = open_recording(tmp_path / "r.zarr")
    segment = recording.cut(16, 60)
    picture = reconstruct(segment, 1, segment.geometry.span, "fast").video[0]
    true = scene_of(recording).frames(0, 1)[0]
    assert in_scene_units(picture, recording).mean() == pytest.approx(true.mean(), rel=0.03)


def test_reached_is_equal_and_only_beyond_is_better() -> None:
    paper = "group 3, element 5"
    rows = [
        finer("", paper, "", place_of(element) - place_of("3/5")) for element in ("3/6", "3/5", "2/6", "–")
    ]
    assert [(row.verdict, row.by) for row in rows] == [
        ("better", "1 element finer, × 1.12"),
        ("equal", ""),
        ("worse", "5 elements coarser, × 1.78"),
        ("worse", "11 elements coarser, × 3.56"),
    ]


@pytest.mark.parametrize(
    ("r", "expected", "verdict"),
    [
        (0.98, True, "holds"),
        (0.35, True, "does not hold"),
        (0.35, False, "holds"),
        (0.98, False, "does not hold"),
    ],
)
def test_claims_in_words_hold_or_not_and_are_never_better(r: float, expected: bool, verdict: str) -> None:
    assert captured("pulses", "captured", r, expected=expected).verdict == verdict


def test_times_and_frequencies_say_by_how_much() -> None:
    assert (
        faster("time", "", "", seconds=60.0, paper_s=600.0, where="elsewhere").by == "× 10 faster, elsewhere"
    )
    assert faster("time", "", "", seconds=900.0, paper_s=600.0, where="elsewhere").verdict == "worse"
    assert frequency("x", "", "", 4999.5, 5000.0).by == "error 0.5 Hz, 0.01%"
    assert frequency("x", "", "", 4900.0, 5000.0).verdict == "does not hold"
    assert same("video", "", "", equal=False).verdict == "worse"
    assert Row("accuracy", "–", "40 dB").verdict == "no number"
