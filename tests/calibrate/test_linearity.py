"""A ramp of light made by the trigger's ticks: non-linear cameras, fluctuating lamps, slow edges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from instruments import COLUMNS, NOISE, record, white

from acquire.calibrate import Calibration, calibrated
from acquire.calibrate.columns import dark
from acquire.calibrate.curve import curve_of
from acquire.calibrate.exposure import Exposure, open_exposure
from acquire.calibrate.linearity import linearity, lit_ticks
from acquire.calibrate.transfer import transfer
from acquire.converter import ConverterCurve
from acquire.errors import UsageError
from acquire.store import open_recording

BLACK, WHITE = 20.0, 4095.0
TICKS = 900
LEVEL = 0.75
"""Level at which 15/16 of the light are 89 % of white."""
ORDER = (1, 3, 5, 7, 9, 11, 13, 15, 14, 12, 10, 8, 6, 4, 2)


def before(directory: Path, effects: Any) -> Calibration:
    first = dark(open_exposure(record(directory / "dark.zarr", white(LEVEL, effects), "dark", 256)))
    return Calibration(first.instrument).with_step(first)


def ramp(
    directory: Path, effects: Any, longer: float = 0.0, shaky: float = 0.0, level: float = LEVEL
) -> list[Exposure]:
    """Record light for k/16 of a sub-step, ``longer`` by its edges (ticks), from a lamp that is ``shaky``."""
    rng = np.random.default_rng(5)
    found = []
    for k in ORDER:
        ticks = round(TICKS * k / 16)
        lamp = level * (1 + shaky * rng.standard_normal()) * (ticks + longer) / ticks
        close = {"trigger.light.close_ticks": ticks}
        found.append(
            open_exposure(record(directory / f"{k}.zarr", white(lamp, effects), "flat", 256, **close))
        )
    return found


def bent(bow: float) -> list[dict[str, Any]]:
    return [*NOISE, *COLUMNS, {"kind": "adc_nonlinearity", "bow": bow}]


def readings(bow: float, light_dn: np.ndarray) -> np.ndarray:
    """Return the excess of a camera that follows the simulator's formula, above black."""
    x = light_dn / (WHITE - BLACK)
    return light_dn + 4 * bow * (WHITE - BLACK) * x * (1 - x)


@pytest.mark.parametrize(
    ("bow", "longer", "shaky", "error_dn"),
    [(0.02, 0.0, 0.0, 0.6), (-0.03, 4.0, 0.0, 1.0), (0.02, -3.0, 1e-3, 12.0)],
)
def test_the_curve_is_that_of_the_camera(
    tmp_path: Path, bow: float, longer: float, shaky: float, error_dn: float
) -> None:
    """82 and 122 DN in the middle, whatever the light's edges add, within the error of a shaky lamp."""
    known = before(tmp_path, bent(bow))
    found = linearity(ramp(tmp_path, bent(bow), longer, shaky), known)
    curve = curve_of(known.with_step(found))
    assert curve is not None
    for arm in range(2):
        top = found.facts["reached"][arm] * (WHITE - BLACK)
        light = np.linspace(0, 1, 50) * np.interp(top, readings(bow, np.arange(4076.0)), np.arange(4076.0))
        seen = np.stack([readings(bow, light) + BLACK] * 2)
        straight = curve.straight(seen)[arm] - BLACK
        error = straight - light * straight[-1] / light[-1]  # of the scale nobody can know
        assert np.abs(error).max() < error_dn
        assert np.abs(error).max() < 5 * found.quantities["excess_dn"].uncertainty[arm].max() + 0.3
    assert found.quantities["linearity_error"].value == pytest.approx([abs(bow) * 0.6] * 2, rel=0.2)
    assert max(found.facts["left_over"]) < 0.0005 + shaky
    assert found.warnings == ()


def test_a_linear_camera_has_no_curve_and_costs_nothing(tmp_path: Path) -> None:
    """Not even under a lamp that fluctuates by 0.3 %, which alone causes the linearity error."""
    effects = [*NOISE, *COLUMNS]
    known = before(tmp_path, effects)
    exposures = ramp(tmp_path, effects, shaky=3e-3)
    found = linearity(exposures, known)
    assert found.facts["powers"] == [0, 0]
    assert not found.quantities["excess_dn"].value.any()
    assert 5e-4 < found.quantities["linearity_error"].value.max() < 6e-3
    whole = known.with_step(found)
    segment = exposures[0].whole()
    assert calibrated(segment, whole).curve is None
    np.testing.assert_array_equal(calibrated(segment, whole).samples(), calibrated(segment, known).samples())


