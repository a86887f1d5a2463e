"""Every effect against its formula: a no-op fails, and so does an effect that is applied twice."""

from __future__ import annotations

import sys
from dataclasses import replace
from math import comb

import numpy as np
import pytest
from effect_cases import FLAT, PARAMETERS, effects, electrons, setting, through
from pydantic import ValidationError
from sim_helpers import CODE
from small_bench import DT, LIT, K, N, S, bench, blinking, flat, read

from acquire.errors import UsageError
from acquire.sim.effects import in_order, kinds
from acquire.sim.effects.light import jitter
from acquire.sim.effects.signal import tail
from acquire.sim.light import Illumination
from acquire.sim.scenes import build_scene

ORDER = list(PARAMETERS)

# What holds for all of them


def test_a_scene_without_effects_has_no_stage_imports_none_and_draws_nothing(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("acquire.sim.effects.")]:
        if not name.endswith(".base"):
            monkeypatch.delitem(sys.modules, name)

    def refuse(*args, **more):
        raise AssertionError("a random number was asked for")

    for name in ("SeedSequence", "Generator", "PCG64", "default_rng"):
        monkeypatch.setattr(np.random, name, refuse)
    for layout in ("dual", "compact", "emulated"):
        camera = bench(flat(optics={"layout": layout})).camera("a", CODE)
        assert camera.stages == ()
        assert camera.read(-20, 600).pixels.any()
    loaded = [name for name in sys.modules if name.startswith("acquire.sim.effects.")]
    assert loaded == ["acquire.sim.effects.base"]
    with pytest.raises(AssertionError, match="random number"):
        read(flat(listed=effects("read_noise")))


@pytest.mark.parametrize("kind", ORDER)
def test_a_listed_effect_changes_lines_and_is_the_only_stage(kind):
    scene = blinking(effects(kind))
    camera = bench(scene).camera("a", CODE)
    assert {stage.effect for stage in camera.stages} == {kind}
    lines, bare = camera.read(600, 1024), read(blinking(), 1024, CODE, first=600)
    assert not np.array_equal(lines.pixels, bare.pixels)


@pytest.mark.parametrize("layout", ["dual", "compact", "emulated"])
def test_lines_of_all_effects_together_do_not_depend_on_how_they_are_read(layout):
    scene = blinking(effects(*ORDER), optics={"layout": layout})
    whole = bench(scene).camera("b", CODE).read(-300, 1300)
    again, pixels, line = bench(scene).camera("b", CODE), [], -300
    for count in (1, 255, 300, 7, 737):
        pixels.append(again.read(line, count).pixels)
        line += count
    np.testing.assert_array_equal(np.concatenate(pixels), whole.pixels)
    later = bench(scene).camera("b", CODE).read(500, 300)
    np.testing.assert_array_equal(later.pixels, whole.pixels[800:1100])
    np.testing.assert_array_equal(later.missing, whole.missing[800:1100])


def test_another_effect_leaves_the_draws_of_the_others_unchanged():
    alone = electrons(flat(0.0, effects("read_noise"))) - electrons(flat(0.0))
    with_offset = electrons(flat(0.0, effects("dsnu", "read_noise")))
    offset = electrons(flat(0.0, effects("dsnu")))
    np.testing.assert_allclose(with_offset - offset, alone, atol=1.01 / K)
    both = read(blinking(effects("shot_noise", "dropped_lines"))).missing
    np.testing.assert_array_equal(both, read(blinking(effects("dropped_lines"))).missing)


def test_arms_seeds_and_realisations_draw_differently_and_patterns_stay():
    noise, fixed = flat(0.5, effects("read_noise")), flat(0.5, effects("prnu"))
    a = electrons(noise)
    others = [electrons(noise, arm="b"), electrons(flat(0.5, effects("read_noise"), seed=1))]
    again = replace(bench(noise), realisation=1)
    others.append((again.camera("a", LIT).read(512, 2048).pixels - 300.0) / K)
    for other in others:
        assert abs(np.corrcoef(a.ravel(), other.ravel())[0, 1]) < 0.03
    assert np.ptp(electrons(fixed), axis=0).max() == 0


@pytest.mark.parametrize("value", [1e-310, 1e-200, 1e200])
@pytest.mark.parametrize(
    ("kind", "key"),
    [(kind, key) for kind in PARAMETERS for key, value in PARAMETERS[kind].items() if type(value) is float],
)
def test_absurd_numbers_are_refused_or_harmless(kind, key, value):
    try:
        scene = blinking(effects(kind, **{key: value}))
    except ValidationError:
        return
    read(scene, 8, CODE)


