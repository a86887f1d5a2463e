"""Recordings whose arms were turned or mirrored since their calibration was made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from instruments import COLUMNS, NOISE, dots, record, white

from acquire.alignment import Alignment
from acquire.calibrate import Calibration
from acquire.calibrate.columns import dark, flat
from acquire.calibrate.exposure import open_exposure
from acquire.calibrate.target import alignment
from acquire.recon import reconstruct
from acquire.recon.hypotheses import AS_BUILT, Turn
from acquire.reconstruct.diagnose import diagnose_recording
from acquire.reconstruct.reorient import arrangements, reoriented
from acquire.reconstruct.work import Options, as_read
from acquire.store import open_recording

OFF = {"kind": "misregistration", "rows": 3.0, "columns": -2.0, "turn_deg": 0.8, "beyond": "edge"}
EFFECTS = (*NOISE, *COLUMNS, OFF)
LINES = 300


@pytest.fixture(scope="module")
def cal(tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    directory = tmp_path_factory.mktemp("cal")
    plain = white(effects=EFFECTS)
    scenes = {"dark": plain, "flat": plain, "target": dots(directory, EFFECTS)}
    taken = {name: record(directory / f"{name}.zarr", each, name) for name, each in scenes.items()}
    first = dark(open_exposure(taken["dark"]))
    known = Calibration(first.instrument).with_step(first)
    known = known.with_step(flat(open_exposure(taken["flat"]), known))
    return known.with_step(alignment(open_exposure(taken["target"]), known))


def lamps(optics: dict[str, Any]) -> Any:
    leds = [
        {"name": name, "shape": shape, "row": row, "column": column, "size": 0.35}
        for name, shape, row, column in (
            ("x", "x", 0.3, 0.35),
            ("o", "circle", 0.7, 0.3),
            ("t", "triangle", 0.6, 0.7),
        )
    ]
    for led, hertz in zip(leds, (900.0, 2300.0, 1500.0), strict=True):
        led["drive"] = {"waveform": "sine", "frequency_hz": hertz, "low": 0.1, "high": 1.0}
    return type(white()).model_validate(white(effects=EFFECTS, optics=optics).model_dump() | {"leds": leds})


@pytest.mark.parametrize(
    ("optics", "turn"),
    [
        ({"b": {"turn_deg": 270, "mirror": True}}, Turn(pixels=True)),
        ({"b": {"turn_deg": 90, "mirror": True}}, Turn(rows=True)),
        ({"a": {"turn_deg": 180}}, Turn(rows=True, pixels=True)),
    ],
    ids=["mirrored", "rows mirrored", "turned"],
)
def test_the_alignment_turns_with_the_arms(
    tmp_path: Path, cal: Calibration, optics: dict[str, Any], turn: Turn
) -> None:
    """It stayed as it was, and made the video of turned arms far worse than none would, without a word."""
    run = open_recording(record(tmp_path / "run.zarr", lamps(optics), "target", LINES))
    found = diagnose_recording(run, None, None, cal)
    assert found.hypothesis is not None
    assert found.hypothesis.turn == turn
    assert found.hypothesis.late == (0, 0)
    assert "since the calibration was made" in found.sentence
    segment = run.cut(run.first_line, LINES)
    moved = reoriented(segment, cal, turn)
    assert moved.aligned
    assert "turned with the arms" in moved.words

    def prediction(calibration: Calibration) -> float:
        lines = as_read(segment, Options(calibration=calibration, turn=turn))
        return reconstruct(lines, 3, 1, iterations=30, check=False, error=False).quality.prediction

    assert prediction(moved.calibration) < 0.6 * prediction(replace(cal, alignment=None))


def test_an_alignment_that_the_lines_do_not_show_is_left_out(tmp_path: Path, cal: Calibration) -> None:
    run = open_recording(record(tmp_path / "run.zarr", white(0.4, EFFECTS), "target", LINES))
    moved = reoriented(run.cut(run.first_line, LINES), cal, Turn(pixels=True))
    assert not moved.aligned
    assert "not used: the alignment" in moved.words
    assert moved.calibration.quantities["gain"] is cal.quantities["gain"]
    unturned = as_read(run.cut(run.first_line, LINES), Options(calibration=cal, turn=AS_BUILT))
    assert unturned.alignment == cal.alignment.alignment if cal.alignment else None


def test_arrangements_are_the_alignment_in_other_frames() -> None:
    given = Alignment(3.0, -2.0, 0.8, 1.01)
    found = arrangements(given)
    assert len({(round(e.rows, 9), round(e.columns, 9), e.turn_deg) for e in found}) == 16
    points = np.array([[[10.0, -20.0]], [[5.0, 30.0]]])
    there = given.to_b(points, 36.0)
    # with exchanged arms in the same frame, the way back
    assert any(np.allclose(each.to_b(there, 36.0), points) for each in found)
    # mirrored left to right: both arms' points are
    mirror = np.array([1.0, -1.0])[:, None, None]
    assert any(np.allclose(each.to_b(points * mirror, 36.0), there * mirror) for each in found)
