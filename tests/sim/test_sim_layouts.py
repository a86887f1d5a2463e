"""Every layout and orientation of the two cameras against Eq. (1)."""

from __future__ import annotations

import numpy as np
import pytest
from sim_helpers import CODE
from small_bench import DT, M, N, S, bench, blinking, flat, read

from acquire.config import GeometryConfig
from acquire.config.scene import SceneFile
from acquire.errors import UsageError
from acquire.sim.pipeline import Bench
from acquire.sim.scenes import build_scene


def naive(frames, bits, turns, stages=M, substeps=S):
    """Eq. (1) of lines from sub-step 0 on."""
    X = np.rot90(frames, turns, axes=(1, 2)).astype(float) * bits[:, None, None]
    n = stages * substeps
    count = (len(frames) - n - substeps + 1) // substeps
    Y = np.zeros((count, stages))
    for i in range(count):
        for u in range(substeps):
            for r in range(n):
                Y[i] += X[substeps * i + u + r, r].reshape(stages, substeps).sum(axis=1)
    return Y


@pytest.fixture
def integers(tmp_path):
    """A video of whole numbers of light, one frame per sub-step."""
    video = np.random.default_rng(5).integers(0, 3, (200, N, N)).astype(np.float32)
    np.save(tmp_path / "v.npy", video)
    table = {"kind": "video", "path": tmp_path / "v.npy", "frame_rate_hz": 1 / DT, "between": "hold"}
    return table, video


@pytest.mark.parametrize("layout", ["dual", "compact", "emulated"])
@pytest.mark.parametrize("arm", ["a", "b"])
def test_every_layout_gives_equation_1(integers, layout, arm):
    table, video = integers
    scene = SceneFile.model_validate(table | {"optics": {"layout": layout}}).root
    lines = read(scene, 50, CODE, arm, first=0, black_level_dn=9.0).pixels
    expected = naive(video, CODE.bits(0, 200), "ab".index(arm))[:50]
    np.testing.assert_array_equal(lines, expected + 9)


def test_merged_raw_lines_equal_the_model_of_three_substeps_exactly(integers):
    table, _ = integers
    both = [
        read(
            SceneFile.model_validate(table | {"optics": {"layout": layout}}).root, 700, CODE, "b", first=-20
        ).pixels
        for layout in ("dual", "emulated")
    ]
    np.testing.assert_array_equal(*(lines.astype(int) - 300 for lines in (both[0], both[1] + 3)))


def test_a_saturated_raw_sample_makes_the_merged_one_white():
    scene = flat(1.0, optics={"layout": "emulated", "raw_bits": 4})
    assert (read(scene, 5).pixels == 65535).all()


def test_the_baseline_sums_fine_pixels_and_sub_steps(integers):
    table, video = integers
    scene = SceneFile.model_validate(
        table | {"frame_rate_hz": 3 / DT, "optics": {"layout": "interline", "baseline_factor": 3}}
    ).root
    one = bench(scene)
    coarse = Bench(scene, GeometryConfig(stages=M, substeps=1), one.cameras, DT)
    lines = coarse.camera("a", CODE).read(0, 20).pixels
    summed = video[:198].reshape(66, 3, M, 3, M, 3).sum(axis=(1, 3, 5))
    np.testing.assert_array_equal(lines - 300, naive(summed, CODE.bits(0, 66), 0, M, 1)[:20])


@pytest.mark.parametrize("turn", [0, 90, 180, 270])
@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("separable", [False, True])
def test_the_eight_orientations(integers, turn, mirror, separable):
    table, video = integers
    optics = {"a": {"turn_deg": turn, "mirror": mirror}}
    if separable:
        scene = blinking(optics=optics)
        video = build_scene(blinking(), N, DT).frames(0, 200)
    else:
        scene = SceneFile.model_validate(table | {"optics": optics}).root
    lines = read(scene, 40, CODE, first=0).pixels - 300.0
    seen = video[:, :, ::-1] if mirror else video
    expected = naive(seen, CODE.bits(0, 200), turn // 90)[:40]
    np.testing.assert_allclose(lines, expected, atol=0.51)


def test_impossible_layouts_are_refused(integers):
    for optics, words in (
        ({"layout": "compact", "sensor_pixels": 10}, "on 10 columns"),
        ({"layout": "compact", "column_b": 4}, "side by side"),
        ({"layout": "emulated", "raw_bits": 14}, "Mono16"),
        ({"layout": "interline"}, "substeps = 1"),
    ):
        with pytest.raises(UsageError, match=words):
            read(flat(optics=optics), 1)
