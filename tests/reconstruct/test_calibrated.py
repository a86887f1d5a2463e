"""Reconstruction with the calibration that a recording carries, with another one, and with none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from instruments import COLUMNS, NOISE, M, N, dots, record, white

from acquire.calibrate import Calibration, calibrated, open_calibration, save_calibration
from acquire.calibrate.columns import dark, flat
from acquire.calibrate.exposure import open_exposure
from acquire.calibrate.linearity import linearity
from acquire.calibrate.target import alignment
from acquire.config import load_rig
from acquire.errors import ConfigError
from acquire.recon import reconstruct
from acquire.sim.leds import LedSceneConfig
from acquire.sim.scenes import build_scene
from acquire.store import open_recording

OFF = {"kind": "misregistration", "rows": 2.0, "columns": -1.5, "turn_deg": 0.8}
EFFECTS = (
    *NOISE,
    *COLUMNS,
    OFF,
    {"kind": "beam_splitter", "part_a": 0.47},
    {"kind": "stray_light", "ambient": 0.03},
)


def lit(effects: Any = ()) -> LedSceneConfig:
    leds = [
        {"name": "x", "shape": "x", "row": 0.35, "column": 0.35, "size": 0.5},
        {"name": "o", "shape": "circle", "row": 0.68, "column": 0.66, "size": 0.45},
    ]
    for led, hertz in zip(leds, (900.0, 2300.0), strict=True):
        led["drive"] = {"waveform": "sine", "frequency_hz": hertz, "low": 0.1, "high": 1.0}
    table = {"kind": "leds", "leds": leds, "system_gain_dn_per_e": 0.1, "effects": list(effects)}
    return LedSceneConfig.model_validate(table)


@pytest.fixture(scope="module")
def cal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("cal")
    first = dark(open_exposure(record(directory / "dark.zarr", white(effects=EFFECTS), "dark", 1024)))
    known = Calibration(first.instrument).with_step(first)
    known = known.with_step(
        flat(open_exposure(record(directory / "flat.zarr", white(effects=EFFECTS), "flat", 1024)), known)
    )
    target = record(directory / "target.zarr", dots(directory, EFFECTS), "target", 1024)
    save_calibration(directory / "cal.zarr", known.with_step(alignment(open_exposure(target), known)))
    return directory / "cal.zarr"


@pytest.fixture(scope="module")
def run(cal: Path) -> Path:
    """A recording that carries the calibration."""
    return record(cal.parent / "run.zarr", lit(EFFECTS), "target", 200, calibration=str(cal))


def psnr(video: np.ndarray, segment: Any) -> float:
    trusted = segment.geometry.trusted_frames(1)
    fine = build_scene(lit(), N, 1e-5).frames(0, segment.geometry.span)
    truth = fine.reshape(len(fine), M, 3, M, 3).mean((2, 4))[trusted]
    return float(10 * np.log10(truth.max() ** 2 / np.mean((video[trusted] - truth) ** 2)))


def test_the_copy_is_what_was_measured(cal: Path, run: Path) -> None:
    carried = Calibration.from_attrs(open_recording(run).attrs["calibration"])
    known = open_calibration(cal)
    for name, measured in known.quantities.items():
        np.testing.assert_allclose(carried.quantities[name].value, measured.value, rtol=1e-5)
    assert carried.alignment == known.alignment
    assert carried.steps.keys() == known.steps.keys()


def test_calibrated_lines_restore_the_picture(cal: Path, run: Path, tmp_path: Path) -> None:
    """Compared with the same scene with noise only; any other error multiplies the misfit."""
    segment = open_recording(run).cut(0, 200)
    noisy = open_recording(record(tmp_path / "noise.zarr", lit(NOISE), "target", 200)).cut(0, 200)
    known = open_calibration(cal)
    found = {
        name: reconstruct(each, 3, 1, iterations=40)
        for name, each in {
            "raw": replace(segment, balanced=True),
            "by its own lines": segment,
            "columns": calibrated(segment, Calibration(known.instrument, known.quantities, known.usable)),
            "all": calibrated(segment, known),
            "noise": noisy,
        }.items()
    }
    quality = {name: psnr(result.video, segment) for name, result in found.items()}
    assert quality["all"] > quality["columns"] + 1 > quality["raw"] + 1
    # Without any correction the lamps are no few patterns, but still repeat.
    assert quality["by its own lines"] > quality["raw"] + 0.3
    # What the calibration's own noise costs shows in a picture this good: 48 dB, and 53 with noise only.
    assert quality["all"] > max(45, quality["noise"] - 7)
    assert found["all"].quality.misfit < 0.5 * found["columns"].quality.misfit


def test_the_curve_of_a_non_linear_camera_restores_the_picture(tmp_path: Path) -> None:
    """For a bow of 3 % of white it gains 8 dB or more, nearly to the limit of the noise."""
    effects = [*NOISE, {"kind": "adc_nonlinearity", "bow": 0.03}]
    bright = {"cameras.a.responsivity_dn": 16.0, "cameras.b.responsivity_dn": 16.0}
    first = dark(open_exposure(record(tmp_path / "dark.zarr", white(0.37, effects), "dark", 256, **bright)))
    known = Calibration(first.instrument).with_step(first)
    ramp = []
    for k in (1, 3, 5, 7, 9, 11, 13, 15, 14, 12, 10, 8, 6, 4, 2):
        pulsed = bright | {"trigger.light.close_ticks": round(900 * k / 16)}
        level = record(tmp_path / f"{k}.zarr", white(0.37, effects), "flat", 256, **pulsed)
        ramp.append(open_exposure(level))
    known = known.with_step(linearity(ramp, known))
    runs = {
        name: record(tmp_path / f"{name}.zarr", lit(listed), "target", 200, **bright)
        for name, listed in (("bent", effects), ("noisy", NOISE))
    }
    bent, noisy = (replace(open_recording(each).cut(0, 200), balanced=True) for each in runs.values())
    cases = {"bent": bent, "straight": calibrated(bent, known), "noise": noisy}
    quality = {name: psnr(reconstruct(each, 3, 1, iterations=80).video, each) for name, each in cases.items()}
    assert quality["straight"] > quality["bent"] + 6
    assert quality["straight"] > quality["noise"] - 5  # at 51 dB, an error of the curve of 0.2 % is visible


def test_another_instruments_calibration_is_not_copied(cal: Path, tmp_path: Path) -> None:
    other = {"cameras.a.serial": "ELSEWHERE", "calibration": str(cal)}
    with pytest.raises(ConfigError, match="serial is ELSEWHERE instead of SIM-A"):
        record(tmp_path / "new.zarr", lit(), "target", 60, **other)
    (tmp_path / "file.zarr").write_text("no calibration")
    with pytest.raises(ConfigError, match=r"calibration: .*file.zarr"):
        record(tmp_path / "new.zarr", lit(), "target", 60, calibration=str(tmp_path / "file.zarr"))
    assert not (tmp_path / "new.zarr").exists()


def test_a_calibration_still_to_be_made_is_recorded_as_missing(tmp_path: Path) -> None:
    place = tmp_path / "later.zarr"
    record(tmp_path / "new.zarr", lit(), "target", 60, calibration=str(place))
    attrs = open_recording(tmp_path / "new.zarr").attrs
    assert (attrs["calibration_missing"], "calibration" in attrs) == (str(place), False)


def test_a_path_in_a_rig_file_is_relative_to_it(cal: Path) -> None:
    text = (Path(__file__).parents[2] / "configs" / "rig-demo.toml").read_text()
    (cal.parent / "rig.toml").write_text('calibration = "cal.zarr"\n' + text)
    assert load_rig(cal.parent / "rig.toml").calibration == cal.resolve()