def test_effects_act_in_the_order_of_physics_whatever_the_list_says():
    assert [kind for kind in kinds() if kind in ORDER] == ORDER
    forwards, backwards = blinking(effects(*ORDER)), blinking(effects(*ORDER[::-1]))
    assert [effect.kind for effect in in_order(backwards.effects)] == list(ORDER)
    np.testing.assert_array_equal(read(forwards, code=CODE).pixels, read(backwards, code=CODE).pixels)


# Electrons


@pytest.mark.parametrize("level", [0.1, 0.4, 1.0])
def test_photon_transfer_has_the_slope_k(level):
    """EMVA 1288: σ_y² − σ_dark² = K·(μ_y − μ_dark), with σ_q² = 1/12 of rounding."""
    dn = read(flat(level, effects("shot_noise")), count=8192).pixels.astype(float) - 300.0
    assert dn.mean() == pytest.approx(level * FLAT, rel=0.003)
    assert dn.var() - 1 / 12 == pytest.approx(K * level * FLAT, rel=0.03)
    assert abs(np.corrcoef(dn[:-1].ravel(), dn[1:].ravel())[0, 1]) < 0.02


def test_read_noise_has_its_sigma_and_no_mean():
    e = electrons(flat(0.2, effects("read_noise")), count=8192)
    assert e.mean() == pytest.approx(0.2 * FLAT / K, rel=1e-3)
    assert np.sqrt(e.var() - 1 / 12 / K**2) == pytest.approx(60.0, rel=0.02)
    z = (e - e.mean()) / e.std()
    assert (np.abs(z) < 1).mean() == pytest.approx(0.683, abs=0.01)


def test_dark_current_is_poisson_with_rate_times_exposure():
    mean = 5e6 * N * DT
    e = electrons(flat(0.0, effects("dark_current")), count=8192)
    assert e.mean() == pytest.approx(mean, rel=0.02)
    assert e.var() - 1 / 12 / K**2 == pytest.approx(mean, rel=0.1)


def test_prnu_and_dsnu_are_fixed_patterns_of_their_size():
    wide = {"optics": {"layout": "compact", "sensor_pixels": 4000, "column_b": 2000}}
    dark, bright = 0.0, 1.0
    for kind, level, sigma in (("dsnu", dark, 40.0), ("prnu", bright, 0.02 * FLAT / K)):
        sensor = bench(flat(level, effects(kind), **wide)).camera("a", LIT)._sensor
        change = through(sensor, np.full((2, 4000), level * FLAT / K), 0) - level * FLAT / K
        np.testing.assert_array_equal(change[0], change[1])
        assert change[0].std() == pytest.approx(sigma, rel=0.05)
        assert abs(change[0].mean()) < 4 * sigma / np.sqrt(4000)
    lines = read(flat(bright, effects("prnu"))).pixels
    assert np.ptp(lines, axis=0).max() == 0 < np.ptp(lines[0])


def test_no_pixel_answers_light_with_a_negative_signal():
    dark, lit = (read(flat(level, effects("prnu", prnu=1.0)), 1).pixels for level in (0.0, 1.0))
    many = [read(flat(1.0, effects("prnu", prnu=1.0), seed=seed), 1).pixels for seed in range(20)]
    assert (dark == 300).all()
    assert lit.min() >= 300
    assert np.min(many) == 300


def test_a_full_well_limits_the_electrons():
    assert electrons(flat(1.0, effects("full_well"))).max() == pytest.approx(600.0)
    np.testing.assert_array_equal(read(flat(0.1, effects("full_well"))).pixels, read(flat(0.1)).pixels)


def test_column_offsets_repeat_by_channel():
    change = read(flat(0.5, effects("column_offsets"))).pixels.astype(int) - read(flat(0.5)).pixels
    assert np.ptp(change, axis=0).max() == 0
    np.testing.assert_array_equal(change[0, :4], change[0, 4:])
    many = [
        read(flat(0.5, effects("column_offsets", channels=8), seed=seed), 1).pixels.astype(float)[0]
        for seed in range(60)
    ]
    assert np.std(many) == pytest.approx(4.0, rel=0.15)


