"""The paper's scenes: true geometry, exact means, right places."""

from __future__ import annotations

import numpy as np
import pytest

from acquire.config import builtin_directory, load_scene
from acquire.config.scene import ChopperConfig, PulseDrive, TriangleDrive, WindowConfig
from acquire.errors import ConfigError
from acquire.sim.digits import DigitScene, DisplayConfig
from acquire.sim.drives import mean_drive
from acquire.sim.scene import ArrayScene, SeparableScene, SumScene, frames_at
from acquire.sim.scenes import build_scene
from acquire.sim.shutters import Chopper, PhasedWindow, ShutteredScene
from acquire.sim.targets import bar_width_mm, line_pairs_per_mm, usaf_bars, usaf_picture

SCENES = sorted(path.stem for path in builtin_directory().glob("scene-*.toml"))
DT = 1e-6


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_gives_the_same_light_however_it_is_asked(name):
    scene = build_scene(load_scene(name), 48, 1 / 1.8e6)
    first = 2100  # across the window's opening
    whole = scene.frames(first, 40)
    assert (whole.shape, whole.dtype) == ((40, 48, 48), np.float32)
    darkest, brightest = (0.25, 0.25) if name == "scene-practice" else (0.0, 0.3)  # a white card
    assert darkest <= whole.min() < darkest + 0.1
    assert brightest < whole.max() <= 1 + 1e-6
    assert scene.frames(-3, 2).shape == (2, 48, 48)
    np.testing.assert_array_equal(
        whole, np.concatenate([scene.frames(first, 13), scene.frames(first + 13, 27)])
    )
    some = first + np.array([0, 5, 10, 37])
    np.testing.assert_array_equal(frames_at(scene, some), whole[some - first])
    if isinstance(scene, SeparableScene):
        expected = np.einsum("kt,krc->trc", scene.intensity(first, 40), scene.masks.astype(np.float64))
        np.testing.assert_allclose(whole, expected, atol=1e-6)


@pytest.mark.parametrize("frequency_hz", [3e3, 70e3, 300e3, 900e3, 2.3e6])
@pytest.mark.parametrize("waveform", ["pulse", "triangle"])
def test_a_sub_step_holds_the_mean_of_the_drive(waveform, frequency_hz):
    kind = PulseDrive if waveform == "pulse" else TriangleDrive
    drive = kind(waveform=waveform, frequency_hz=frequency_hz, low=0.1, high=0.9, phase_deg=35)
    fine = (np.arange(-3 * 20000, 9 * 20000) + 0.5) / 20000 * DT
    x = (fine * frequency_hz + 35 / 360) % 1
    wave = x < 0.5 if waveform == "pulse" else 1 - np.abs(2 * x - 1)
    expected = (0.1 + 0.8 * wave).reshape(12, 20000).mean(axis=1)
    np.testing.assert_allclose(mean_drive(drive, -3, 12, DT), expected, atol=3e-4)


