"""The steps as a person is guided through them."""

from __future__ import annotations

from pathlib import Path

from acquire.calibrate.guide import DARK, DELAY, FLAT, TARGET, VEIL, lines_of
from acquire.daemon.facts import Setup
from acquire.web.calibrations import calibration_facts, rows_of


def test_a_large_sensor_gets_more_lines_where_a_scene_is_resolved() -> None:
    assert [lines_of(TARGET, rows) for rows in (0, 192, 256, 384, 768)] == [1024, 1024, 1024, 1536, 3072]
    assert lines_of(VEIL, 384) == 4096
    # columns alone are measured, or as many lines as the sweep needs
    assert lines_of(DARK, 3000) == lines_of(FLAT, 3000) == 4096
    assert lines_of(DELAY, 3000) is None


def test_the_page_offers_as_many(tmp_path: Path) -> None:
    setup = Setup.model_construct(config={"geometry": {"stages": 128, "substeps": 3}})
    facts = calibration_facts(tmp_path / "none.zarr", named=False, rows=rows_of(setup))
    assert {step.name: step.lines for step in facts.steps} == {
        "delay": None,
        "dark": 4096,
        "linearity": 512,
        "flat": 4096,
        "target": 1536,
        "psf": 1536,
        "veil": 4096,
    }
    assert rows_of(None) == 0
