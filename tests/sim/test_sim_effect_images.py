"""Effects on the image against their formulas, for a single lit pixel."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from effect_cases import FLAT, effects
from sim_helpers import CODE
from small_bench import DT, LIT, M, N, S, bench, blinking, flat, read

from acquire.codes import ConstantCode
from acquire.config import GeometryConfig
from acquire.sim.functions import FunctionSceneConfig
from acquire.sim.leds import LedSceneConfig
from acquire.sim.scenes import build_scene


def spot(listed=()):
    """Light in one pixel, off the middle, as frames."""
    return FunctionSceneConfig.model_validate(
        {"kind": "function", "function": "spot_function:spot", "effects": list(listed)}
    )


@pytest.fixture(autouse=True)
def _spot(tmp_path, monkeypatch):
    (tmp_path / "spot_function.py").write_text(
        "import numpy as np\n"
        "def spot(t, row, column):\n"
        "    one = (abs(row - 10.5 / 24) < 0.01) & (abs(column - 14.5 / 24) < 0.01)\n"
        "    return np.broadcast_to(one.astype(np.float32), (len(t), *one.shape)).copy()\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "spot_function", raising=False)


def image_of(listed):
    """The spot through the image stages."""
    frame = build_scene(spot(), N, DT).frames(0, 1)
    assert frame[0, 10, 14] == frame.sum() == 1
    for stage in bench(spot(listed)).camera("a", LIT).stages:
        frame = stage.run(frame) if stage.place == "image" else frame
    return frame[0].astype(float)


def moments(image):
    at = np.indices(image.shape)
    mean = (at * image).sum(axis=(1, 2)) / image.sum()
    return mean, ((at - mean[:, None, None]) ** 2 * image).sum(axis=(1, 2)) / image.sum()


def test_misregistration_shifts_by_fractions_of_a_pixel_and_turns():
    image = image_of(effects("misregistration", rows=0.4, columns=-1.25))
    assert image.sum() == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(moments(image)[0], (10.4, 12.75), atol=1e-5)
    turned = moments(image_of(effects("misregistration", rows=0.0, turn_deg=20.0)))[0]
    angle = np.deg2rad(20.0)
    y, x = 10 - 11.5, 14 - 11.5  # counter-clockwise, rows downwards
    expected = (11.5 + np.cos(angle) * y - np.sin(angle) * x, 11.5 + np.sin(angle) * y + np.cos(angle) * x)
    np.testing.assert_allclose(turned, expected, atol=0.1)
    other = bench(spot(effects("misregistration"))).camera("b", LIT)
    assert other.stages == ()


def test_an_image_may_be_magnified_and_the_scene_extend_beyond_the_field():
    point = np.zeros((1, N, N), np.float32)
    point[0, 4, 12] = 1  # 7.5 above the middle, half a pixel to the right
    (stage,) = (
        bench(flat(listed=effects("misregistration", rows=0.0, magnification=1.2))).camera("a", LIT).stages
    )
    seen = stage.run(point)[0]
    rows, columns = np.indices(seen.shape) - (N - 1) / 2
    assert (seen * rows).sum() / seen.sum() == pytest.approx(1.2 * -7.5, abs=0.05)
    assert (seen * columns).sum() / seen.sum() == pytest.approx(1.2 * 0.5, abs=0.05)
    assert seen.sum() == pytest.approx(1.2**2, rel=0.1)
    shifted = {"rows": 3.0, "columns": 0.0}
    for beyond, light in (("dark", 0.0), ("edge", 1.0)):
        (stage,) = (
            bench(flat(listed=effects("misregistration", beyond=beyond, **shifted))).camera("a", LIT).stages
        )
        white = stage.run(np.ones((1, N, N), np.float32))[0]
        np.testing.assert_allclose(white[:3], light)
        np.testing.assert_allclose(white[3:], 1.0)


@pytest.mark.parametrize("part", [0.06, -0.06])
def test_a_lens_displaces_the_middle_of_a_side_outwards_or_inwards(part):
    half, middle = N / 2, (N - 1) / 2
    scene = np.zeros((1, N, N), np.float32)
    scene[0, 11:13, 20] = 1  # 8.5 to the right of the middle
    (stage,) = bench(flat(listed=effects("lens_distortion", part=part))).camera("b", LIT).stages
    seen = stage.run(scene)[0]
    out = (seen * np.arange(N)).sum() / seen.sum() - middle
    assert out * (1 - part * (out**2 + 0.25) / half**2) == pytest.approx(8.5, abs=0.06)
    assert np.sign(out - 8.5) == np.sign(part)
    assert bench(flat(listed=effects("lens_distortion", arm="a"))).camera("b", LIT).stages == ()


def test_vignetting_removes_its_fraction_at_the_corners():
    (stage,) = bench(flat(listed=effects("vignetting", loss=0.3))).camera("a", LIT).stages
    left = stage.run(np.ones((1, N, N), np.float32))[0]
    corner = ((N - 1) / 2) ** 2 / (N / 2) ** 2
    assert left[0, 0] == pytest.approx(1 - 0.3 * corner)
    assert left[N // 2, 0] == pytest.approx(1 - 0.15 * corner, abs=1e-3)
    (stage,) = (
        bench(flat(listed=effects("vignetting", loss=1.0, rows=9.0, columns=9.0))).camera("a", LIT).stages
    )
    off = stage.run(np.ones((1, N, N), np.float32))[0]
    assert off[0, 0] == 0
    assert np.unravel_index(off.argmax(), off.shape) in {(20, 20), (20, 21), (21, 20), (21, 21)}


def test_the_point_spread_has_its_sigma_and_keeps_the_light():
    image = image_of(effects("psf"))
    assert image.sum() == pytest.approx(1, abs=1e-4)
    mean, variance = moments(image)
    np.testing.assert_allclose(mean, (10, 14), atol=1e-4)
    np.testing.assert_allclose(variance, 1.2**2, rtol=0.02)


def test_a_veil_spreads_light_evenly_and_ambient_light_is_in_every_line():
    image = image_of(effects("stray_light", ambient=0.0))
    assert image.sum() == pytest.approx(1, abs=1e-6)
    assert image[10, 14] == pytest.approx(0.95 + 0.05 / N**2)
    assert image[0, 0] == pytest.approx(0.05 / N**2)
    dark = read(flat(0.0, effects("stray_light", veil=0.0, ambient=0.5)), code=ConstantCode(0)).pixels
    assert (dark == 300 + 0.5 * FLAT).all()


@pytest.mark.parametrize("layout", ["dual", "emulated", "interline"])
def test_ambient_light_is_in_units_of_the_scenes_light_in_every_layout(layout):
    stray = effects("stray_light", veil=0.0, ambient=1.0)
    optics = {"layout": layout, "baseline_factor": 3}
    geometry = GeometryConfig(stages=M, substeps=1 if layout == "interline" else S)
    ambient, lit = (
        replace(bench(scene), geometry=geometry).camera("a", ConstantCode(code)).read(100, 2).pixels
        for scene, code in ((flat(0.0, stray, optics=optics), 0), (flat(1.0, optics=optics), 1))
    )
    np.testing.assert_array_equal(ambient, lit)


def test_images_of_masks_and_of_frames_agree():
    listed = effects("misregistration", "psf", "stray_light")
    scene = blinking(listed)
    window = {"kind": "window", "phases": [{"duration_s": 1.0}]}
    framed = LedSceneConfig.model_validate(scene.model_dump() | {"shutters": [window]})
    masks, frames = (read(config, 80, CODE).pixels.astype(int) for config in (scene, framed))
    assert np.abs(masks - frames).max() <= 1


def test_arm_b_may_have_its_own_point_spread():
    listed = effects("psf", sigma_b_pixels=2.0)
    a, b = (bench(flat(listed=listed)).camera(arm, LIT).stages[0] for arm in ("a", "b"))
    point = np.zeros((1, N, N), np.float32)
    point[0, N // 2, N // 2] = 1
    _, of_a = moments(a.run(point)[0])
    _, of_b = moments(b.run(point)[0])
    np.testing.assert_allclose(of_a, 1.2**2, rtol=0.02)
    np.testing.assert_allclose(of_b, 2.0**2, rtol=0.02)
