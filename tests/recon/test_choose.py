"""The default chooses its prior without the truth: for motion, rest, blinking and flicker, with noise."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from threading import Event

import numpy as np
import pytest
from hypothesis import given, settings
from recon_cases import Wall, cases, given_for

from acquire.alignment import Alignment
from acquire.blur import Blur
from acquire.codes import mix_seed, prbs
from acquire.evaluate.metrics import psnr
from acquire.forward import DualArm, merge_video
from acquire.geometry import Geometry
from acquire.lines import Segment
from acquire.recon import Progress, api, blinking, clock, cosines, reconstruct
from acquire.recon.admm import Admm
from acquire.recon.band import BandOperator
from acquire.recon.bandwidth import light_beyond
from acquire.recon.basis import TemporalBasis
from acquire.recon.brightness import fit_brightness
from acquire.recon.holdout import HeldOut
from acquire.recon.problem import build_problem
from acquire.recon.reuse import Choice
from acquire.recon.workbench import LAST_ITERATIONS
from acquire.sim.procedural import CLEAN, record

GEOMETRY = Geometry(16, 3, 120)
CODE = prbs(31, mix_seed(5, 31), 0, GEOMETRY.span)
FULL_WELL_E, READ_NOISE_E = 1e4, 10.0
BRIGHTNESS = 1 + 0.6 * np.sin(2 * np.pi * 7 * np.arange(GEOMETRY.span) / GEOMETRY.span)


def ground() -> np.ndarray:
    rng = np.random.default_rng(1)
    return 0.4 + 0.5 * rng.integers(0, 2, (8, 8)).repeat(6, axis=0).repeat(6, axis=1)


def light(kind: str) -> np.ndarray:
    n, y, x = GEOMETRY.size, *np.meshgrid(*[np.arange(GEOMETRY.size)] * 2, indexing="ij")
    time = np.linspace(0, 1, GEOMETRY.span)
    if kind == "still":
        return np.broadcast_to(ground(), (GEOMETRY.span, n, n)).astype(np.float32)
    if kind == "flash":
        flash = 2 * np.exp(-((y - 20) ** 2 + (x - 30) ** 2) / 32)
        lit = (time > 0.44) & (time < 0.46)
        return (0.5 * ground() + lit[:, None, None] * flash).astype(np.float32)
    if kind == "flicker":
        return (BRIGHTNESS[:, None, None] * ground()).astype(np.float32)
    ball = [np.hypot(y - 24, x - (8 + 32 * t)) < 7 for t in time]
    return np.where(ball, 0.9, 0.1 if kind == "moving" else ground()).astype(np.float32)


@cache
def segment(kind: str, full_well_e: float = FULL_WELL_E, code_seed: int = 5) -> Segment:
    rng = np.random.default_rng(9)
    code = prbs(31, mix_seed(code_seed, 31), 0, GEOMETRY.span)
    exact = DualArm(GEOMETRY, code).forward(light(kind)).astype(np.float64)
    per_e = full_well_e / exact.max()
    electrons = rng.poisson(exact * per_e) + READ_NOISE_E * rng.standard_normal(exact.shape)
    return Segment(
        lines=electrons.astype(np.float32),
        mask=np.ones(exact.shape, bool),
        code=code,
        geometry=GEOMETRY,
        time_ns=np.arange(GEOMETRY.lines) * 30_000,
        responsivity_dn=per_e,
    )


def quality_db(kind: str, video: np.ndarray) -> float:
    frames = GEOMETRY.trusted_frames(1)
    return psnr(video[frames], merge_video(light(kind), 3, 1)[frames].astype(np.float32))


@pytest.mark.parametrize(("kind", "prior", "least_db"), [("moving", "volume", 27), ("still", "still", 30)])
def test_the_prior_suits_the_scene(kind: str, prior: str, least_db: float) -> None:
    result = reconstruct(segment(kind), 3, 1)
    assert result.parameters["prior"] == prior
    assert quality_db(kind, result.video) > least_db
    tried = result.parameters["candidates"]
    assert {"still", "volume", "smooth", "cosines"} <= {each["prior"] for each in tried}
    assert result.quality.prediction <= min(each["error"] for each in tried) * 1.1


@pytest.mark.parametrize("code_seed", [5, 8, 10])
def test_a_scene_that_flickers_as_a_whole_is_a_video_times_its_brightness(code_seed: int) -> None:
    result = reconstruct(segment("flicker", code_seed=code_seed), 3, 1)
    frames = GEOMETRY.trusted_frames(1)
    seen = result.video[frames].mean((1, 2))
    assert np.corrcoef(seen, BRIGHTNESS[frames])[0, 1] > 0.99
    assert quality_db("flicker", result.video) > 32


def test_a_brightness_of_more_cosines_than_there_are_frames_can_be_handed_over() -> None:
    choice = Choice("volume", 8, 2e-3, 16.0, error=0.02, noise=0.0, brightness=GEOMETRY.span)
    result = reconstruct(segment("flicker"), 3, 24, "fast", choice=choice, check=False, error=False)
    assert np.isfinite(result.video).all()
    assert any(each.get("brightness") for each in result.parameters["candidates"])


@pytest.mark.parametrize("code_seed", [6, 7])
def test_a_still_with_a_flash_in_front_shows_no_trace_of_the_code(code_seed: int) -> None:
    lines, frames = segment("flash", code_seed=code_seed), GEOMETRY.trusted_frames(1)
    still = reconstruct(lines, 3, GEOMETRY.span, "fast", check=False).video
    result = reconstruct(lines, 3, 1, "fast", check=False)
    repeated = np.broadcast_to(still, result.video.shape)
    # Rounding decides which patterns remain: eight versions of the lines of code 7, whose samples differ by
    # 1e-7, are 0 to 2.8 dB below the still.
    assert quality_db("flash", result.video) > quality_db("flash", repeated) - 3.5
    truth = light("flash")[frames].mean((1, 2))
    off = result.video[frames].mean((1, 2)) - truth
    assert off.std() < 0.2 * truth.mean()


def test_a_flickering_scene_is_recognised_even_if_cosines_are_ahead() -> None:
    recorded = record("flicker", 23, stages=32, lines=160)
    result = reconstruct(recorded.segment, 2, 8, "fast", check=False)
    tried = result.parameters["candidates"]
    ahead = min(each["error"] for each in tried if each["prior"] == "cosines")
    assert ahead < 0.6 * min(each["error"] for each in tried[:2])
    assert result.parameters["brightness"]
    assert psnr(result.video[result.trusted], recorded.truth(2, 8)) > 22


def test_a_wider_band_that_explains_little_more_is_not_worth_its_noise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Cosines without patterns admit noise that the lines hardly show: of 358, 17 dB instead of 23."""
    # its lamps alone leave too little for a wider band
    monkeypatch.setattr(blinking, "pursue", lambda *_: None)
    monkeypatch.setattr(blinking, "find_lamps", lambda *_: [])
    # whether the lines show light beyond the band is here a matter of rounding
    monkeypatch.setattr(blinking, "light_beyond", lambda *_: 160)
    recorded = record("leds_dot", 35, stages=32, lines=160, camera=CLEAN)
    result = reconstruct(recorded.segment, 3, 1, check=False, error=False)
    assert result.parameters["temporal_coefficients"] < 100
    assert psnr(result.video[result.trusted], recorded.truth(3, 1)) > 22
    assert any("Hz, faster than the band" in warning for warning in result.warnings)


