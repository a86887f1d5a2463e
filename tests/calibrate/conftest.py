"""One instrument with all effects, recorded once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from instruments import ALL, dots, record, white

from acquire.calibrate import Calibration
from acquire.calibrate.columns import dark, flat
from acquire.calibrate.exposure import open_exposure


@pytest.fixture(scope="session")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Recordings of one instrument: dark, flat, target."""
    directory = tmp_path_factory.mktemp("instrument")
    scenes: dict[str, Any] = {"dark": white(effects=ALL), "flat": white(effects=ALL)}
    scenes["target"] = dots(directory, ALL)
    return {name: record(directory / f"{name}.zarr", scene, name) for name, scene in scenes.items()}


@pytest.fixture(scope="session")
def known(recordings: dict[str, Path]) -> Calibration:
    """Its calibration from dark and flat."""
    first = dark(open_exposure(recordings["dark"]))
    calibration = Calibration(first.instrument).with_step(first)
    return calibration.with_step(flat(open_exposure(recordings["flat"]), calibration))