def test_an_adc_with_fewer_bits_has_fewer_levels_and_saturates():
    ramp = read(blinking(effects("adc", bits=12)), code=CODE).pixels
    assert set(np.unique(ramp % 16)) == {0}
    exact = read(blinking(), code=CODE).pixels.astype(int)
    assert np.abs(ramp.astype(int) - exact).max() == 8
    clipped = read(flat(1.0, effects("adc", bits=16, saturation_dn=400.0))).pixels
    assert (clipped == 400).all()


# Light


def test_wrong_bits_come_at_their_rate_and_late_light_is_late():
    scene = build_scene(flat(), N, DT)
    camera = bench(flat(listed=effects("code_errors", late_substeps=0))).camera("a", CODE)
    wrong = through(camera, Illumination.of(scene, CODE)).bits(0, 100_000) != CODE.bits(0, 100_000)
    assert wrong.mean() == pytest.approx(0.02, rel=0.1)
    assert not through(camera, Illumination.of(scene, CODE)).bits(-900, 900).any()
    late = read(blinking(effects("code_errors", flip_rate=0.0, late_substeps=3)), 64, CODE)

    class Late:
        def bits(self, start, length):
            return CODE.bits(start - 3, length)

    np.testing.assert_array_equal(late.pixels, read(blinking(), 64, Late()).pixels)


@pytest.mark.parametrize(("carrier_hz", "bits"), [(1e6, 4), (400e3, 8), (37e3, 6), (3e3, 8)])
def test_pwm_switches_full_light_for_the_duty_cycle(carrier_hz, bits):
    config = blinking(effects("pwm", carrier_hz=carrier_hz, bits=bits))
    camera = bench(config).camera("a", LIT)
    scene = build_scene(config, N, DT)
    drives = through(camera, Illumination.of(scene, LIT)).drives(-700, 3000)[0]
    duty = np.rint(scene.intensity(-40_000, 80_000, 1 / carrier_hz)[0] * 2**bits) / 2**bits
    fine = (np.arange(200 * 1000) + 0.5) / 1000
    cycle = fine * DT * carrier_hz
    on = cycle % 1 < duty[np.floor(cycle).astype(int) + 40_000]
    np.testing.assert_allclose(drives[700:900], on.reshape(200, 1000).mean(axis=1), atol=0.02)
    assert drives.mean() == pytest.approx(scene.intensity(-700, 3000).mean(), rel=0.02)


def test_a_nonlinear_led_bends_once():
    for level in (0.1, 0.5, 1.0):
        expected = 0.8 * (1 - np.exp(-level / 0.8))
        dn = read(flat(level, effects("led_nonlinearity")), 300).pixels - 300.0
        np.testing.assert_allclose(dn, expected * FLAT, atol=0.6)


def test_led_rise_and_fall_follow_the_exponentials():
    rise, fall = 0.7, 1.9

    class Pulse:
        def bits(self, start, length):
            t = np.arange(start, start + length)
            return ((t >= 0) & (t < 5)).astype(np.uint8)

    listed = effects("led_rise_fall", rise_s=rise * DT, fall_s=fall * DT)
    camera = bench(flat(listed=listed)).camera("a", LIT)
    light = through(camera, Illumination.of(build_scene(flat(), N, DT), Pulse())).light(-3, 20)[0]
    fine = (np.arange(20 * 2000) + 0.5) / 2000 - 3
    peak = 1 - np.exp(-5 / rise)
    exact = np.where(fine < 5, 1 - np.exp(-np.maximum(fine, 0) / rise), peak * np.exp(-(fine - 5) / fall))
    np.testing.assert_allclose(light, exact.reshape(20, 2000).mean(axis=1), atol=1e-6)


def test_jitter_has_its_histogram_and_moves_light_between_neighbours():
    config = flat(listed=effects("trigger_jitter")).effects[0]
    delay = jitter(config, setting())
    steps = delay(-5000, 200_000)
    assert steps.std() == pytest.approx(0.1, rel=0.02)
    assert steps.mean() == pytest.approx(0, abs=0.001)
    assert (np.abs(steps) < 0.1).mean() == pytest.approx(0.683, abs=0.005)
    assert abs(np.corrcoef(steps[:-1], steps[1:])[0, 1]) < 0.01
    camera = bench(flat(listed=effects("trigger_jitter"))).camera("a", CODE)
    ideal = Illumination.of(build_scene(flat(), N, DT), CODE)
    moved = through(camera, ideal).light(100, 20_000)[0] - ideal.light(100, 20_000)[0]
    # Light until x is piecewise linear; a step gathers what falls between its late beginning and late end.
    until = np.concatenate([[0], np.cumsum(CODE.bits(99, 20_002), dtype=float)])
    edges = np.arange(1, 20_002) + delay(100, 20_001)
    gathered = np.diff(np.interp(edges, np.arange(len(until)), until))
    np.testing.assert_allclose(moved, gathered - CODE.bits(100, 20_000), atol=1e-9)
    assert moved.std() > 0.05


