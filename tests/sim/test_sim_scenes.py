"""Scenes: shapes, drives, and values that depend on the sub-step alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sim_helpers import LEDS

from acquire.config import load_scene
from acquire.config.scene import SineDrive
from acquire.errors import UsageError
from acquire.sim.leds import LedConfig, LedScene, LedSceneConfig
from acquire.sim.scene import ArrayScene, SeparableScene
from acquire.sim.scenes import build_scene
from acquire.sim.shapes import SHAPES
from acquire.sim.voxels import truth

SUBSTEP_S = 1e-5


def led(**changes):
    fields = {
        "name": "led",
        "shape": "square",
        "row": 0.5,
        "column": 0.5,
        "size": 0.5,
        "drive": {"waveform": "constant", "level": 1.0},
    }
    return LedConfig.model_validate(fields | changes)


def mask(pixels, **changes):
    return LedScene((led(**changes),), pixels, SUBSTEP_S).masks[0]


AREAS = {
    "square": 1.0,
    "circle": np.pi / 4,
    "triangle": 0.5,
    "equals": 4 * 0.11,
    # two bars of half-width w across a square of side 1 by its diagonals, minus where they cross
    "x": 2 * (2 * 0.11 * np.sqrt(2) - 2 * 0.11**2) - (2 * 0.11) ** 2,
}


@pytest.mark.parametrize("shape", SHAPES)
def test_a_mask_covers_the_area_of_its_shape(shape):
    covered = mask(400, shape=shape)
    assert covered.min() == 0
    assert covered.max() == 1
    assert covered.mean() / 0.25 == pytest.approx(AREAS[shape], rel=0.01)


@pytest.mark.parametrize("shape", SHAPES)
def test_edges_are_smooth_and_shapes_mirror(shape):
    covered = mask(96, shape=shape, row=0.49)
    np.testing.assert_allclose(covered, covered[:, ::-1], atol=1e-5)
    if shape != "square":
        assert ((covered > 0.1) & (covered < 0.9)).any()
    moved = mask(96, shape=shape, row=0.49, column=0.5 + 0.1 / 96)
    assert 0 < np.abs(moved - covered).max() < 0.3


def test_the_triangle_points_up_and_equals_has_two_bars():
    triangle = mask(96, shape="triangle")
    widths = triangle.sum(axis=1)[24:72]
    assert (np.diff(widths[1:-1]) > 0).all()
    bars = mask(96, shape="equals")[:, 48] > 0.5
    assert np.flatnonzero(np.diff(bars.astype(int))).size == 4


@pytest.mark.parametrize("frequency_hz", [1000.0, 5000.0, 49_000.0, 100_000.0, 130_000.0])
def test_a_sub_step_holds_the_mean_of_the_drive_not_its_middle(frequency_hz):
    drive = SineDrive(waveform="sine", frequency_hz=frequency_hz, low=0.1, high=0.9, phase_deg=35)
    scene = LedScene((led(drive=drive),), 4, SUBSTEP_S)
    fine = (np.arange(-3 * 4000, 9 * 4000) + 0.5) / 4000 * SUBSTEP_S
    sine = np.sin(2 * np.pi * frequency_hz * fine + np.deg2rad(35))
    expected = (0.1 + 0.8 * (1 + sine) / 2).reshape(12, 4000).mean(axis=1)
    np.testing.assert_allclose(scene.intensity(-3, 12)[0], expected, atol=1e-7)


def test_the_drive_is_as_good_hours_into_a_run_as_at_its_start():
    drive = SineDrive(waveform="sine", frequency_hz=5000.0)
    scene = LedScene((led(drive=drive),), 4, SUBSTEP_S)
    np.testing.assert_allclose(scene.intensity(20 * 10**9, 40), scene.intensity(0, 40), atol=1e-5)


def test_saturation_bends_bright_light_and_leaves_dim_light():
    def light(level, saturation):
        drive = {"waveform": "constant", "level": level}
        return LedScene((led(drive=drive, saturation=saturation),), 4, SUBSTEP_S).intensity(0, 1)[0, 0]

    assert light(0.5, None) == 0.5
    assert light(0.001, 0.5) == pytest.approx(0.001, rel=2e-3)
    assert light(0.5, 0.5) == pytest.approx(0.5 * (1 - np.exp(-1)))
    assert light(1.0, 0.1) < 0.1


@given(
    first=st.integers(-500, 10**9),
    count=st.integers(1, 60),
    cut=st.integers(0, 60),
)
@settings(deadline=None)
def test_values_do_not_depend_on_how_a_stretch_is_split(first, count, cut):
    scene = build_scene(LEDS, 12, SUBSTEP_S)
    cut = min(cut, count)
    for sample, axis in ((scene.intensity, 1), (scene.frames, 0)):
        halves = np.concatenate([sample(first, cut), sample(first + cut, count - cut)], axis=axis)
        np.testing.assert_array_equal(sample(first, count), halves)


def test_frames_are_masks_times_intensity():
    scene = build_scene(load_scene("scene-leds.toml"), 48, SUBSTEP_S)
    assert isinstance(scene, SeparableScene)
    frames = scene.frames(-5, 20)
    assert (frames.dtype, frames.shape) == (np.float32, (20, 48, 48))
    expected = np.einsum("kt,krc->trc", scene.intensity(-5, 20), scene.masks.astype(np.float64))
    np.testing.assert_allclose(frames, expected, atol=1e-6)


def test_leds_of_one_name_are_refused():
    with pytest.raises(ValueError, match="different names, not led, led"):
        LedSceneConfig(kind="leds", title="twins", leds=(led(), led()))


def test_a_video_loops_in_both_directions():
    video = np.random.default_rng(1).random((5, 3, 3))
    scene = ArrayScene(video)
    assert not isinstance(scene, SeparableScene)
    assert scene.size == 3
    np.testing.assert_array_equal(scene.frames(-2, 9), video[[3, 4, 0, 1, 2, 3, 4, 0, 1]].astype(np.float32))


@pytest.mark.parametrize("shape", [(4, 3), (4, 3, 2), (0, 3, 3)])
def test_a_video_that_is_none_is_refused(shape):
    with pytest.raises(UsageError, match="video of shape"):
        ArrayScene(np.zeros(shape))


@given(
    count=st.integers(1, 23),
    size=st.integers(1, 7),
    merges=st.tuples(st.integers(1, 7), st.integers(1, 30)),
    first=st.integers(-9, 9),
    block_frames=st.integers(1, 9),
)
@settings(deadline=None)
def test_truth_is_the_mean_over_each_voxel_by_its_true_extent(count, size, merges, first, block_frames):
    spatial_merge, temporal_merge = min(merges[0], size), merges[1]
    scene = ArrayScene(np.random.default_rng(count).random((11, size, size)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("acquire.sim.voxels._BLOCK_BYTES", block_frames * 4 * size**2)
        voxels = truth(scene, first, count, spatial_merge, temporal_merge)
    X = scene.frames(first, count)
    side = -(-size // spatial_merge)
    assert voxels.shape == (-(-count // temporal_merge), side, side)
    for t, r, c in np.ndindex(voxels.shape):
        block = X[
            t * temporal_merge : (t + 1) * temporal_merge,
            r * spatial_merge : (r + 1) * spatial_merge,
            c * spatial_merge : (c + 1) * spatial_merge,
        ]
        assert voxels[t, r, c] == pytest.approx(block.mean(dtype=np.float64), rel=1e-5)


@pytest.mark.parametrize("bad", [(0, 1, 1), (5, 0, 1), (5, 5, 1), (5, 1, 0)])
def test_truth_refuses_impossible_voxels(bad):
    with pytest.raises(UsageError, match=r"ground truth of \d sub-steps cannot be computed"):
        truth(ArrayScene(np.ones((2, 4, 4))), 0, *bad)
