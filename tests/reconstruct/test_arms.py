"""Arms with different shares of the light: corrected if unknown, reported if a calibration is wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from instruments import NOISE, record, white

from acquire.calibrate import Calibration
from acquire.calibrate.columns import dark, flat
from acquire.calibrate.exposure import open_exposure
from acquire.recon.segments import Voxels
from acquire.reconstruct import Monitor, Options, by_lines, combine, in_voxels, open_pool
from acquire.sim.leds import LedSceneConfig
from acquire.store import open_recording

SPLITTER = {"kind": "beam_splitter", "part_a": 0.47}
RATIO = 0.53 / 0.47


def lamp(effects: Any) -> LedSceneConfig:
    led = {"name": "x", "shape": "x", "row": 0.45, "column": 0.55, "size": 0.8}
    led["drive"] = {"waveform": "sine", "frequency_hz": 900.0, "low": 0.3, "high": 1.0}
    table = {"kind": "leds", "leds": [led], "system_gain_dn_per_e": 0.1, "effects": list(effects)}
    return LedSceneConfig.model_validate(table)


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("arms") / "split.zarr"
    return record(path, lamp((*NOISE, SPLITTER)), "target", 900)


def provenance(path: Path, out: Path, calibration: Calibration | None = None) -> dict[str, Any]:
    recording = open_recording(path)
    request = in_voxels(by_lines(recording, 0, 90), Voxels(3, 12))
    options = Options("fast", iterations=5, calibration=calibration, check=False)
    tasks = len(request.stretches)
    monitor = Monitor(tasks)
    with open_pool(tasks, 1, None, monitor) as pool:
        return combine(recording, request, out, options=options, pool=pool, monitor=monitor).provenance


def test_a_balance_found_in_the_lines_is_corrected_and_reported(split: Path, tmp_path: Path) -> None:
    facts = provenance(split, tmp_path / "video.zarr")
    balance = facts["balance"]
    assert balance["corrected"]
    assert balance["ratio"] == pytest.approx(RATIO, abs=3 * balance["error"])
    assert balance["error"] < 0.03
    assert [text for text in facts["warnings"] if "arm b gets 1.1" in text]
    assert all("balance" not in part["parameters"] for part in facts["segments"])


def test_a_calibration_takes_precedence_and_its_drift_is_reported(split: Path, tmp_path: Path) -> None:
    known = {}
    for name, effects in (("before", NOISE), ("now", (*NOISE, SPLITTER))):
        scene = white(effects=effects)
        exposures = {
            light: open_exposure(record(tmp_path / f"{name}-{light}.zarr", scene, light, 256))
            for light in ("dark", "flat")
        }
        offsets = dark(exposures["dark"])
        made = Calibration(offsets.instrument).with_step(offsets)
        known[name] = made.with_step(flat(exposures["flat"], made))
    now = provenance(split, tmp_path / "now-video.zarr", known["now"])
    assert [text for text in now["warnings"] if "arm" in text] == []
    assert not now["balance"]["corrected"]
    assert now["balance"]["ratio"] == pytest.approx(1, abs=3 * now["balance"]["error"])
    before = provenance(split, tmp_path / "before-video.zarr", known["before"])
    assert not before["balance"]["corrected"]
    assert any("no longer holds" in text for text in before["warnings"])