def test_late_light_is_shared_with_the_next_sub_steps_and_the_trigger_compensates_it():
    late = flat(listed=effects("delays", light_s=1.4 * DT, a_s=0.0, b_s=0.3 * DT))
    plain = read(flat(), code=CODE)
    for arm, delay in (("a", 1.4), ("b", 1.1)):
        light = bench(late).camera(arm, CODE)
        seen = light.read(512, 2048).pixels.astype(float)
        bits = CODE.bits(0, 8192).astype(float)
        index = S * np.arange(512, 2560)[:, None, None] + np.arange(N)[:, None] + np.arange(S)
        whole, part = int(delay), delay - int(delay)
        shared = (1 - part) * bits[index - whole] + part * bits[index - whole - 1]
        expected = 300.0 + S * shared.sum(axis=(1, 2))
        np.testing.assert_allclose(seen, np.broadcast_to(expected[:, None], seen.shape), atol=0.51)
    settled = replace(bench(late), settled_s={"a": 1.4 * DT, "b": 1.1 * DT})
    for arm in "ab":
        np.testing.assert_array_equal(settled.camera(arm, CODE).read(512, 2048).pixels, plain.pixels)


def test_light_in_part_of_a_sub_step():
    """On from 0.25 to 0.65 of it: so much of the light, shared as a pulse lies that comes late."""
    pulsed = replace(bench(flat()), lit_part=(0.25, 0.65))
    late = flat(listed=effects("delays", light_s=1.5 * DT, a_s=0.0, b_s=0.6 * DT))
    bits = CODE.bits(0, 8192).astype(float)
    index = S * np.arange(512, 1024)[:, None, None] + np.arange(N)[:, None] + np.arange(S)
    for arm, part in (("a", 0.15 / 0.4), ("b", 0.0)):  # late by 1.5 and by 0.9 sub-steps
        seen = pulsed.camera(arm, CODE).read(512, 512).pixels.astype(float)
        expected = 300.0 + 0.4 * S * bits[index].sum(axis=(1, 2))
        np.testing.assert_allclose(seen, np.broadcast_to(expected[:, None], seen.shape), atol=0.51)
        seen = replace(bench(late), lit_part=(0.25, 0.65)).camera(arm, CODE).read(512, 512).pixels
        shared = (1 - part) * bits[index - 1] + part * bits[index - 2]
        expected = 300.0 + 0.4 * S * shared.sum(axis=(1, 2))
        np.testing.assert_allclose(seen, np.broadcast_to(expected[:, None], seen.shape), atol=0.51)
    for kind in ("led_rise_fall", "trigger_jitter"):
        with pytest.raises(UsageError, match=f"effect {kind!r} cannot be simulated with light"):
            replace(bench(flat(listed=effects(kind))), lit_part=(0.0, 0.5)).camera("a", CODE)


def test_jitter_of_the_arms_differs_and_wrong_bits_are_common():
    jittered, wrong = blinking(effects("trigger_jitter")), flat(listed=effects("code_errors"))
    lines = [bench(wrong).camera(arm, CODE).read(512, 256).pixels for arm in "ab"]
    np.testing.assert_array_equal(*lines)  # a flat scene is the same for both arms
    steps = [jitter(jittered.effects[0], setting(arm=arm))(0, 4000) for arm in "ab"]
    assert abs(np.corrcoef(*steps)[0, 1]) < 0.05


# Signal


def test_hot_columns_add_electrons_and_dead_ones_have_none():
    listed = effects("column_defects", hot=2, hot_e=300.0, dead=1)
    seen, plain = electrons(flat(0.5, listed)), electrons(flat(0.5))
    added = seen.mean(axis=0) - plain.mean(axis=0)
    assert np.count_nonzero(np.abs(added) > 100) == 3
    hot = added > 100
    np.testing.assert_allclose(added[hot], 300, atol=6)
    np.testing.assert_allclose(seen[:, hot].std(axis=0), np.sqrt(300), rtol=0.1)
    assert np.count_nonzero(seen.max(axis=0) == 0) == 1
    again = electrons(flat(0.1, listed)).mean(axis=0) - electrons(flat(0.1)).mean(axis=0)
    np.testing.assert_array_equal(again > 100, hot)