def test_pulses_of_the_nyquist_rate_alternate_and_faster_ones_still_do():
    """Fig. 6: at 1.8 MHz a pulse train of 900 kHz is on, off, on, off; 300 kHz is three on, three off."""
    for name, period in (("scene-pulses-900khz", 1), ("scene-pulses-300khz", 3)):
        scene = build_scene(load_scene(name), 12, 1 / 1.8e6)
        light = scene.intensity(0, 12)[0]
        np.testing.assert_allclose(light, np.arange(12) // period % 2 == 0, atol=1e-6)


def test_usaf_bars_have_the_standard_widths():
    assert line_pairs_per_mm(0, 1) == 1
    assert line_pairs_per_mm(3, 5) == pytest.approx(12.70, abs=0.005)
    assert bar_width_mm(2, 1) == pytest.approx(0.125)
    bars = usaf_bars((2, 3))
    for group in (2, 3):
        for element in range(1, 7):
            w = 1 / (2 * 2 ** (group + (element - 1) / 6))
            mine = [bar for bar in bars if (bar.group, bar.element) == (group, element)]
            assert len(mine) == 6
            sides = sorted((bar.height / w, bar.width / w) for bar in mine)
            np.testing.assert_allclose(sides, [(1, 5)] * 3 + [(5, 1)] * 3)
            lefts = sorted(bar.left for bar in mine if bar.width < bar.height)
            np.testing.assert_allclose(np.diff(lefts), 2 * w)


def test_usaf_bars_do_not_overlap_and_keep_their_area():
    bars = usaf_bars((2, 3, 4, 5))
    picture = usaf_picture((2, 3, 4, 5), 200, 6.4)
    assert picture.max() <= 1 + 1e-6
    area = sum(bar.height * bar.width for bar in bars)
    assert picture.mean() * 6.4**2 == pytest.approx(area, rel=1e-5)


def test_digits_are_triangles_half_a_period_apart_and_segments_join():
    displays = (
        DisplayConfig(digits="2468", column=0.3),
        DisplayConfig(digits="1357", column=0.7, phase_deg=180),
    )
    scene = DigitScene(displays, 128e-6, 32, DT)
    light = dict(zip([(d.digits, s) for d, s in scene.segments], scene.intensity(0, 4 * 128), strict=True))
    fine = (np.arange(4 * 128 * 100) + 0.5) / 100 / 128
    triangle = lambda x: (1 - np.abs(2 * (x % 1) - 1)).reshape(-1, 100).mean(axis=1)  # noqa: E731
    np.testing.assert_allclose(light["2468", "g"], triangle(fine), atol=1e-4)
    np.testing.assert_allclose(light["1357", "c"], triangle(fine + 0.5), atol=1e-4)
    shown = ((fine + 0.5) % 4 // 1).reshape(-1, 100)[:, 50]
    on = light["1357", "d"] > 0.02
    assert not on[(shown == 0) | (shown == 3)].any()
    assert on[(shown == 1) | (shown == 2)].mean() > 0.95


def test_a_display_slower_or_faster_than_the_sub_step_keeps_its_mean():
    display = DisplayConfig(digits="8", column=0.5)
    assert DigitScene((display,), 0.3e-6, 8, DT).intensity(5, 30).mean() == pytest.approx(0.5, abs=0.01)


def test_a_window_slides_and_opens():
    config = WindowConfig.model_validate(
        {
            "kind": "window",
            "phases": [
                {"duration_s": 10e-6, "axis": "row", "begin": 1.0, "end": 0.0, "width": 0.25},
                {"duration_s": 5e-6},
            ],
        }
    )
    scene = ShutteredScene(ArrayScene(np.ones((1, 40, 40))), [PhasedWindow(config.phases, 40, DT)])
    frames = scene.frames(0, 30)
    np.testing.assert_array_equal(frames[10:15], 1)
    np.testing.assert_allclose(frames[:15], frames[15:], atol=1e-5)
    for t in range(2, 8):
        rows = frames[t, :, 3]
        assert rows.sum() == pytest.approx(10, abs=1e-3)
        assert (rows * (np.arange(40) + 0.5)).sum() / 10 / 40 == pytest.approx(1 - (t + 0.5) / 10, abs=1e-4)


def test_a_chopper_lets_its_open_part_through_and_turns_counter_clockwise():
    config = ChopperConfig(kind="chopper", row=0.5, column=0.5, blades=4, open_part=0.3, rotation_hz=2500.0)
    scene = ShutteredScene(ArrayScene(np.ones((1, 100, 100))), [Chopper(config, 100, DT)])
    frames = scene.frames(0, 101)
    assert frames.mean() == pytest.approx(0.3, abs=0.005)
    np.testing.assert_allclose(frames[100], frames[0], atol=1e-4)  # a quarter of a turn is one of four blades
    # The opening that begins at angle 0 (to the right) is above the axis, and moves upwards.
    assert frames[0][30:50, 90].mean() > 0.9 > frames[0][51:70, 90].mean()
    edge = [float(frames[t][:50, 90].sum()) for t in (0, 3, 6)]
    assert np.flatnonzero(frames[6][:50, 90])[-1] < np.flatnonzero(frames[0][:50, 90])[-1], edge


def test_goldfish_are_where_their_orbits_put_them():
    config = load_scene("scene-goldfish")
    fish = config.sprites[1].model_copy(update={"orbit_phase_deg": 0.0})
    scene = build_scene(config.model_copy(update={"sprites": (fish,)}), 120, 1 / 1.8e6)
    period = 1.8e6 / 350.0
    for turn, row, column in ((0, 0.5, 0.83), (0.25, 0.17, 0.5), (0.5, 0.5, 0.17)):
        frame = scene.frames(round(turn * period), 1)[0]
        place = np.argwhere(frame > 0).mean(axis=0) / 120
        np.testing.assert_allclose(place, (row, column), atol=0.05)


def test_scenes_add_up_and_stay_separable_where_they_can():
    usaf = {"kind": "usaf"}
    digits = load_scene("scene-digits").model_dump(exclude={"effects", "optics"})
    window = {**usaf, "shutters": [{"kind": "window", "phases": [{"duration_s": 1.0, "axis": "row"}]}]}
    from acquire.config.scene import SceneFile

    for parts, kind in (([usaf, digits], SeparableScene), ([window, digits], SumScene)):
        both = build_scene(SceneFile.model_validate({"kind": "sum", "parts": parts}).root, 24, DT)
        assert isinstance(both, kind)
        alone = [build_scene(SceneFile.model_validate(part).root, 24, DT).frames(3, 5) for part in parts]
        np.testing.assert_allclose(both.frames(3, 5), sum(alone), atol=1e-6)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('kind = "usaf"\nfield_mm = -1.0', "field_mm = -1.0"),
        ('kind = "usaf"\ngroups = [3, 4]', "even one"),
        ('kind = "usaf"\ndrive = { waveform = "pulse", frequency_hz = -3.0 }', "frequency_hz = -3.0"),
        ('kind = "usaf"\ndrive = { waveform = "pulse", frequency_hz = nan }', "finite"),
        ('kind = "stars"', "scene 'stars' is not known"),
        ('kind = "usaf"\n[[effects]]\nkind = "read_noise"\nsigma_e = -2.0', "sigma_e = -2.0"),
        (
            'kind = "usaf"\n[[effects]]\nkind = "shot_noise"\n[[effects]]\nkind = "shot_noise"',
            "listed only once",
        ),
        ('kind = "usaf"\ncolour = 3', "unknown key; allowed here: dark"),
        ('kind = "sum"\n[[parts]]\nkind = "usaf"\noptics = { layout = "compact" }', "belong to the sum"),
    ],
)
def test_a_scene_file_that_cannot_be_is_refused_with_its_key(tmp_path, text, words):
    file = tmp_path / "scene.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match="(?s)" + words):
        load_scene(file)
