"""A calibration as data: on disk, in a recording's attributes, refused if it does not fit."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray
from instruments import NOISE, dots, record, white

from acquire.calibrate import Calibration, Measured, calibrated, open_calibration, save_calibration
from acquire.calibrate.apply import check_fits
from acquire.calibrate.calibration import Finding, TileAlignment
from acquire.calibrate.check import check
from acquire.calibrate.columns import dark
from acquire.calibrate.exposure import open_exposure
from acquire.calibrate.target import alignment, orientation
from acquire.errors import DataError, PlaceError, UsageError
from acquire.store import open_recording


@pytest.fixture(scope="module")
def whole(recordings: dict[str, Path], known: Calibration) -> Calibration:
    target = open_exposure(recordings["target"])
    turned = known.with_step(orientation(target, known))
    return turned.with_step(alignment(target, turned))


def same(a: Calibration, b: Calibration, digits: float = 0.0) -> bool:
    values = all(
        np.allclose(a.quantities[name].value, b.quantities[name].value, rtol=0, atol=digits)
        and np.allclose(a.quantities[name].uncertainty, b.quantities[name].uncertainty, rtol=0, atol=digits)
        for name in a.quantities
    )
    return values and set(a.quantities) == set(b.quantities) and a.facts() == b.facts()


def test_it_is_read_as_it_was_written(tmp_path: Path, whole: Calibration) -> None:
    save_calibration(tmp_path / "cal.zarr", whole)
    assert same(open_calibration(tmp_path / "cal.zarr"), whole)
    assert [path.name for path in tmp_path.iterdir()] == ["cal.zarr"]


def test_it_survives_json(whole: Calibration) -> None:
    again = Calibration.from_attrs(json.loads(json.dumps(whole.to_attrs())))
    assert same(again, whole, digits=1e-5)
    assert len(json.dumps(whole.to_attrs())) < 20_000


def test_it_opens_in_xarray(tmp_path: Path, whole: Calibration) -> None:
    save_calibration(tmp_path / "cal.zarr", whole)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opened = xarray.open_zarr(tmp_path / "cal.zarr", consolidated=True)
    assert opened["gain"].dims == ("arm", "column")
    assert opened["offset_dn"].attrs["units"] == "DN"
    np.testing.assert_array_equal(opened["gain"], whole.quantities["gain"].value)
    assert opened.attrs["steps"]["flat"]["lines"] == 512


def test_it_opens_from_a_url(tmp_path: Path, known: Calibration) -> None:
    save_calibration(f"file://{tmp_path}/far/cal.zarr", known)
    assert same(open_calibration(f"file://{tmp_path}/far/cal.zarr"), known)


def test_a_repeated_step_replaces_the_first(
    tmp_path: Path, recordings: dict[str, Path], whole: Calibration
) -> None:
    save_calibration(tmp_path / "cal.zarr", whole)
    again = dark(open_exposure(recordings["dark"], first_line=100, lines=64))
    save_calibration(tmp_path / "cal.zarr", whole.with_step(again))
    found = open_calibration(tmp_path / "cal.zarr")
    assert found.steps["dark"]["lines"] == 64
    assert found.steps["flat"] == whole.steps["flat"]
    assert [path.name for path in tmp_path.iterdir()] == ["cal.zarr"]


def test_a_steps_result_holds_the_tiles_that_it_aligned(whole: Calibration) -> None:
    assert whole.alignment is not None
    tiles = (TileAlignment("left", (0, 4), whole.alignment),)
    facts = {"lines": 64, "tiles": 1, "misfit": 0.01}
    known = replace(whole, alignment=None).with_step(
        Finding("align", whole.instrument, facts=facts, tiles=tiles)
    )
    assert known.finding("align").tiles == tiles
    assert known.finding("orientation").tiles == ()


def test_anything_but_a_calibration_is_neither_read_nor_replaced(
    tmp_path: Path, recordings: dict[str, Path], known: Calibration
) -> None:
    for place in (recordings["dark"], tmp_path, tmp_path / "nothing.zarr"):
        with pytest.raises(PlaceError):
            open_calibration(place)
    with pytest.raises(PlaceError, match="not a calibration"):
        save_calibration(recordings["dark"], known)
    assert open_recording(recordings["dark"]).lines == 512


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("instrument", {}),
        ("steps", 3),
        ("steps", {"dark": {"made": "yesterday"}}),
        ("steps", {"dark": {"made": "2026-01-31T12:00:00"}}),
        ("steps", {"dark": {"made": 20260131}}),
        ("alignment", {"rows": "much"}),
        ("usable", [[True]]),
        ("usable", "x"),
    ],
)
def test_damage_is_reported(tmp_path: Path, whole: Calibration, key: str, value: object) -> None:
    save_calibration(tmp_path / "cal.zarr", whole)
    root = tmp_path / "cal.zarr" / "zarr.json"
    document = json.loads(root.read_text())
    document["attributes"][key] = value
    root.write_text(json.dumps(document))
    with pytest.raises(DataError, match="damaged"):
        open_calibration(tmp_path / "cal.zarr")


def test_a_truncated_array_is_reported(tmp_path: Path, whole: Calibration) -> None:
    save_calibration(tmp_path / "cal.zarr", whole)
    (chunk,) = [path for path in (tmp_path / "cal.zarr" / "gain").rglob("*") if path.name == "0"][-1:]
    chunk.write_bytes(chunk.read_bytes()[:7])
    with pytest.raises(DataError, match="of the calibration is damaged"):
        open_calibration(tmp_path / "cal.zarr")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"cameras.b.serial": "OTHER"}, "serial is OTHER instead of SIM-B"),
        (
            {"cameras.a.pixel_format": "Mono10", "cameras.b.pixel_format": "Mono10"},
            "PixelFormat is Mono10 instead of Mono12",
        ),
        ({"geometry.stages": 12}, "stages M is 12 instead of 24"),
        ({"geometry.substeps": 2}, "sub-steps S is 2 instead of 3"),
        ({"cameras.a.responsivity_dn": 4.0}, "responsivity_dn is 4.0 instead of 8.0"),
    ],
)
def test_another_instruments_calibration_is_refused(
    tmp_path: Path, known: Calibration, changes: dict[str, object], said: str
) -> None:
    path = record(tmp_path / "run.zarr", white(0.0), "target", 32, **changes)
    with pytest.raises(UsageError, match=said):
        check_fits(known, open_recording(path))
    with pytest.raises(UsageError, match="another instrument"):
        Calibration(known.instrument).with_step(dark(open_exposure(path), covered=True))


def test_age_and_speed_are_reported(tmp_path: Path, known: Calibration) -> None:
    path = record(tmp_path / "run.zarr", white(0.2), "target", 32, **{"trigger.substep_ticks": 1800})
    old = {name: {**step, "made": "2001-01-01T00:00:00+00:00"} for name, step in known.steps.items()}
    (slow, aged) = check_fits(replace(known, steps=old), open_recording(path))
    assert "dark current" in slow
    assert "days apart" in aged
    assert check_fits(known, open_recording(record(tmp_path / "b.zarr", white(0.2), "target", 32))) == ()


def test_unmeasured_quantities_are_not_corrected(recordings: dict[str, Path], known: Calibration) -> None:
    segment = open_recording(recordings["target"]).cut(0, 80)
    untouched = calibrated(segment, Calibration(known.instrument))
    assert untouched.black_level_dn == segment.black_level_dn
    assert untouched.responsivity_dn == segment.responsivity_dn
    assert untouched.alignment is None
    assert untouched.mask is segment.mask
    only_dark = Calibration(known.instrument, {"offset_dn": known.quantities["offset_dn"]})
    assert calibrated(segment, only_dark).responsivity_dn == segment.responsivity_dn
    np.testing.assert_array_equal(
        calibrated(segment, only_dark).black_level_dn, known.quantities["offset_dn"].value
    )


def test_lines_are_those_of_an_ideal_camera(recordings: dict[str, Path], known: Calibration) -> None:
    """In a corrected flat every column of each arm shows the same light."""
    segment = open_recording(recordings["flat"]).cut(0, 512)
    plain, corrected = segment.samples(np.float64), calibrated(segment, known).samples(np.float64)
    inner = slice(2, -2)
    assert plain[..., inner].mean(axis=1).std() / plain.mean() > 0.05
    assert corrected[..., inner].mean(axis=1).std() / corrected.mean() < 1e-3


def test_quantities_are_finite_and_of_the_instruments_size(known: Calibration) -> None:
    for name, values in (
        ("gain", np.ones((2, 5))),
        ("balance", np.array([1.0, np.nan])),
        ("taste", np.ones(2)),
    ):
        with pytest.raises(UsageError, match=name):
            Calibration(known.instrument, {name: Measured(values, np.zeros_like(values))})
    with pytest.raises(UsageError, match="uncertainties"):
        Measured(np.ones(2), np.ones(3))


@pytest.mark.parametrize("name", ["gain", "balance"])
def test_what_lines_are_divided_by_is_above_zero(known: Calibration, name: str) -> None:
    """A gain of 0 ended the reconstruction with a screen of numbers, and no word of the calibration."""
    values = known.quantities[name].value.copy()
    values.flat[1] = 0.0
    measured = Measured(values, known.quantities[name].uncertainty)
    with pytest.raises(UsageError, match=f"{name} of the calibration is not above 0"):
        replace(known, quantities={**known.quantities, name: measured})


@pytest.mark.parametrize("name", ["offset_dn", "gain_uncertainty"])
def test_values_that_are_lost_on_the_disk_are_not_zeros(
    tmp_path: Path, known: Calibration, name: str
) -> None:
    """Zarr fills in for a chunk that is missing: offsets were 0 DN, without a word."""
    save_calibration(tmp_path / "cal.zarr", known)
    (tmp_path / "cal.zarr" / name / "c" / "0" / "0").unlink()
    with pytest.raises(DataError, match=r"offset_dn of shape|uncertainties of gain"):
        open_calibration(tmp_path / "cal.zarr")


def test_a_flipped_bit_is_noticed(tmp_path: Path, known: Calibration) -> None:
    save_calibration(tmp_path / "cal.zarr", known)
    chunk = tmp_path / "cal.zarr" / "gain" / "c" / "0" / "0"
    values = bytearray(chunk.read_bytes())
    values[len(values) // 2] ^= 4
    chunk.write_bytes(bytes(values))
    with pytest.raises(DataError, match="gain of the calibration is damaged"):
        open_calibration(tmp_path / "cal.zarr")


def test_a_step_without_its_values_is_damaged(known: Calibration) -> None:
    """A deleted array left the flat's step without gains, and lines uncorrected without a word."""
    attrs = known.to_attrs()
    del attrs["quantities"]["gain"]
    with pytest.raises(DataError, match="gain, which its step flat measured, is missing"):
        Calibration.from_attrs(attrs)


