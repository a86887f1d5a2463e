"""A lens that dims the edges, from its calibration to what is said of it: show, check, explain, videos."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from instruments import COLUMNS, NOISE, dots, record, white

from acquire.calibrate import Calibration, Finding, calibrated, open_calibration, save_calibration
from acquire.calibrate.apply import belongs_to_flat
from acquire.calibrate.check import check
from acquire.calibrate.choose import corrected
from acquire.calibrate.columns import dark, flat
from acquire.calibrate.exposure import open_exposure
from acquire.calibrate.target import alignment
from acquire.calibrate.words import found_facts, known_facts
from acquire.errors import DataError
from acquire.reconstruct.explain import _without
from acquire.store import open_recording

EFFECTS = (
    *NOISE,
    *COLUMNS,
    {"kind": "misregistration", "rows": 0.3, "columns": -0.3, "turn_deg": 0.2, "beyond": "edge"},
    {"kind": "vignetting", "loss": 0.3},
)
LENS = "the lens's light"


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    directory = tmp_path_factory.mktemp("lens")
    plain = white(effects=EFFECTS)
    scenes = {"dark": plain, "flat": plain, "target": dots(directory, EFFECTS)}
    return {name: record(directory / f"{name}.zarr", scene, name, 1024) for name, scene in scenes.items()}


@pytest.fixture(scope="module")
def lens(taken: dict[str, Path]) -> Calibration:
    first = dark(open_exposure(taken["dark"]))
    known = Calibration(first.instrument).with_step(first)
    known = known.with_step(flat(open_exposure(taken["flat"]), known))
    return known.with_step(alignment(open_exposure(taken["target"]), known))


def test_a_fall_of_the_light_is_named_wherever_corrections_are(lens: Calibration) -> None:
    """`show`, the page, and the provenance of videos named everything but this."""
    assert "in the darkest corner" in known_facts(lens)[LENS]
    assert LENS in corrected(lens)
    assert LENS in corrected(Calibration.from_attrs(lens.to_attrs()))
    again = replace(lens, steps={**lens.steps, "flat": {**lens.steps["flat"], "made": "2020-01-01T00:00"}})
    assert "not used" in known_facts(again)[LENS]
    assert LENS not in corrected(again)


def test_the_darkest_corner_is_that_of_the_lens(lens: Calibration) -> None:
    """A loss of 30 % in the corners of both arms."""
    told = known_facts(lens)[LENS]
    for arm in ("a", "b"):
        percent = float(told.split(f"{arm} ")[1].split("%")[0])
        assert percent == pytest.approx(70, abs=5)


def test_each_part_is_left_out_alone(taken: dict[str, Path], lens: Calibration) -> None:
    """Without its gains, the fall of the light was still divided by them, which made gains look better."""
    parts = dict(_without(lens))
    segment = open_recording(taken["target"]).cut(0, 100)
    for name, shaded in ((LENS, False), ("gains per column", False), ("arm B laid on arm A", True)):
        assert (calibrated(segment, parts[name]).blur is not None) is shaded, name
    assert "gain" in parts[LENS].quantities


def test_a_check_with_the_same_flat_finds_no_change(taken: dict[str, Path], lens: Calibration) -> None:
    """The lens's dark edges were taken for the field's end, which the alignment had not done."""
    found = check(open_exposure(taken["flat"]), lens)
    assert [each.change for each in found.compared] == pytest.approx([0, 0, 0], abs=1e-9)


@pytest.mark.parametrize(("loss", "change"), [(0.1, 0.118), (0.0, 0.176)])
def test_another_fall_of_the_light_is_distinguished_from_gains(
    lens: Calibration, tmp_path: Path, loss: float, change: float
) -> None:
    """By a flat: half of the loss in a corner is at the middle of a side. Gains were said to have changed."""
    effects = [e | {"loss": loss} if e["kind"] == "vignetting" else e for e in EFFECTS]
    found = check(open_exposure(record(tmp_path / "flat.zarr", white(effects=effects), "flat", 1024)), lens)
    by_name = {each.quantity: each for each in found.compared}
    light = by_name["light towards a side, in the flat"]
    assert light.change == pytest.approx(change, abs=0.015)
    assert not light.holds
    assert by_name["gain"].holds


def test_a_lens_of_one_arm_is_seen_in_a_target(lens: Calibration, tmp_path: Path) -> None:
    lens_of_b = {"kind": "vignetting", "loss": 0.5, "arm": "b"}
    effects = [lens_of_b if each["kind"] == "vignetting" else each for each in EFFECTS]
    found = check(open_exposure(record(tmp_path / "t.zarr", dots(tmp_path, effects), "target", 1024)), lens)
    assert "light towards a side, arm against arm" in {e.quantity for e in found.compared if not e.holds}


def test_a_repeated_flat_says_that_the_target_comes_next(taken: dict[str, Path], lens: Calibration) -> None:
    again = flat(open_exposure(taken["flat"]), lens)
    assert "the lens's light" in again.warnings[-1]
    assert "repeat align" in again.warnings[-1]
    assert not belongs_to_flat(replace(lens, steps={**lens.steps, "flat": {"made": "2020-01-01T00:00"}}))
    assert "arm B lies" in found_facts(alignment(open_exposure(taken["target"]), lens.with_step(again)))


def test_what_an_earlier_target_has_corrected_stays_known(
    taken: dict[str, Path], lens: Calibration, tmp_path: Path
) -> None:
    """A second target corrects nothing more: a flat that replaced the corrected one then did so silently."""
    first = lens.steps["align"]["corrected"]
    assert "gain" in first
    again = lens.with_step(alignment(open_exposure(taken["target"]), lens))
    assert set(first) <= set(again.steps["align"]["corrected"])
    assert "repeat align" in flat(open_exposure(taken["flat"]), again).warnings[-1]


def test_a_fall_of_the_light_that_is_not_seen_any_more_is_forgotten(lens: Calibration) -> None:
    """It stayed, with the advice to repeat the step that had just been repeated."""
    plain = lens.with_step(Finding("align", lens.instrument, alignment=lens.alignment))
    assert "shading" not in plain.quantities
    assert LENS not in known_facts(plain)


def test_a_cut_file_names_what_is_damaged(lens: Calibration, tmp_path: Path) -> None:
    """It said that an array was damaged, but not which, nor what to do."""
    save_calibration(tmp_path / "cal.zarr", lens)
    chunk = tmp_path / "cal.zarr" / "gain" / "c" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:40])
    with pytest.raises(DataError, match="gain of the calibration is damaged") as told:
        open_calibration(tmp_path / "cal.zarr")
    assert "measure it again" in told.value.hint


def test_calibrations_from_before_the_lens_are_read(lens: Calibration) -> None:
    attrs = lens.to_attrs()
    del attrs["quantities"]["shading"]
    del attrs["alignment"]["distortion"]
    for key in ("shading_of_flat", "dimmed", "corrected", "fall_off"):
        del attrs["steps"]["align"][key]
    old = Calibration.from_attrs(attrs)
    assert old.alignment is not None
    assert old.alignment.alignment.distortion == 0
    assert LENS not in corrected(old)
    assert LENS not in known_facts(old)