def test_drift_moves_offset_and_gain_hour_by_hour():
    listed = effects("drift", hours=2.0, offset_dn_per_hour=3.0, gain_per_hour=0.01)
    assert read(flat(0.0, listed)).pixels.mean() == pytest.approx(306.0, abs=0.51)
    assert read(flat(1.0, listed)).pixels.mean() == pytest.approx(306.0 + 1.02 * FLAT, abs=1.01)
    lines_per_hour = round(3600 / (S * DT))
    later = read(flat(1.0, listed), count=8, first=lines_per_hour).pixels
    assert later.mean() == pytest.approx(309.0 + 1.03 * FLAT, abs=1.01)


def test_a_bowed_converter_is_right_at_both_ends():
    listed, white = effects("adc_nonlinearity", bow=0.03), 65535 - 300
    for level, part in ((0.0, 0.0), (0.5, 0.5 * FLAT * 60 / white)):
        straight = 300 + part * white
        bent = read(flat(level, listed), responsivity_dn=60.0).pixels.mean()
        assert bent == pytest.approx(straight + 4 * 0.03 * white * part * (1 - part), abs=1.01)
    top = read(flat(1.0, listed), responsivity_dn=white / FLAT).pixels
    assert top.mean() == pytest.approx(65535, abs=1)


def test_a_beam_splitter_gives_each_arm_its_part():
    for arm, part in (("a", 0.45), ("b", 0.55)):
        dn = read(flat(1.0, effects("beam_splitter")), 10, arm=arm).pixels - 300.0
        np.testing.assert_allclose(dn, 2 * part * FLAT, atol=0.51)


def test_the_tail_of_charge_transfer():
    """A single lit line, then darkness: the tail is negative binomial, and no charge is lost."""
    epsilon = 1e-3
    weights = tail(epsilon, N)
    for k in range(4):
        exact = [comb(m + k - 1, k) * (1 - epsilon) ** m * epsilon**k for m in range(1, N + 1)]
        assert weights[k] == pytest.approx(np.mean(exact), rel=1e-9)
    assert weights.sum() == pytest.approx(1, abs=1e-8)
    first_moment = (np.arange(len(weights)) * weights).sum()
    assert first_moment == pytest.approx(epsilon / (1 - epsilon) * (N + 1) / 2, rel=1e-6)

    class Flash:
        def bits(self, start, length):
            return (np.arange(start, start + length) == 3 * 700).astype(np.uint8)

    changes = {"responsivity_dn": 5000.0, "black_level_dn": 0.0}
    scene = [flat(1.0, listed) for listed in ((), effects("cti"))]
    bare, moved = (read(one, 80, Flash(), first=680, **changes).pixels.astype(float) for one in scene)
    expected = sum(weights[k] * np.roll(bare, k, axis=0) for k in range(len(weights)))
    np.testing.assert_allclose(moved, expected, atol=0.51)
    assert moved.sum() == pytest.approx(bare.sum(), rel=1e-4)
    last = np.flatnonzero(bare[:, 0])[-1]
    assert moved[last + 1, 0] == pytest.approx(weights[1] * bare[last, 0], rel=0.3)


# Stream


def test_lines_are_dropped_at_their_rate_and_reported():
    lines = read(blinking(effects("dropped_lines")), 20_000, CODE)
    assert lines.missing.mean() == pytest.approx(0.02, rel=0.15)
    assert (lines.pixels[lines.missing] == 0).all()
    kept = ~lines.missing
    np.testing.assert_array_equal(lines.pixels[kept], read(blinking(), 20_000, CODE).pixels[kept])


def test_duplicated_lines_repeat_the_line_before_at_their_rate_across_tiles_too():
    noise = effects("read_noise")
    bare = read(blinking(noise), 20_001, CODE, first=511).pixels
    lines = read(blinking(noise + effects("duplicated_lines")), 20_000, CODE).pixels
    twice = (lines != bare[1:]).any(axis=1)
    assert twice.mean() == pytest.approx(0.02, rel=0.15)
    np.testing.assert_array_equal(lines[twice], bare[:-1][twice])
    at = np.flatnonzero(twice) + 512
    assert (at % 256 == 0).any()