def test_a_true_calibration_holds(recordings: dict[str, Path], whole: Calibration) -> None:
    for recording in recordings.values():
        found = check(open_exposure(recording), whole)
        assert found.holds
        assert found.compared


def test_changes_are_reported(tmp_path: Path, recordings: dict[str, Path], whole: Calibration) -> None:
    warm = [*NOISE, {"kind": "column_offsets", "sigma_dn": 4.0, "channels": 6}]
    moved = [*NOISE, {"kind": "misregistration", "rows": 2.5, "columns": -1.0, "turn_deg": 0.5}]
    halved = {"kind": "beam_splitter", "part_a": 0.5}
    cases = {
        "dark": (white(effects=warm), "offset_dn"),
        "flat": (white(effects=[*NOISE, halved]), "arm A's part of the light"),
        "target": (dots(tmp_path, moved), "rows"),
    }
    for light, (scene, quantity) in cases.items():
        found = check(open_exposure(record(tmp_path / f"{light}.zarr", scene, light)), whole)
        assert not found.holds
        assert quantity in {each.quantity for each in found.compared if not each.holds}


def test_a_certain_small_change_does_not_hide_a_large_one(
    monkeypatch: pytest.MonkeyPatch, recordings: dict[str, Path], whole: Calibration
) -> None:
    """Columns differ in their uncertainty: one that is beyond doubt need not be the one that matters."""
    before = whole.quantities["offset_dn"]
    value, uncertainty = before.value.copy(), np.zeros_like(before.value)
    value[0, 3] += 0.45
    value[1, 5] += 0.6
    uncertainty[1, 5] = 0.1
    exact = replace(
        whole, quantities={**whole.quantities, "offset_dn": Measured(before.value, np.zeros_like(value))}
    )
    exposure = open_exposure(recordings["dark"])
    now = Finding("dark", whole.instrument, {"offset_dn": Measured(value, uncertainty)})
    monkeypatch.setattr("acquire.calibrate.check.dark", lambda *_, **__: now)
    found = check(exposure, exact)
    assert not found.holds
    assert found.compared[0].change == pytest.approx(0.6)


def test_a_turned_camera_is_reported(tmp_path: Path, whole: Calibration) -> None:
    scene = dots(tmp_path, NOISE, optics={"b": {"turn_deg": 270}})
    found = check(open_exposure(record(tmp_path / "run.zarr", scene, "target", 256)), whole)
    assert not found.holds
    assert "'turn 270'" in found.doubts[0]
