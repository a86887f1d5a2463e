"""Lines behind a fibre against Eq. (1), pixel by pixel of the scene, written a second time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_cases import setting
from sim_helpers import CODE
from small_bench import DT, M, N, S, bench, blinking, flat

from acquire.config.scene import SceneFile
from acquire.errors import UsageError
from acquire.fibre import Fibre
from acquire.sim.scenes import build_scene

ROWS, COLUMNS, SIDE = 2 * N, 3 * N, 3 * N
BANDS = {"a": (31, 3), "b": (40, 2, 21)}
FIBRE = Fibre(M, S, ROWS, COLUMNS, 60, BANDS["a"], BANDS["b"])
TOP = (SIDE - ROWS) // 2


def scattered(frames, bits, arm, count):
    """Lines 0 … count − 1 of an arm: every pixel of the scene where its fibre ends."""
    Y = np.zeros((count, 60))
    for t in np.flatnonzero(bits):
        for u in range(S):
            for r in range(ROWS):
                band, row = divmod(r, N)
                for c in range(COLUMNS):
                    stage, column = row, BANDS["a"][band] + c // S
                    if arm == "b":
                        strip, place = divmod(c, N)
                        stage, column = N - 1 - place, BANDS["b"][strip] + r // S
                    line, rest = divmod(t - stage - u, S)
                    if not rest and 0 <= line < count:
                        Y[line, column] += frames[t, TOP + r, c]
    return Y


def read(scene, arm, first, count):
    return replace(bench(scene), fibre=FIBRE).camera(arm, CODE).read(first, count).pixels


@pytest.mark.parametrize("arm", ["a", "b"])
def test_lines_of_any_scene_are_equation_1_of_what_the_fibre_shows(tmp_path, arm):
    video = np.random.default_rng(5).integers(0, 3, (58, SIDE, SIDE)).astype(np.float32)
    np.save(tmp_path / "v.npy", video)
    table = {"kind": "video", "path": tmp_path / "v.npy", "frame_rate_hz": 1 / DT, "between": "hold"}
    lines = read(SceneFile.model_validate(table).root, arm, 0, 11)
    np.testing.assert_array_equal(lines - 300.0, scattered(video, CODE.bits(0, 58), arm, 11))


@pytest.mark.parametrize("arm", ["a", "b"])
def test_lines_of_a_separable_scene_are_those_of_its_frames(arm):
    video = build_scene(blinking(), SIDE, DT).frames(0, 58)
    lines = read(blinking(), arm, 0, 11)
    np.testing.assert_allclose(lines - 300.0, scattered(video, CODE.bits(0, 58), arm, 11), atol=0.51)


def test_each_tile_is_read_as_a_sensor_of_its_own_reads_it(tmp_path):
    video = np.random.default_rng(6).integers(0, 3, (90, SIDE, SIDE)).astype(np.float32)
    np.save(tmp_path / "v.npy", video)
    table = {"kind": "video", "frame_rate_hz": 1 / DT, "between": "hold"}
    whole = SceneFile.model_validate({**table, "path": tmp_path / "v.npy"}).root
    for tile in FIBRE.tiles:
        top, left = TOP + tile.row * N, tile.column * N
        np.save(tmp_path / f"{tile}.npy", video[:, top : top + N, left : left + N])
        alone = SceneFile.model_validate({**table, "path": tmp_path / f"{tile}.npy"}).root
        for arm, columns in zip("ab", FIBRE.pixels(tile), strict=True):
            lines = read(whole, arm, -9, 40)[:, columns]
            np.testing.assert_array_equal(lines, bench(alone).camera(arm, CODE).read(-9, 40).pixels)


def test_lines_do_not_depend_on_how_they_are_read():
    scene = blinking()
    whole = read(scene, "b", -20, 700)
    again = replace(bench(scene), fibre=FIBRE).camera("b", CODE)
    parts = [again.read(first, count).pixels for first, count in ((-20, 1), (-19, 300), (281, 399))]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_a_scene_with_its_own_optics_is_refused():
    for optics in ({"layout": "compact"}, {"a": {"turn_deg": 90}}):
        with pytest.raises(
            UsageError, match=r"the scene has \[optics\] of its own, .* possible: a scene without"
        ):
            read(flat(optics=optics), "a", 0, 1)


def stage_of(effect, arm):
    """A random image of the whole square, and what an effect does to it on one arm."""
    scene = build_scene(blinking(), SIDE, DT)
    (listed,) = blinking([effect]).effects
    (stage,) = listed.stages(setting(arm=arm, scene=scene, fibre=FIBRE, seed=4))
    return np.random.default_rng(1).random((2, SIDE, SIDE), np.float32), stage.run


def test_fibres_that_end_on_a_column_have_one_gain_and_each_has_its_own():
    for arm in "ab":
        frames, run = stage_of({"kind": "fibre_gain", "columns": 0.05}, arm)
        dimmed = run(frames)
        gain = dimmed[0] / frames[0]
        np.testing.assert_allclose(dimmed[1], frames[1] * gain, rtol=1e-5)
        bands = [gain[TOP + N * k : TOP + N * (k + 1)] for k in range(2)]
        if arm == "b":
            bands = [gain[:, N * k : N * (k + 1)].T for k in range(3)]
        for band in bands:
            assert np.ptp(band, axis=0).max() < 1e-5
        columns = np.concatenate([band[0] for band in bands])
        assert columns.std() == pytest.approx(0.05, rel=0.25)
        assert np.abs(np.corrcoef(*bands[:2])[0, -1]) < 0.4
    frames, run = stage_of({"kind": "fibre_gain", "fibres": 0.1}, "a")
    dimmed = run(frames)
    gain = dimmed[0] / frames[0]
    assert gain.std() == pytest.approx(0.1, rel=0.05)
    assert gain.mean(axis=0).std() == pytest.approx(0.1 / np.sqrt(SIDE), rel=0.3)


def test_each_band_is_shifted_by_itself_and_shows_what_lies_beside_it():
    """Of ramps a shift is a constant, up to the band's very edge."""
    shifts = []
    for arm, axis, start, count in (("a", 0, TOP, 2), ("b", 1, 0, 3)):
        _, run = stage_of({"kind": "fibre_bands", "shift_pixels": 1.5}, arm)
        ramps = np.stack(np.mgrid[:SIDE, :SIDE]).astype(np.float32)
        moved = run(ramps) - ramps
        inside = np.s_[:, 8:-8, 8:-8]
        for k in range(count):
            band = np.zeros((SIDE, SIDE), bool)
            np.moveaxis(band, axis, 0)[start + N * k : start + N * (k + 1)] = True
            off = moved[inside][:, band[8:-8, 8:-8]]
            assert np.ptp(off, axis=1).max() < 1e-4
            shifts.append(off[:, 0])
        outside = np.ones(SIDE, bool)
        outside[start : start + count * N] = False
        assert not np.moveaxis(moved, axis + 1, 0)[outside].any()
    assert len({round(float(off), 3) for off in np.ravel(shifts)}) == 10
    assert 0.7 < np.std(shifts) < 2.5
