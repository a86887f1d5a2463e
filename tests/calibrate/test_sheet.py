"""The sheet: a drawing that does not change, and one recording of it that shows everything."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from instruments import COLUMNS, NOISE, record
from PIL import Image

from acquire.calibrate import Calibration
from acquire.calibrate.columns import dark
from acquire.calibrate.exposure import Exposure, open_exposure
from acquire.calibrate.orientation import MODEL
from acquire.calibrate.psf import psf
from acquire.calibrate.sheet import TURNS, Sheet, svg
from acquire.calibrate.target import alignment, orientation
from acquire.calibrate.veil import veil
from acquire.config import builtin_directory
from acquire.errors import UsageError
from acquire.sim.media import VideoSceneConfig

STAGES, S = 64, 3
SIZE = STAGES * S
RIG = {"geometry.stages": STAGES, "cameras.a.responsivity_dn": 6.0, "cameras.b.responsivity_dn": 6.0}
DISPLACED = {"kind": "misregistration", "rows": 4.3, "columns": -2.6, "turn_deg": 0.4, "beyond": "edge"}
UNLIKE = {"kind": "psf", "sigma_pixels": 0.5, "sigma_b_pixels": 1.2}
STRAY = {"kind": "stray_light", "veil": 0.02, "ambient": 0.01}


def taken(
    path: Path, *effects: Any, level: float = 1.0, black: float = 0.0, kind: str = "target"
) -> Exposure:
    """Record the sheet, a little askew, with 1024 lines."""
    picture = black + (1 - black) * Sheet(S).picture(SIZE, (6.5, -11.0), 2.0)
    np.save(path.parent / "sheet.npy", level * picture[None])
    table = {"kind": "video", "path": path.parent / "sheet.npy", "system_gain_dn_per_e": 0.1}
    scene = VideoSceneConfig.model_validate(table | {"effects": [*NOISE, *effects]})
    return open_exposure(record(path, scene, kind, 1024, **RIG))


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> tuple[Exposure, Calibration]:
    """Return a recording of the sheet by an instrument with all effects, and its dark."""
    home = tmp_path_factory.mktemp("sheet")
    effects = (*COLUMNS, DISPLACED, UNLIKE, STRAY, {"kind": "beam_splitter", "part_a": 0.47})
    first = dark(taken(home / "dark.zarr", *effects, kind="dark"))
    return taken(home / "sheet.zarr", *effects), Calibration(first.instrument).with_step(first)


def test_one_recording_shows_orientation_and_alignment(one: tuple[Exposure, Calibration]) -> None:
    exposure, known = one
    assert orientation(exposure, known).orientation == MODEL.name
    found = alignment(exposure, known)
    assert found.alignment is not None
    at = found.alignment.alignment
    assert np.hypot(at.rows - 4.3, at.columns + 2.6) < 0.05
    assert at.turn_deg == pytest.approx(0.4, abs=0.03)
    assert not any("coarse" in each or "moved" in each for each in found.warnings)
    # without a flat, the splitter's halves are compared with each other
    assert "brighter than arm A: the balance is corrected" in " ".join(found.warnings)


def test_a_blurrier_arm_is_not_a_darker_side(one: tuple[Exposure, Calibration]) -> None:
    """Large squares are unlike at their edges, and lenses took 5 % of the light that they did not take."""
    fall = alignment(*one).facts["fall_off"]
    assert np.abs(fall["terms"]).max() < 0.015


def test_it_shows_blur_and_veil_as_well(one: tuple[Exposure, Calibration]) -> None:
    exposure, known = one
    found = psf(exposure, known)
    # arm B's includes what the simulator's interpolation between pixels adds, up to a quarter of a pixel²
    true = np.array([[0.25, 0.25], [1.44, 1.44]])
    more = np.array([[0, 0], [0.25, 0.25]])
    variance, doubt = (np.array(found.facts[f"variance{each}_px2"]) for each in ("", "_uncertainty"))
    assert (variance > true - 3 * doubt).all()
    assert (variance < true + more + 3 * doubt).all()
    assert (doubt < 0.1).all()
    light = veil(exposure, known).quantities["veil"]
    assert (light.uncertainty < 0.004).all()
    assert (np.abs(light.value - 0.02) < 3 * light.uncertainty).all()


def test_black_ink_is_no_veil(tmp_path: Path) -> None:
    """Four per cent of the white are more of the mean, as most of the sheet is black."""
    exposure = taken(tmp_path / "paper.zarr", {"kind": "psf", "sigma_pixels": 0.8}, black=0.04)
    known = Calibration(exposure.instrument)
    np.testing.assert_allclose(psf(exposure, known).quantities["blur_px"].value, 0.8, atol=0.12)
    assert "are the target's dark parts black?" in " ".join(veil(exposure, known).warnings)


def test_too_little_light_is_refused(tmp_path: Path) -> None:
    exposure = taken(tmp_path / "dim.zarr", level=0.03)
    with pytest.raises(UsageError, match=r"blur of the optics of arm a cannot be measured: .* noise, and 10"):
        psf(exposure, Calibration(exposure.instrument))
    with pytest.raises(UsageError, match="the veil of arm a cannot be measured"):
        veil(exposure, Calibration(exposure.instrument))


def test_far_out_of_focus_is_reported(tmp_path: Path) -> None:
    """A blur that a window does not hold is refused, never reported as a smaller one."""
    exposure = taken(tmp_path / "unsharp.zarr", {"kind": "psf", "sigma_pixels": 6.0})
    known = Calibration(exposure.instrument)
    assert any("coarse, or out of focus" in each for each in alignment(exposure, known).warnings)
    with pytest.raises(UsageError, match="blur of the optics of arm a cannot be measured"):
        psf(exposure, known)


@pytest.mark.parametrize("substeps", [1, 2, 3, 5])
def test_the_drawing_is_the_same_for_every_size(substeps: int) -> None:
    """A sheet that was printed years ago is still the one that is drawn."""
    small, large = (Sheet(substeps).picture(size) for size in (64 * substeps, 96 * substeps))
    inside = slice(16 * substeps, 80 * substeps)
    np.testing.assert_array_equal(small, large[inside, inside])
    assert 0.28 < small.mean() < 0.42


def test_the_practice_scene_s_picture_is_what_the_command_draws() -> None:
    with Image.open(builtin_directory() / "target.png") as file:
        drawn = np.asarray(file, np.float64) / 255
    finer = len(drawn) // SIZE
    means = drawn.reshape(SIZE, finer, SIZE, finer).mean(axis=(1, 3))
    np.testing.assert_allclose(means, Sheet(S).picture(SIZE), atol=1e-6)


def test_a_turned_and_shifted_sheet_is_where_it_should_be() -> None:
    square = Sheet(S).tile(0, 0).squares[0]
    y, x = square.row - SIZE / 2, square.column - SIZE / 2
    picture = Sheet(S).picture(SIZE, (5.0, -8.0), 90.0)
    # a quarter turn counter-clockwise takes right to up
    row, column = -x + 5.0 + SIZE / 2, y - 8.0 + SIZE / 2
    assert picture[int(row) - 8 : int(row) + 8, int(column) - 8 : int(column) + 8].min() == 1


def test_the_file_to_print_is_the_same_drawing() -> None:
    text = svg(S, STAGES, 60.0)
    width, edge, wide = (
        float(each) for each in re.search(r'width="([\d.]+)mm".*viewBox="(\S+) \S+ (\S+)', text).groups()
    )
    assert width / wide == pytest.approx(60.0 / SIZE)
    assert -edge == wide / 2 > SIZE / 2
    assert f'd="M-96 {wide / 2 + SIZE * 0.015:g}h192"' in text
    rng, sheet = np.random.default_rng(1), Sheet(S)
    dots = [tuple(map(float, each)) for each in re.findall(r"M(\S+) (\S+)h(\d+)v\d+h-\d+z", text)]
    for x, y, side in (dots[i] for i in rng.integers(len(dots), size=50)):
        assert sheet.bright(np.array([y + side / 2]), np.array([x + side / 2])).all()
    squares = re.findall(r"M(\S+ \S+) L(\S+ \S+) L(\S+ \S+) L(\S+ \S+)z", text)
    for corners in squares:
        at = np.array([[float(each) for each in corner.split()] for corner in corners])
        middle, side = at.mean(axis=0), at[1] - at[0]
        assert sheet.bright(middle[1:], middle[:1]).all()
        assert np.hypot(*side) == pytest.approx(18 * S, abs=0.01)
        assert round(float(np.rad2deg(np.arctan2(side[1], side[0])))) in {-each for each in TURNS} | set(
            TURNS
        )
