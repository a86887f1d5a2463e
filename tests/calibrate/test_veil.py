"""The lens's veil from black parts of a target: measured, refused or doubted, and in the model if clear."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from instruments import NOISE, record
from test_psf import RIG, SIZE, board

from acquire.calibrate import Calibration, Measured, calibrated
from acquire.calibrate.columns import dark
from acquire.calibrate.exposure import open_exposure
from acquire.calibrate.veil import veil, veil_of_black
from acquire.calibrate.words import known_facts
from acquire.errors import UsageError
from acquire.forward import DualArm
from acquire.sim.media import VideoSceneConfig
from acquire.store import open_recording

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.lines import Segment

VEILS = [pytest.param(each, id=f"{each:.0%}") for each in (0.0, 0.01, 0.04)]


def taken(path: Path, picture: Any, *effects: Any, lines: int = 2048, kind: str = "target") -> Path:
    np.save(path.parent / "picture.npy", picture[None])
    table = {"kind": "video", "path": path.parent / "picture.npy", "system_gain_dn_per_e": 0.1}
    scene = VideoSceneConfig.model_validate(table | {"effects": [*NOISE, *effects]})
    return record(path, scene, kind, lines, **RIG)


def stray(share: float) -> dict[str, Any]:
    return {"kind": "stray_light", "veil": share}


def measured(path: Path) -> Any:
    exposure = open_exposure(path)
    return veil(exposure, Calibration(exposure.instrument))


@pytest.mark.parametrize("share", VEILS)
def test_the_veil_is_measured(tmp_path: Path, share: float) -> None:
    """With noise, blur and lamps that go out late, to the uncertainty that is stated."""
    found = measured(
        taken(
            tmp_path / "black.zarr",
            board(11.0),
            stray(share),
            {"kind": "psf", "sigma_pixels": 0.6},
            {"kind": "led_rise_fall", "rise_s": 60e-9, "fall_s": 90e-9},
        )
    )
    result = found.quantities["veil"]
    assert (result.uncertainty < 0.003).all()
    assert (np.abs(result.value - share) < 3 * result.uncertainty).all()


def test_a_dark_makes_offsets_no_veil(tmp_path: Path) -> None:
    """Dark current of 4 DN is 0.2 % of the light here."""
    current = {"kind": "dark_current", "electrons_per_s": 1e5}
    edges = open_exposure(taken(tmp_path / "black.zarr", board(11.0), stray(0.02), current))
    first = dark(open_exposure(taken(tmp_path / "dark.zarr", board(11.0), current, kind="dark")))
    without = Calibration(edges.instrument)
    with pytest.raises(UsageError, match="has a constant code, which does not distinguish the rows"):
        veil(open_exposure(tmp_path / "dark.zarr"), without)
    assert "no dark was measured" in " ".join(veil(edges, without).warnings)
    found = veil(edges, without.with_step(first))
    assert not found.warnings
    assert found.quantities["veil"].value == pytest.approx([0.02, 0.02], abs=0.004)


def test_dark_parts_that_are_grey_are_doubted_or_refused(tmp_path: Path) -> None:
    ink = open_exposure(taken(tmp_path / "grey.zarr", 0.04 + 0.96 * board(11.0)))
    nothing = Calibration(ink.instrument)
    assert "are the target's dark parts black?" in " ".join(veil(ink, nothing).warnings)
    with pytest.raises(UsageError, match="more than lenses spread, and so they are not black"):
        veil_of_black(ink, nothing)
    with pytest.raises(UsageError, match=r"its darkest parts have \d+% of the mean light"):
        measured(taken(tmp_path / "even.zarr", np.full((SIZE, SIZE), 0.5, np.float32)))


def test_too_little_light_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="the veil of arm a cannot be measured"):
        measured(taken(tmp_path / "dim.zarr", 1e-3 * board(11.0)))


def test_what_every_fourth_column_lacks_is_no_black(tmp_path: Path) -> None:
    """Columns without samples are left out of the image, instead of being its darkest part."""
    exposure = open_exposure(taken(tmp_path / "black.zarr", board(11.0), stray(0.03)))
    usable = np.ones((2, 64), np.bool_)
    usable[:, ::4] = False
    result = veil(exposure, replace(Calibration(exposure.instrument), usable=usable)).quantities["veil"]
    assert (np.abs(result.value - 0.03) < 3 * result.uncertainty).all()


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> tuple[Calibration, Segment]:
    path = taken(tmp_path_factory.mktemp("known") / "black.zarr", board(11.0), lines=64)
    found = Measured(np.array([0.01, 0.03]), np.full(2, 0.002))
    segment = open_recording(path).cut(0, 64)
    return replace(Calibration(open_exposure(path).instrument), quantities={"veil": found}), segment


def test_it_is_in_the_model_if_it_is_clear(known: tuple[Calibration, Segment]) -> None:
    calibration, segment = known
    corrected = calibrated(segment, calibration)
    assert corrected.blur is not None
    assert corrected.blur.veil == (0.01, 0.03)
    turned = calibrated(segment, replace(calibration, orientation="turn 270"))
    assert turned.blur is not None
    assert turned.blur.veil == (0.03, 0.01)  # the veil is the camera's
    unclear = Measured(np.array([0.01, 0.03]), np.full(2, 0.02))
    assert calibrated(segment, replace(calibration, quantities={"veil": unclear})).blur is None
    assert known_facts(calibration)["the lens's veil"] == "a 1 % ± 0.2, b 3 % ± 0.2"


def test_the_model_is_the_simulation(known: tuple[Calibration, Segment], tmp_path: Path) -> None:
    """Lines of a scene at rest, without noise, are those of the model with the same veil."""
    picture = board(11.0)
    np.save(tmp_path / "picture.npy", picture[None])
    table = {"kind": "video", "path": tmp_path / "picture.npy", "effects": [stray(0.2)]}
    path = record(tmp_path / "veiled.zarr", VideoSceneConfig.model_validate(table), "target", 64, **RIG)
    segment = open_recording(path).cut(0, 64)
    share = Measured(np.full(2, 0.2), np.full(2, 0.001))
    corrected = calibrated(segment, replace(known[0], quantities={"veil": share}))
    model = DualArm(segment.geometry, segment.code, 1, segment.geometry.span, blur=corrected.blur)
    lines = model.forward(np.asarray(picture[None], np.float32))
    np.testing.assert_allclose(corrected.samples(), lines, atol=0.6 / 3)  # rounding to whole DN
