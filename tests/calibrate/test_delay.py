"""Delays between light and charge: drawn at random, found by sweeps with scenes and noise of all kinds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from instruments import COLUMNS, NOISE, record, white

from acquire.calibrate.calibration import Calibration, Finding
from acquire.calibrate.delay import beyond
from acquire.calibrate.delay_sweep import FIRST_LINES, delay, first_sight, lines_for, point_of, setting_of
from acquire.calibrate.exposure import Exposure, open_exposure
from acquire.errors import UsageError
from acquire.sim.leds import LedSceneConfig

HZ = 90_000_000
TICKS = 120
"""Ticks of a sub-step."""


def uneven(effects: Any) -> LedSceneConfig:
    """Return a field of uneven brightness, at its edges, too."""
    rng = np.random.default_rng(8)
    scene = white(0.3, effects).model_dump(mode="json", exclude_unset=True)
    for k in range(12):
        row, column, size = rng.uniform(0, 1, 3)
        square = {"name": str(k), "shape": "square", "row": row, "column": column, "size": 0.1 + 0.3 * size}
        scene["leds"].append(square | {"drive": {"waveform": "constant", "level": 0.3}})
    return LedSceneConfig.model_validate(scene)


def taken(directory: Path, scene: Any, lines: int, ticks: tuple[int, int, int] = (0, 0, 0)) -> Exposure:
    """Record a scene with light.lead_ticks, a.delay_ticks and b.delay_ticks."""
    keys = ("light.lead_ticks", "a.delay_ticks", "b.delay_ticks")
    changes = {f"trigger.{key}": value for key, value in zip(keys, ticks, strict=True)}
    directory.mkdir(exist_ok=True)
    path = directory / f"{len(list(directory.iterdir()))}.zarr"
    return open_exposure(record(path, scene, "target", lines, **changes, **{"trigger.substep_ticks": TICKS}))


def swept(directory: Path, scene: Any) -> Finding:
    """Make a sweep like the command."""
    first = taken(directory, scene, FIRST_LINES)
    setting, point = setting_of(first), point_of(first)
    lines = lines_for(point, first.lines, setting.substep_ticks)
    settings = setting.sweep(first_sight(point, setting.substep_ticks))
    ticks = [(each.light_lead_ticks, each.a_ticks, each.b_ticks) for each in settings]
    return delay([first, *(taken(directory, scene, lines, each) for each in ticks)])


def late_by(light: float, a: float, b: float) -> dict[str, Any]:
    """Return the effect, with delays in ticks."""
    return {"kind": "delays", "light_s": light / HZ, "a_s": a / HZ, "b_s": b / HZ}


@pytest.mark.parametrize("seed", range(3))
def test_a_sweep_finds_delays_to_a_tick_and_its_settings_correct_them(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    light, a, b = rng.uniform(60, 380), rng.uniform(0, 50), rng.uniform(0, 50)
    optics = ({"kind": "psf", "sigma_pixels": 0.7}, {"kind": "vignetting", "loss": 0.3, "rows": 9.0})
    effects = [*NOISE, *COLUMNS, *optics, late_by(light, a, b)]
    scene = white(0.7, effects, seed=seed) if seed else uneven(effects)
    found = swept(tmp_path, scene)
    late = found.quantities["light_late_ticks"]
    error = late.value - [light - a, light - b]
    assert np.abs(error).max() < 4 * late.uncertainty.max()
    assert late.uncertainty.max() < 1.2
    rig = found.facts["rig"]
    settled = rig["light.lead_ticks"] + np.array([rig["a.delay_ticks"], rig["b.delay_ticks"]])
    assert np.abs(settled - [light - a, light - b]).max() < 0.5 + 4 * late.uncertainty.max()
    ticks = (rig["light.lead_ticks"], rig["a.delay_ticks"], rig["b.delay_ticks"])
    for arm in beyond(taken(tmp_path, scene, 2048, ticks)):
        assert arm.whole == 0
        assert max(abs(arm.before), abs(arm.after)) < 5 * arm.error
    assert "light_late_ticks" in Calibration(found.instrument).with_step(found).quantities


def test_early_light_is_reported_and_no_lead_is_suggested(tmp_path: Path) -> None:
    found = swept(tmp_path, white(0.7, [*NOISE, late_by(0, 70, 30)]))
    late = found.quantities["light_late_ticks"]
    assert late.value == pytest.approx([-70, -30], abs=4 * late.uncertainty.max())
    rig = found.facts["rig"]
    assert (rig["light.lead_ticks"], rig["a.delay_ticks"]) == (0, 0)
    assert rig["b.delay_ticks"] == pytest.approx(40, abs=4)
    assert rig["light.open_ticks"] == pytest.approx(70, abs=4)
    assert any("the light is early" in text for text in found.warnings)


def test_light_too_late_for_the_trigger_is_measured_and_reported(tmp_path: Path) -> None:
    found = swept(tmp_path, white(0.7, [*NOISE, late_by(1234, 20, 0)]))
    late = found.quantities["light_late_ticks"]
    assert late.value == pytest.approx([1214, 1234], abs=4 * late.uncertainty.max())
    rig, whole = found.facts["rig"], found.facts["whole_substeps"]
    assert whole == 8
    assert rig["light.lead_ticks"] + rig["b.delay_ticks"] == pytest.approx(1234 - whole * TICKS, abs=4)
    assert any("8 sub-steps more than the trigger" in text for text in found.warnings)


def test_two_recordings_of_an_interrupted_sweep_are_enough_and_one_is_not(tmp_path: Path) -> None:
    scene = white(0.7, [*NOISE, late_by(300, 0, 0)])
    one, other = (taken(tmp_path, scene, 4096, (200, x, x)) for x in (64, 136))
    late = delay([one, other]).quantities["light_late_ticks"]
    assert late.value == pytest.approx([300, 300], abs=5 * late.uncertainty.max())
    assert late.uncertainty.max() < 10
    with pytest.raises(UsageError, match="arm a: in no two recordings"):
        delay([one])


def test_recordings_without_information_are_refused(tmp_path: Path) -> None:
    small = white(0.7).model_dump(mode="json")
    small["leds"][0]["size"] = 0.4
    small.pop("kind")
    dark_edges = white(0.7, leds=small["leds"])
    with pytest.raises(UsageError, match="dark at the sensor's first or last rows"):
        beyond(taken(tmp_path, dark_edges, 2048))
    wrong = white(0.7, [{"kind": "code_errors", "flip_rate": 0.5}])
    with pytest.raises(UsageError, match="do not follow the light's code"):
        beyond(taken(tmp_path / "wrong", wrong, 2048))
    with pytest.raises(UsageError, match="steady light"):
        beyond(open_exposure(record(tmp_path / "flat.zarr", white(), "flat", 64)))
    with pytest.raises(UsageError, match="complete lines do not show a delay"):
        beyond(taken(tmp_path / "short", white(0.7), 64))
