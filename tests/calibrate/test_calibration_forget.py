"""Steps that are forgotten: nothing of them stays, nothing else changes, and what needs them goes too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquire.calibrate import Calibration, Measured, save_calibration
from acquire.calibrate.calibration import KNOTS, QUANTITIES, TERMS, Finding, Instrument
from acquire.calibrate.exposure import open_exposure
from acquire.calibrate.file import change_calibration
from acquire.calibrate.forget import without
from acquire.calibrate.target import alignment, orientation
from acquire.errors import PlaceError, UsageError

CAMERA = {"white_dn": 4095}
INSTRUMENT = Instrument(
    stages=4, substeps=3, substep_s=1e-5, layout="dual", cameras={"a": CAMERA, "b": CAMERA}
)
SIZES = {"arm": 2, "column": 4, "knot": KNOTS, "axis": 2, "term": TERMS}


def done(step: str, *names: str, value: float = 1.0, **facts: Any) -> Finding:
    shapes = {name: tuple(SIZES[each] for each in QUANTITIES[name].dimensions) for name in names}
    found = {name: Measured(np.full(shape, value), np.zeros(shape)) for name, shape in shapes.items()}
    return Finding(step, INSTRUMENT, found, facts=facts, warnings=(f"{step} was hasty",))


DARK = done("dark", "offset_dn", "noise_dn")
FLAT = done("flat", "gain", "balance")
LINEARITY = done("linearity", "linearity_error", "excess_dn")
TRANSFER = done("transfer", "dn_per_electron", "read_noise_e")
VEIL = done("veil", "veil")
PSF = done("psf", "blur_px")
LENS = done("align", "shading", "gain", value=2.0, corrected=["gain", "the lens's light"])


def after(*findings: Finding) -> Calibration:
    known = Calibration(INSTRUMENT)
    for hour, found in enumerate(findings):
        known = known.with_step(found)
        dated = {**known.steps[found.step], "made": f"2026-01-31T{hour:02}:00:00+00:00"}
        known = replace(known, steps={**known.steps, found.step: dated})
    return known


def files(path: Path) -> dict[str, bytes]:
    return {str(each.relative_to(path)): each.read_bytes() for each in path.rglob("*") if each.is_file()}


def test_a_forgotten_step_leaves_the_rest_byte_for_byte(
    tmp_path: Path, recordings: dict[str, Path], known: Calibration
) -> None:
    target, path = open_exposure(recordings["target"]), tmp_path / "cal.zarr"
    turned = known.with_step(orientation(target, known))
    save_calibration(path, turned.with_step(alignment(target, turned)))
    before = files(path)
    wrong = Measured(np.full(2, 0.04), np.full(2, 0.001))
    dead = np.ones((2, known.instrument.columns), np.bool_)
    dead[0, 5] = False
    found = Finding("veil", known.instrument, {"veil": wrong}, dead, warnings=("a veil of 4 %",))
    change_calibration(path, lambda now: now.with_step(found))
    assert "veil/zarr.json" in files(path)
    change_calibration(path, lambda now: without(now, ["veil"], "cal.zarr"))
    assert files(path) == before


def test_what_a_step_has_found_goes_with_it(recordings: dict[str, Path], known: Calibration) -> None:
    target = open_exposure(recordings["target"])
    turned = known.with_step(orientation(target, known))
    aligned = turned.with_step(alignment(target, turned))
    assert aligned.alignment is not None
    # in this one the target has corrected the flat
    assert "balance" in aligned.steps["align"]["corrected"]
    left = without(aligned, ["align", "flat", "orientation"], "cal.zarr")
    assert list(left.steps) == ["dark"]
    assert set(left.quantities) == {"offset_dn", "noise_dn"}
    assert (left.alignment, left.orientation, left.tiles) == (None, None, ())
    assert left.usable is not None
    assert (
        left.usable.tolist() == Calibration(known.instrument).with_step(known.finding("dark")).usable.tolist()
    )


@pytest.mark.parametrize(
    ("findings", "steps", "gone", "why"),
    [
        ([DARK, FLAT, PSF], ["dark"], "dark flat", "flat was measured with the offsets of dark"),
        ([DARK, VEIL, PSF], ["dark"], "dark veil", "veil was measured with the offsets of dark"),
        ([DARK, LINEARITY, TRANSFER], ["linearity"], "linearity transfer", "with the curve of linearity"),
        ([DARK, FLAT, LENS], ["flat"], "flat align", "align has measured gain and the lens's light with"),
        ([DARK, FLAT, LENS], ["align"], "flat align", "align has replaced gain of flat by its own"),
        ([DARK, FLAT, LENS, PSF], ["dark"], "dark flat align", "with the gains of flat"),
    ],
)
def test_a_step_that_others_need_is_refused_with_their_names(
    findings: list[Finding], steps: list[str], gone: str, why: str
) -> None:
    known = after(*findings)
    with pytest.raises(UsageError, match=why) as refused:
        without(known, steps, "cal.zarr")
    assert refused.value.possible == f"acquire calibrate forget {gone} --out cal.zarr"
    left = without(known, gone.split(), "cal.zarr")
    assert set(left.steps) == set(known.steps) - set(gone.split())
    assert "shading" not in left.quantities or "align" in left.steps


@pytest.mark.parametrize(
    ("findings", "step", "left"),
    [
        ([VEIL, DARK], "dark", {"veil"}),
        ([DARK, FLAT, LINEARITY], "linearity", {"offset_dn", "noise_dn", "gain", "balance"}),
        (
            [DARK, done("linearity", "linearity_error"), FLAT],
            "linearity",
            {"offset_dn", "noise_dn", "gain", "balance"},
        ),
        ([LENS, DARK, FLAT], "align", {"offset_dn", "noise_dn", "gain", "balance"}),
        ([DARK, done("align", "balance", corrected=["balance"])], "align", {"offset_dn", "noise_dn"}),
    ],
    ids=[
        "a veil before its dark",
        "a flat before the curve",
        "no curve",
        "another flat",
        "a balance without flat",
    ],
)
def test_a_step_that_none_has_used_goes_alone(findings: list[Finding], step: str, left: set[str]) -> None:
    assert set(without(after(*findings), [step], "cal.zarr").quantities) == left


def test_an_absent_step_and_the_last_one_are_refused(tmp_path: Path) -> None:
    known = after(DARK, FLAT)
    with pytest.raises(UsageError, match="has no step 'veil'") as refused:
        without(known, ["veil"], "cal.zarr")
    assert refused.value.possible == "dark, flat"
    with pytest.raises(UsageError, match=r"nothing would be left of cal\.zarr: flat was") as refused:
        without(known, ["dark"], "cal.zarr")
    assert refused.value.hint == "measure it again, which replaces it; or rm -r cal.zarr"
    with pytest.raises(PlaceError, match="does not exist"):
        change_calibration(tmp_path / "none.zarr", lambda now: without(now, ["veil"], "none.zarr"))
