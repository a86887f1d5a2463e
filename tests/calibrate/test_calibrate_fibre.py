"""Behind a fibre a column's gain includes that of the fibres that end on it; each tile gets its own part."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from acquire.calibrate import Calibration, calibrated
from acquire.calibrate.align import align
from acquire.calibrate.columns import dark, flat
from acquire.calibrate.exposure import Exposure, open_exposure
from acquire.calibrate.file import save_calibration
from acquire.calibrate.still import Still, stills
from acquire.calibrate.target import tile_alignments
from acquire.cli import main
from acquire.config import load_rig
from acquire.config.rig import ConstantCodeConfig
from acquire.config.scene import SceneFile
from acquire.errors import UsageError
from acquire.fibre import Tile
from acquire.lines import merged
from acquire.recon import reconstruct
from acquire.sim.leds import LedSceneConfig
from acquire.simulate import simulate
from acquire.store import Recording, open_recording

SETTINGS = {"geometry.stages": 16, "geometry.substeps": 1, "cameras.layout": "fibre"}
SETTINGS |= {"fibre.rows": 32, "fibre.columns": 48, "fibre.sensor_pixels": 103}
SETTINGS |= {
    f"cameras.{arm}.{key}": value
    for arm in "ab"
    for key, value in (("black_level_dn", 100.0), ("responsivity_dn", 150.0))
}
UNEVEN = [
    {"kind": "fibre_gain", "columns": 0.05},
    {"kind": "prnu", "prnu": 0.03},
    {"kind": "dsnu", "dsnu_e": 60.0},
]
DISPLACED = {"kind": "fibre_bands", "shift_pixels": 1.0}
LED = {"name": "x", "row": 0.5, "column": 0.5, "drive": {"waveform": "constant", "level": 1.0}}


def recorded(path: Path, shape: str, effects: list[dict[str, Any]], steady: int | None = None) -> Recording:
    """``steady``: the light's code if it is constant."""
    scene = {"kind": "leds", "leds": [{**LED, "shape": shape, "size": 1.0}], "effects": effects}
    rig = load_rig("rig-demo", SETTINGS)
    if steady is not None:
        rig = rig.model_copy(update={"code": ConstantCodeConfig(kind="constant", value=steady)})
    simulate(rig, LedSceneConfig.model_validate(scene), path, 600)
    return open_recording(path)


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    home = tmp_path_factory.mktemp("flat")
    noisy = [*UNEVEN, {"kind": "shot_noise"}, {"kind": "read_noise", "sigma_e": 10.0}]
    found = {}
    for name, value in (("dark", 0), ("flat", 1)):
        recorded(home / f"{name}.zarr", "square", noisy, value)
        found[name] = open_exposure(home / f"{name}.zarr", 64, 500)
    begun = Calibration(found["dark"].instrument).with_step(dark(found["dark"]))
    return begun.with_step(flat(found["flat"], begun))


def test_a_flat_gives_the_gain_of_each_column_with_its_fibres(known: Calibration, tmp_path: Path) -> None:
    assert known.instrument.columns == 103
    uneven = recorded(tmp_path / "uneven.zarr", "x", UNEVEN)
    even = recorded(tmp_path / "even.zarr", "x", [])
    levels = []
    for tile in even.fibre.tiles:
        found = calibrated(uneven.cut(100, 200, tile), known).samples(np.float64)
        bare = even.cut(100, 200, tile).samples(np.float64)
        raw = uneven.cut(100, 200, tile).samples(np.float64)
        ratio = (found * bare).sum(axis=1) / (bare**2).sum(axis=1).clip(1e-9)
        worst = np.abs((raw * bare).sum(axis=1) / (bare**2).sum(axis=1).clip(1e-9) - 1).max()
        lit = bare.mean(axis=1) > 0.5
        assert np.ptp(ratio[lit]) < 0.02 < worst
        levels.append(np.median(ratio[lit]))
    assert np.ptp(levels) < 0.01


def test_columns_outside_the_bands_are_masked_without_a_warning(known: Calibration) -> None:
    assert known.usable is not None
    fibre = load_rig("rig-demo", SETTINGS).laid_out
    for arm, usable in zip("ab", known.usable, strict=True):
        np.testing.assert_array_equal(usable, fibre.table(arm)[:, 0] >= 0)
    assert not known.steps["flat"]["warnings"]


def test_a_calibration_without_these_columns_is_refused(known: Calibration, tmp_path: Path) -> None:
    narrow = Calibration(known.instrument.model_copy(update={"pixels": None}))
    uneven = recorded(tmp_path / "uneven.zarr", "x", [])
    with pytest.raises(UsageError, match="16 columns does not cover those of the lines"):
        calibrated(uneven.cut(100, 200, uneven.fibre.tiles[-1]), narrow)


