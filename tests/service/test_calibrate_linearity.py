"""``acquire calibrate linearity`` on a running daemon: the ramp, the saved result, another evaluation."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from live_daemon import Daemon

from acquire.calibrate import open_calibration
from acquire.calibrate.exposure import open_exposure
from acquire.calibrate.linearity import lit_ticks

SCENE = """
kind = "leds"
[[leds]]
name = "all"
shape = "square"
row = 0.5
column = 0.5
size = 1.0
drive = { waveform = "constant", level = 1.0 }
[[effects]]
kind = "shot_noise"
[[effects]]
kind = "read_noise"
sigma_e = 20.0
[[effects]]
kind = "adc_nonlinearity"
bow = 0.02
"""
SETTINGS = ("trigger.substep_ticks=900", *(f"cameras.{arm}.black_level_dn=20.0" for arm in "ab"))


def test_a_ramp_determines_the_curve_and_the_gain(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    bright = [f"cameras.{arm}.responsivity_dn=160.0" for arm in "ab"]  # whole sub-steps are at 1.25 of white
    daemon = Daemon(tmp_path, *SETTINGS, *bright, f"simulation.scene='{tmp_path}/scene.toml'")
    try:
        refused = daemon("calibrate", "linearity", "--yes", "--out", "cal.zarr")
        assert refused.code != 0
        assert "cal.zarr does not exist" in refused.err
        dark = daemon("calibrate", "all", "--only", "dark", "--yes", "--lines", 256, "--out", "cal.zarr")
        assert dark.code == 0, dark.err
        done = daemon("calibrate", "linearity", "--yes", "--lines", 256, "--out", "cal.zarr")
        assert done.code == 0, done.err
        assert "linearity error" in done.out
        assert "off the straight line by" in done.out
        known = open_calibration(tmp_path / "cal.zarr")
        assert list(known.steps) == ["dark", "linearity", "transfer"]
        assert known.steps["linearity"]["reached"] == pytest.approx([0.97, 0.97], abs=0.05)
        assert known.quantities["linearity_error"].value == pytest.approx([0.0075, 0.0075], rel=0.2)
        with daemon.client() as client:
            assert client.status().state == "idle"
        taken = sorted(
            (tmp_path / "calibration-recordings").glob("ramp-*.zarr"), key=lambda at: int(at.stem[5:])
        )
        ticks = [lit_ticks(open_exposure(each))[0] for each in taken]
        assert ticks[:2] == [900, 56]
        assert len(set(ticks)) == len(ticks) == 16
        assert max(ticks[2:]) < 800
        places = [f"calibration-recordings/{path.name}" for path in taken]
        again = json.loads(daemon("calibrate", "linearity", *places, "--out", "cal.zarr", "--json").out)
        values = known.quantities["linearity_error"].value.tolist()
        assert again["steps"]["linearity"]["linearity_error"]["value"] == pytest.approx(values)
        flat = daemon("calibrate", "all", "--only", "flat", "--yes", "--lines", 256, "--out", "cal.zarr")
        assert flat.code == 2
        assert "saturated" in flat.err
    finally:
        daemon.close()