@pytest.mark.parametrize("code_seed", [46, 55])
def test_flicker_before_which_something_moves_is_followed_with_other_codes(code_seed: int) -> None:
    recorded = record("flicker", code_seed, stages=32, lines=200)
    result = reconstruct(recorded.segment, 2, 4, check=False)
    assert result.parameters["brightness"]
    assert psnr(result.video[result.trusted], recorded.truth(2, 4)) > 22


def test_a_wide_band_does_not_take_the_time_of_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    recorded = record("traffic", 41, stages=24, lines=140)
    frames, wall, iterate = recorded.segment.geometry.span, Wall(), Admm.step
    each_s = 10 / (80 * frames // 4 * 24**2)  # 80 iterations in the band take the budget

    def step(admm: Admm) -> None:
        wall.now += each_s * admm.theta.size
        iterate(admm)

    for module in (clock, api):
        monkeypatch.setattr(module, "time", wall)
    monkeypatch.setattr(Admm, "step", step)
    monkeypatch.setattr(cosines, "estimate_coefficients", lambda *_, **__: frames // 4)
    result = reconstruct(recorded.segment, 3, 1, budget_s=10, refuse=False, check=False, error=False)
    tried = [each["prior"] for each in result.parameters["candidates"]]
    assert result.parameters["prior"] == "volume"
    assert tried.count("volume") >= 4, "2 if the band is solved in first"


@pytest.mark.parametrize(("preset", "code_seed", "least_db"), [("fast", 40, 33), ("balanced", 37, 35)])
def test_superfluous_patterns_of_lamps_are_let_go(preset: str, code_seed: int, least_db: float) -> None:
    recorded = record("leds", code_seed, stages=32, lines=160)
    result = reconstruct(recorded.segment, 3, 1, preset, check=False, error=False)
    assert result.parameters["patterns"] == 4
    assert psnr(result.video[result.trusted], recorded.truth(3, 1)) > least_db


@pytest.mark.parametrize("made", [1, 8])
def test_patterns_cut_short_are_not_worse_than_the_first_look(made: int) -> None:
    lines, stop, stages = record("disc", 41, stages=24, lines=140).segment, Event(), list[str]()

    def watch(progress: Progress) -> None:
        stages.append(progress.stage)
        if stages.count("refine") >= made:
            stop.set()

    problem = build_problem(lines, 3, 1, hold_out=0.08)
    timed = clock.IterationClock(150, None, watch, stop)
    asked = given_for(lines, problem, (3, 1), clock=timed, bandwidth=0.2)
    first = blinking.first_look(asked)
    refined = blinking.refine(asked, first)
    assert stages.count("refine") == made
    assert problem.prediction_error(refined.predict()) <= problem.prediction_error(first.predict())


def test_the_last_iterations_have_all_samples_however_long_the_search_was() -> None:
    stages: list[str] = []
    reconstruct(segment("moving"), 3, 1, "fast", progress=lambda made: stages.append(made.stage))
    assert stages.count("solve") == LAST_ITERATIONS
    assert stages[-LAST_ITERATIONS:] == ["solve"] * LAST_ITERATIONS


def test_less_light_gives_a_smoother_picture_not_noise() -> None:
    weights = []
    for full_well_e in (1e5, 1e3):
        result = reconstruct(segment("still", full_well_e), 1, GEOMETRY.span)
        weights.append(result.parameters["weight"])
        rough = np.abs(np.diff(result.video[0], axis=0)).mean()
        assert rough < 2 * np.abs(np.diff(ground(), axis=0)).mean()
    assert weights[0] < weights[1]


@pytest.mark.parametrize("cosines", [40, 200])
def test_brightness_is_fitted_to_a_known_picture_with_any_number_of_cosines(cosines: int) -> None:
    problem = build_problem(segment("flicker"), 3, 1, hold_out=0.08)
    picture = merge_video(light("still"), 3, 1).astype(np.float32) / problem.scale
    found = fit_brightness(segment("flicker"), problem, picture, (3, 1), cosines)
    frames = GEOMETRY.trusted_frames(1)
    wanted = BRIGHTNESS / BRIGHTNESS.mean()
    assert np.abs(found - wanted)[frames].max() < 0.05


@pytest.mark.parametrize("merge", [3, 5])  # 5 does not divide 48: arm B's first block is the short one
@pytest.mark.parametrize(
    ("alignment", "blur"), [(None, None), (Alignment(rows=4.0, columns=-3.0), Blur((1.5, 0.0), (3.0, 2.0)))]
)
def test_brightness_is_fitted_to_what_each_arm_sees(
    alignment: Alignment | None, blur: Blur | None, merge: int
) -> None:
    side = GEOMETRY.video_shape(merge, 1)[1]
    picture = np.random.default_rng(4).random((side, side), np.float32)
    flickering = (BRIGHTNESS[:, None, None] * picture).astype(np.float32)
    lines = DualArm(GEOMETRY, CODE, merge, 1, alignment=alignment, blur=blur).forward(flickering)
    seen = replace(
        segment("still"), lines=lines, responsivity_dn=1.0, code=CODE, alignment=alignment, blur=blur
    )
    problem = build_problem(seen, merge, 1, hold_out=0.08)
    video = np.broadcast_to(picture / problem.scale, flickering.shape)
    for one in (video, video.copy()):
        found = fit_brightness(seen, problem, one, (merge, 1), 40)
        wanted = BRIGHTNESS / BRIGHTNESS.mean()
        assert np.abs(found - wanted)[GEOMETRY.trusted_frames(1)].max() < 0.02


def test_light_beyond_the_band_stands_out_of_the_residual() -> None:
    problem = build_problem(segment("still"), 3, 1, hold_out=0.0)
    swing = np.cos(np.pi * 50 * (np.arange(GEOMETRY.span) + 0.5) / GEOMETRY.span)
    lamp = np.zeros((GEOMETRY.size, GEOMETRY.size), np.float32)
    lamp[10:20, 12:25] = 0.3
    fast = DualArm(GEOMETRY, CODE).forward((swing[:, None, None] * lamp).astype(np.float32))
    scaled = fast / (problem.scale * problem.norm)
    assert light_beyond(segment("still"), problem, problem.samples - scaled, 1, 32) == 50
    noise = np.random.default_rng(3).standard_normal(scaled.shape) * scaled.std()
    assert light_beyond(segment("still"), problem, problem.samples - noise, 1, 32) is None


@settings(max_examples=25, deadline=None)
@given(case=cases())
def test_the_approximate_inverse_is_exact_per_arm_if_pixels_share_no_voxel(
    case: tuple[Geometry, int, int, int, int],
) -> None:
    geometry, _, T_m, count, seed = case
    rng = np.random.default_rng(seed)
    code = rng.integers(0, 2, geometry.span).astype(np.uint8)
    frames = geometry.video_shape(geometry.substeps, T_m)[0]
    basis = TemporalBasis(frames, min(count, frames))
    operator = BandOperator(geometry, code, basis, geometry.substeps, T_m)
    lines = np.zeros(geometry.lines_shape, np.float32)
    lines[0] = rng.standard_normal(lines[0].shape)
    damping = 0.5
    back = operator.near_inverse(damping)(lines)
    again = operator.forward(operator.adjoint(np.stack([back[0], 0 * back[0]])))[0] + damping * back[0]
    np.testing.assert_allclose(again, lines[0], atol=2e-3 * max(1.0, float(np.abs(back).max())))


def test_blocks_outside_the_trusted_frames_do_not_count() -> None:
    problem = build_problem(segment("still"), 3, 1, hold_out=0.3)
    held_out = HeldOut(problem, GEOMETRY)
    wrong = problem.samples.copy()
    wrong[:, 0] += 1  # this line ends where the trusted interval begins
    assert held_out.relative(held_out.errors(wrong)) < 0.02 * held_out.relative(
        held_out.errors(problem.samples + 1)
    )
    assert held_out.clearly_less(held_out.errors(problem.samples), held_out.errors(problem.samples + 1))


def test_few_frames_of_fast_lamps_are_not_salt_and_pepper() -> None:
    whole = record("leds", 32, stages=32, lines=200)
    T_m = -(-whole.segment.geometry.span // 5)
    result = reconstruct(whole.segment, 1, T_m, "fast", check=False)
    assert psnr(result.video[result.trusted], whole.truth(1, T_m)) > 8, "0.1 dB from usual weights"