def test_lines_are_those_of_a_linear_camera(tmp_path: Path) -> None:
    """Samples of all levels are in proportion to ticks; likewise electrons, and exchanged arms."""
    known = before(tmp_path, bent(0.03))
    exposures = ramp(tmp_path, bent(0.03))
    whole = known.with_step(linearity(exposures, known))
    levels = {}
    for name, calibration in (("bent", known), ("straight", whole)):
        segments = [calibrated(each.whole(), calibration) for each in exposures]
        lit = [lit_ticks(each)[0] for each in exposures]
        per_part = [s.samples(np.float64).mean() / ticks for s, ticks in zip(segments, lit, strict=True)]
        levels[name] = np.std(per_part) / np.mean(per_part)
    assert levels["bent"] > 0.02
    assert levels["straight"] < 5e-4
    bright = [exposures[ORDER.index(12)]]
    K = [transfer(bright, each).quantities["dn_per_electron"] for each in (known, whole)]
    assert K[0].value.max() < 0.095
    scale = 1 / (1 + 4 * 0.03 * (1 - 0.89))  # right at the ramp's top, where the simulator is not quite
    assert np.abs(K[1].value * scale - 0.1).max() < 4 * K[1].uncertainty.max()
    one = replace(calibrated(exposures[0].whole(), whole), curve=ConverterCurve(*_unequal(curve_of(whole))))
    np.testing.assert_array_equal(one.swapped().samples(), one.samples()[::-1])
    np.testing.assert_array_equal(one.mirrored(1).samples()[1], one.samples()[1, :, ::-1])


def _unequal(curve: ConverterCurve | None) -> tuple[np.ndarray, np.ndarray]:
    assert curve is not None
    return curve.dn, curve.excess_dn * np.array([[1.0], [-0.5]])


def test_the_ramp_ends_where_pixels_are_full(tmp_path: Path) -> None:
    effects = [*NOISE, {"kind": "full_well", "capacity_e": 25_000}]
    known = before(tmp_path, effects)
    exposures = ramp(tmp_path, effects)
    found = linearity(exposures, known)
    assert found.facts["powers"] == [0, 0]
    assert found.facts["levels"][0] < 13
    full = transfer(exposures, known).quantities["full_well_e"]
    assert full.value == pytest.approx([25_000] * 2, rel=0.1)


def test_unsuitable_ramps_are_refused(tmp_path: Path) -> None:
    effects = [*NOISE]
    known = before(tmp_path, effects)
    close = {"trigger.light.close_ticks": 450}
    flat = open_exposure(record(tmp_path / "flat.zarr", white(LEVEL, effects), "flat", 64, **close))
    coded = open_exposure(record(tmp_path / "coded.zarr", white(LEVEL, effects), "target", 64, **close))
    with pytest.raises(UsageError, match="1 level of light neither dark nor saturated"):
        linearity([flat], known)
    with pytest.raises(UsageError, match="steady light that linearity needs"):
        linearity([flat, coded], known)
    with pytest.raises(UsageError, match="offsets of the columns first"):
        linearity([flat], Calibration(known.instrument))
    knots = np.linspace(0, 4095, 65)[None].repeat(2, 0)
    with pytest.raises(UsageError, match="does not rise"):
        ConverterCurve(knots, 3000 * np.sin(knots / 200))


def test_a_cut_segment_has_the_curve(tmp_path: Path) -> None:
    """The slope is the derivative of the curve."""
    knots = np.linspace(0, 4095, 65)[None].repeat(2, 0)
    curve = ConverterCurve(knots, 80 * np.sin(knots / 1300))
    dn = np.array([[100.0, 2000.0, 4090.0, 5000.0]] * 2)
    small = (curve.straight(dn + 1e-3) - curve.straight(dn - 1e-3)) / 2e-3
    np.testing.assert_allclose(curve.slope(dn), small, atol=1e-6)
    segment = open_recording(record(tmp_path / "run.zarr", white(0.4), "flat", 64)).cut(0, 64)
    bent = replace(segment, curve=curve)
    expected = (curve.straight(segment.lines.astype(float)) - BLACK) / 8.0
    np.testing.assert_allclose(bent.samples(np.float64), expected, rtol=1e-12)