def test_explain_names_the_tile_it_measured(
    known: Calibration,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    recorded(tmp_path / "uneven.zarr", "x", [*UNEVEN, {"kind": "read_noise", "sigma_e": 10.0}])
    save_calibration(tmp_path / "cal.zarr", known)
    words = ("--calibration", tmp_path / "cal.zarr", "--explain", "--json", "--nm", 2, "--tm", 75)
    words += ("--lines", 60, "--tiles", "0-1,1")
    monkeypatch.setattr(
        sys, "argv", ["acquire", "reconstruct", str(tmp_path / "uneven.zarr"), *map(str, words)]
    )
    assert main() == 0
    told = json.loads(capsys.readouterr().out)
    assert told["tile"] in {"0,1", "1,1"}
    by_part = {each["part"]: each for each in told["parts"]}
    assert by_part["all of it"]["prediction"] < 0.9 * by_part["nothing"]["prediction"]
    assert by_part["gains per column"]["gain_db"] > 0.3


def of_dots(home: Path, effects: list[dict[str, Any]], steady: int | None = None) -> Exposure:
    """Dots behind a fibre in 2 × 3 tiles of 32 columns; ``steady``: white in constant light instead."""
    changes = {**SETTINGS, "geometry.stages": 32, "fibre.rows": 64, "fibre.columns": 96}
    rig = load_rig("rig-demo", {**changes, "fibre.sensor_pixels": 200})
    if steady is not None:
        rig = rig.model_copy(update={"code": ConstantCodeConfig(kind="constant", value=steady)})
    dots = np.random.default_rng(3).random((32, 32)).repeat(3, axis=0).repeat(3, axis=1) > 0.6
    picture = 200 * dots if steady is None else np.full_like(dots, 100, np.int64)
    Image.fromarray(picture.astype(np.uint8)).save(home / "scene.png")
    table = {"kind": "video", "path": str(home / "scene.png"), "effects": effects}
    path = home / f"dots-{steady}.zarr"
    simulate(rig, SceneFile.model_validate(table).root, path, 600)
    return open_exposure(path, 64, 500)


@pytest.fixture
def displaced(tmp_path: Path) -> Exposure:
    """Clean dots behind a fibre whose bands are displaced, in 2 × 3 tiles."""
    return of_dots(tmp_path, [DISPLACED])


def test_gains_and_displacement_of_a_tile_are_corrected_in_merged_lines_too(tmp_path: Path) -> None:
    """Dark, flat and target of an uneven, noisy instrument; raw lines in larger voxels, merged lines."""
    effects = [DISPLACED, *UNEVEN, {"kind": "shot_noise"}, {"kind": "read_noise", "sigma_e": 10.0}]
    first = of_dots(tmp_path, effects, 0)
    known = Calibration(first.instrument).with_step(dark(first))
    known = known.with_step(flat(of_dots(tmp_path, effects, 1), known))
    target = of_dots(tmp_path, effects)
    known = known.with_step(tile_alignments(target, known))
    lines = target.recording.cut(64, 150, Tile(1, 2))
    corrected = calibrated(lines, known)
    assert corrected.alignment is not None
    stages = {"nothing": lines, "columns": replace(corrected, alignment=None), "all": corrected}
    for count, voxel in ((1, 2), (2, 1)):
        missed = {
            name: reconstruct(merged(each, count), voxel, 181, "fast", check=False).quality.prediction
            for name, each in stages.items()
        }
        assert missed["all"] < 0.8 * missed["columns"] < 0.8 * missed["nothing"], (count, voxel, missed)


def test_displaced_bands_are_measured_tile_by_tile_and_corrected(displaced: Exposure) -> None:
    found = tile_alignments(displaced, Calibration(displaced.instrument))
    assert found.warnings == ()
    assert [each.tile for each in found.tiles] == ["0,0", "0,1", "0,2", "1,0", "1,1", "1,2"]
    numbers = [each.found.alignment for each in found.tiles]
    shifts = np.array([(each.rows, each.columns) for each in numbers]).reshape(2, 3, 2)
    # B's bands beside A's: as many differences as there are tiles, of which bands explain all
    odd = shifts - shifts.mean(0, keepdims=True) - shifts.mean(1, keepdims=True) + shifts.mean((0, 1))
    assert np.abs(odd).max() < 0.1 < 0.5 < shifts.std()
    known = Calibration(displaced.instrument).with_step(found)
    assert Calibration.from_attrs(known.to_attrs()).tiles == known.tiles
    lines = displaced.recording.cut(64, 150, Tile(1, 2))
    aligned = calibrated(lines, known)
    assert aligned.alignment == known.tiles[-1].found.alignment
    raw, better = (reconstruct(each, 1, 181, "fast", check=False).quality for each in (lines, aligned))
    assert better.prediction < 0.5 * raw.prediction


def test_rounding_errors_do_not_move_an_alignment(displaced: Exposure) -> None:
    """Clean images differ by the errors of interpolation, which must not all be taken for outliers."""
    segment = displaced.recording.cut(64, 500, Tile(1, 1))
    draw = np.random.default_rng(5).standard_normal

    def rounded(still: Still) -> Still:
        return replace(still, image=still.image * (1 + 1e-12 * draw(still.image.shape)))

    found = [align(*map(rounded, stills(segment)), segment.geometry, (1.0, 0.0)).found for _ in range(20)]
    shifts = np.array([(each.alignment.rows, each.alignment.columns) for each in found])
    assert np.ptp(shifts, axis=0).max() < 1e-3
