"""Patterns and curves, the search for the bandwidth, warm starts, a known image, denoisers, and a stop."""

from __future__ import annotations

import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from recon_cases import given_for

from acquire.alignment import Alignment
from acquire.blur import Blur
from acquire.codes import mix_seed, prbs
from acquire.errors import UsageError
from acquire.forward import DualArm
from acquire.geometry import Geometry
from acquire.lines import Segment
from acquire.noise import Noise
from acquire.recon import HaarShrink, Progress, reconstruct
from acquire.recon.bandwidth import FEWEST_COEFFICIENTS, estimate_coefficients
from acquire.recon.basis import TemporalBasis
from acquire.recon.blinking import _for_noise
from acquire.recon.curves import CurveFit, CurveOperator
from acquire.recon.lamps import _whitened, last_lamp
from acquire.recon.patterns import PARAMETERS, Patterns, Refinement, find_patterns
from acquire.recon.problem import build_problem
from acquire.recon.settling import _without_superfluous

GEOMETRY = Geometry(12, 3, 72)
CODE = prbs(64, mix_seed(3, 64), 0, GEOMETRY.span)
IMAGES = np.zeros((2, 36, 36), np.float32)
IMAGES[0, 4:19, 4:19] = 1
IMAGES[1, 20:33, 10:31] = 1
INSTANTS = np.arange(GEOMETRY.span)
LIGHT = 0.5 + 0.4 * np.sin(2 * np.pi * np.outer((1 / 120, 1 / 45), INSTANTS)).astype(np.float32)
TRUTH = np.einsum("kt,krc->trc", LIGHT, IMAGES)


def segment(video: np.ndarray = TRUTH) -> Segment:
    return Segment(
        lines=DualArm(GEOMETRY, CODE).forward(video.astype(np.float32)),
        mask=np.ones(GEOMETRY.lines_shape, bool),
        code=CODE,
        geometry=GEOMETRY,
        time_ns=np.arange(GEOMETRY.lines, dtype=np.int64) * 30_000,
    )


OFF, BLUR = Alignment(1.5, -0.7, 3.0, 1.02), Blur((0.8, 0.3), (1.4, 0.0), veil=(0.02, 0.05))


@pytest.mark.parametrize(
    ("merge", "off", "blur"),
    [(1, None, None), (4, None, None), (7, None, None), (4, OFF, None), (1, None, BLUR), (4, OFF, BLUR)],
)
def test_curve_operator_is_the_sensing_matrix_of_the_patterns(
    merge: int, off: Alignment | None, blur: Blur | None
) -> None:
    frames = GEOMETRY.video_shape(1, merge)[0]
    cosines = TemporalBasis(frames, min(9, frames))
    operator = CurveOperator(replace(segment(), alignment=off, blur=blur), IMAGES, cosines, merge)
    rng = np.random.default_rng(0)
    curves = rng.standard_normal((cosines.count, 2)).astype(np.float32)
    video = np.tensordot(cosines.synthesize(curves), IMAGES, 1).astype(np.float32)
    expected = DualArm(GEOMETRY, CODE, 1, merge, alignment=off, blur=blur).forward(video)
    np.testing.assert_allclose(operator.forward(curves), expected, rtol=1e-4, atol=1e-3)
    lines = rng.standard_normal(GEOMETRY.lines_shape).astype(np.float32)
    left, right = np.vdot(operator.forward(curves), lines), np.vdot(curves, operator.adjoint(lines))
    assert left == pytest.approx(right, rel=1e-4)
    unit = np.eye(2 * cosines.count, dtype=np.float32).reshape(-1, 2, cosines.count).transpose(0, 2, 1)
    matrix = np.stack([operator.forward(e).ravel() for e in unit], axis=1).astype(np.float64)
    np.testing.assert_allclose(
        operator.gram(), matrix.T @ matrix, rtol=1e-3, atol=1e-4 * np.abs(matrix).max() ** 2
    )


def test_curves_of_known_patterns_are_exact_even_if_samples_are_lost() -> None:
    holed = segment()
    holed.mask[0, 20:24] = False
    cosines = TemporalBasis(GEOMETRY.span, 40)
    problem = build_problem(holed, 1, 1, hold_out=0.0)
    wanted = cosines.analyze((LIGHT.T / problem.scale).astype(np.float32))
    held = segment(np.tensordot(cosines.synthesize(wanted) * problem.scale, IMAGES, 1))
    problem = replace(problem, samples=np.where(holed.mask, held.lines / (problem.scale * problem.norm), 0))
    problem = replace(problem, samples=problem.samples.astype(np.float32))
    found = CurveFit(holed, problem, cosines, 1)(IMAGES, np.zeros(wanted.shape))
    seen = cosines.synthesize(found.astype(np.float32))[GEOMETRY.trusted]
    np.testing.assert_allclose(seen, cosines.synthesize(wanted)[GEOMETRY.trusted], atol=0.02 / problem.scale)


def test_a_learnt_prior_keeps_noise_out_of_the_curves_and_leaves_exact_lines_alone() -> None:
    """40 cosines, of which two lamps need a few: the others hold noise only, which the prior removes."""
    cosines, rng = TemporalBasis(GEOMETRY.span, 40), np.random.default_rng(5)
    wanted = cosines.analyze(LIGHT.T)
    exact = segment(np.tensordot(cosines.synthesize(wanted), IMAGES, 1))

    def error(recorded: Segment, *, learns: bool) -> float:
        problem = build_problem(recorded, 1, 1, hold_out=0.0)
        fit = CurveFit(recorded, problem, cosines, 1, learns=learns)
        curves = 0.5 * wanted / problem.scale
        for _ in range(12):
            curves = fit(IMAGES, curves)
        shown = cosines.synthesize((curves * problem.scale - wanted).astype(np.float32))
        return float(np.sqrt(np.square(shown[GEOMETRY.trusted]).mean()))

    noise = 0.02 * exact.lines.max() * rng.standard_normal(exact.lines.shape).astype(np.float32)
    noisy = replace(exact, lines=exact.lines + noise)
    assert error(noisy, learns=True) < 0.7 * error(noisy, learns=False)
    assert error(exact, learns=True) < 2e-3


def test_light_at_cosines_that_were_not_solved_for_is_found_by_the_curves() -> None:
    """A first look at lamps leaves the cosines between them at 0, of which no prior may be made."""
    cosines, rng = TemporalBasis(GEOMETRY.span, 40), np.random.default_rng(5)
    wanted = cosines.analyze(LIGHT.T)
    exact = segment(np.tensordot(cosines.synthesize(wanted), IMAGES, 1))
    noise = 0.01 * exact.lines.max() * rng.standard_normal(exact.lines.shape).astype(np.float32)
    noisy = replace(exact, lines=exact.lines + noise)
    problem = build_problem(noisy, 1, 1, hold_out=0.0)
    fit = CurveFit(noisy, problem, cosines, 1, learns=True)
    curves = wanted / problem.scale
    # from the fifth to the eighth strongest
    gap = np.isin(np.arange(40), np.argsort(np.square(wanted).sum(1))[-8:-4])
    curves[gap] = 0
    for _ in range(12):
        curves = fit(IMAGES, curves)
    missed = np.linalg.norm((curves * problem.scale - wanted)[gap]) / np.linalg.norm(wanted[gap])
    assert missed < 0.3


def test_a_pattern_too_many_is_recognised_and_one_of_the_scene_is_not() -> None:
    problem, cosines = build_problem(segment(), 3, 1, hold_out=0.08), TemporalBasis(GEOMETRY.span, 40)
    asked = given_for(segment(), problem, (3, 1))
    curves, size = np.linalg.qr(cosines.analyze(LIGHT.T))
    voxels = IMAGES.reshape(2, 12, 3, 12, 3).mean((2, 4))
    scene = np.tensordot(size, voxels, 1).astype(np.float32) / problem.scale
    rng = np.random.default_rng(6)
    other = np.linalg.qr(np.column_stack([curves, rng.standard_normal(40)]))[0]
    faint = 0.03 * np.abs(scene).max() * rng.random((1, 12, 12))
    for found, needed in (
        (Patterns(curves.astype(np.float32), scene), 2),
        (Patterns(other.astype(np.float32), np.concatenate([scene, faint]).astype(np.float32)), 2),
    ):
        refinement = Refinement(asked, cosines, found)
        for _ in range(10):
            refinement.step()
        before = refinement.predict()
        fewer = refinement.needed()
        assert fewer.curves.shape[1] == needed
        other = refinement.restricted(fewer)
        for _ in range(10):
            other.step()
        np.testing.assert_array_equal(refinement.predict(), before)
        assert problem.prediction_error(other.predict()) < problem.prediction_error(before)
        assert _without_superfluous(asked, refinement).rank == needed


def test_a_scene_of_two_patterns_is_recognised_and_amplitudes_are_kept() -> None:
    result = reconstruct(segment(), 3, 1, "best", iterations=120)
    assert 2 <= result.parameters["patterns"] <= 8
    region = result.video[result.trusted][:, 7:10, 5:9].mean((1, 2))
    assert np.ptp(region) == pytest.approx(np.ptp(LIGHT[1, GEOMETRY.trusted]), rel=0.1)


def test_noise_is_not_a_few_patterns() -> None:
    frames = np.random.default_rng(0).standard_normal((40, 12, 12)).astype(np.float32)
    assert find_patterns(frames) is None
    assert find_patterns(frames[:10]) is None


def spectrum(*singular: float) -> np.ndarray:
    """Coefficient frames (40, 12, 12) whose singular values begin with these and go on at 0.009."""
    rng = np.random.default_rng(1)
    left, right = (np.linalg.qr(rng.standard_normal((size, 40)))[0] for size in (40, 144))
    values = np.full(40, 0.009)
    values[: len(singular)] = singular
    return ((left * values) @ right.T).reshape(40, 12, 12).astype(np.float32)


@pytest.mark.parametrize(
    ("singular", "rank"),
    [
        ((1, 0.27, 0.2, 0.12, 0.034, 0.026), 4),  # a gap: what follows stands out, but not as a scene
        ((1, 0.5, 0.3, 0.2, 0.12, 0.08, 0.05), 7),  # no gap but the last
        ((1, 0.1, 0.09, 0.08, 0.032, 0.031, 0.012), 6),  # the still does not hide what moves before it
    ],
)
def test_patterns_end_at_a_gap_that_leaves_little_out(singular: tuple[float, ...], rank: int) -> None:
    found = find_patterns(spectrum(*singular))
    assert found is not None
    assert len(found.patterns) == rank


@pytest.mark.parametrize(
    ("singular", "rank"),
    [
        ((40, 6.6, 4.5, 2.8), 4),  # the fourth is hardly above the noise, which has twenty in all
        ((80, 17, 10, 7, 2.4), 4),  # the fifth follows a gap
        ((40,), 1),
        ((), None),
    ],
)
def test_lamps_are_found_in_noise(singular: tuple[float, ...], rank: int | None) -> None:
    """Their singular values are given relative to the sixteenth of the noise."""
    rng = np.random.default_rng(8)
    noise = rng.standard_normal((128, 1024))
    left, right = (np.linalg.qr(rng.standard_normal((size, 12)))[0] for size in noise.shape)
    values = np.zeros(12)
    values[: len(singular)] = singular
    floor = np.linalg.svd(noise - left @ (left.T @ noise), compute_uv=False)[15 - len(singular)]
    found = find_patterns(((left * values) @ right.T * floor + noise).reshape(128, 32, 32).astype(np.float32))
    assert (None if found is None else len(found.patterns)) == rank


def test_the_patterns_total_variation_begins_with_the_noise() -> None:
    clean = segment()
    lines = clean.lines / clean.lines.max() * 4000

    def weight(full_well: float, *, known: bool = True) -> float:
        gain = 4000 / full_well
        shot = np.random.default_rng(7).poisson(lines / gain) * gain
        noise = Noise((gain, gain), (1.0, 1.0)) if known else None
        recorded = replace(clean, lines=shot.astype(np.float32), noise=noise)
        problem = build_problem(recorded, 3, 1, hold_out=0.3)
        exact = SimpleNamespace(predict=lambda: lines / (problem.scale * problem.norm))
        return _for_noise(given_for(recorded, problem, (3, 1)), exact).tv_weight

    assert weight(1e7) == weight(1e6) == PARAMETERS.tv_weight
    assert weight(1e3) > PARAMETERS.tv_weight
    assert weight(2.5e2) == pytest.approx(2 * weight(1e3), rel=0.1)
    assert weight(1e3, known=False) == pytest.approx(0.7 * weight(1e3), rel=0.1)


def test_more_iterations_do_not_spoil_the_picture() -> None:
    """Not even if more patterns are found than exist, in a scene this small: the loss is below 3 dB."""
    wanted = TRUTH.reshape(-1, 12, 3, 12, 3).mean((2, 4))[GEOMETRY.trusted]
    noise = np.random.default_rng(5).normal(0, 0.3, GEOMETRY.lines_shape)
    noisy = replace(segment(), lines=segment().lines + noise)

    def error(iterations: int) -> float:
        result = reconstruct(noisy, 3, 1, iterations=iterations)
        return float(np.mean((result.video[result.trusted] - wanted) ** 2))

    assert error(400) <= 2 * error(120)


def test_the_bandwidth_is_found_from_the_lines() -> None:
    def found(recorded: Segment, temporal_merge: int = 1) -> int:
        problem = build_problem(recorded, 3, temporal_merge, hold_out=0.0)
        return estimate_coefficients(recorded, problem, (3, temporal_merge))

    slow = found(segment())
    assert 32 <= slow <= 40
    fast = TRUTH * (0.5 + 0.5 * np.sin(2 * np.pi * INSTANTS / 9))[:, None, None]
    assert found(segment(fast)) > slow
    assert found(segment(), 50) == GEOMETRY.video_shape(3, 50)[0]


@pytest.mark.parametrize("coarse", [3, 36])
def test_lamps_are_searched_for_in_a_fast_scene(monkeypatch: pytest.MonkeyPatch, coarse: int) -> None:
    fast = segment(TRUTH * (0.5 + 0.5 * np.sin(2 * np.pi * INSTANTS / 9))[:, None, None])
    problem, needed = build_problem(fast, 3, 1, hold_out=0.0), 2 * GEOMETRY.span / 9
    asked: list[float] = []
    monkeypatch.setattr("acquire.recon.bandwidth.COARSE_SIDE", coarse)
    found = estimate_coefficients(fast, problem, (3, 1), affords=lambda s: not asked.append(s))
    assert (found > needed, bool(asked)) == (True, True)
    asked.clear()
    estimate_coefficients(fast, problem, (3, 1), affords=lambda s: bool(asked.append(s)))


@pytest.mark.parametrize("coarse", [3, 36])
def test_a_slow_scene_in_fine_coarse_voxels_is_not_searched_for_lamps(
    monkeypatch: pytest.MonkeyPatch, coarse: int
) -> None:
    slow, asked = segment(np.tile(IMAGES.sum(0), (GEOMETRY.span, 1, 1))), []
    monkeypatch.setattr("acquire.recon.bandwidth.COARSE_SIDE", coarse)
    problem = build_problem(slow, 3, 1, hold_out=0.0)
    estimate_coefficients(slow, problem, (3, 1), affords=lambda s: bool(asked.append(s)))
    assert bool(asked) == (coarse == 3)


def lamp(recorded: Segment) -> int:
    return last_lamp(recorded, build_problem(recorded, 3, 1, hold_out=0.08), 1, 0.25)


def test_the_fastest_lamp_stands_out_of_the_lines_covariance() -> None:
    fast = TRUTH * (0.5 + 0.5 * np.sin(2 * np.pi * INSTANTS / 9))[:, None, None]
    assert lamp(segment(fast)) == pytest.approx(2 * GEOMETRY.span / 9, rel=0.15)


@pytest.mark.parametrize("density", [0.01, 0.99, 1.0])
def test_under_a_code_that_hardly_changes_no_fast_lamp_stands_out(density: float) -> None:
    code = (np.random.default_rng(0).random(GEOMETRY.span) < density).astype(np.uint8)
    code[100] = 1
    lines = DualArm(GEOMETRY, code).forward(TRUTH).astype(np.float32)
    assert lamp(replace(segment(), code=code, lines=lines)) < FEWEST_COEFFICIENTS


def test_a_scene_at_rest_has_no_lamp_and_lost_lines_add_none() -> None:
    still = segment(np.broadcast_to(IMAGES.sum(0), TRUTH.shape))
    noise = np.random.default_rng(7).normal(0, 0.02 * still.lines.mean(), GEOMETRY.lines_shape)
    holed = replace(still, lines=still.lines + noise)
    holed.mask[0, 20:24] = False
    holed.mask[1, 40:50, 3] = False
    assert lamp(holed) == 0


def test_lost_samples_have_no_weight_in_whitened_lines() -> None:
    rng = np.random.default_rng(0)
    half = rng.standard_normal((9, 14))
    covariance = half @ half.T
    pixels = rng.standard_normal((9, 5)).astype(np.float32)
    seen = np.ones(pixels.shape, bool)
    seen[2:4, :2] = seen[7, 3] = False
    found = _whitened(np.linalg.inv(covariance).astype(np.float32), pixels, seen)
    for kept, pixel, white in zip(seen.T, pixels.T, found.T, strict=True):
        wanted = np.linalg.solve(covariance[np.ix_(kept, kept)], pixel[kept])
        np.testing.assert_allclose(white[kept], wanted, rtol=1e-3, atol=1e-3)
        assert not white[~kept].any()


def test_a_warm_start_continues_the_last_result() -> None:
    first = reconstruct(segment(), 3, 1, iterations=50)
    cold = reconstruct(segment(), 3, 1, iterations=2)
    warm = reconstruct(segment(), 3, 1, iterations=2, initial=first.video)
    truth = TRUTH.reshape(-1, 12, 3, 12, 3).mean((2, 4))

    def error(video: np.ndarray) -> float:
        return float(np.mean((video - truth)[GEOMETRY.trusted] ** 2))

    assert error(warm.video) < 0.7 * error(cold.video)


def test_the_light_of_a_known_image_is_recovered() -> None:
    light = np.random.default_rng(2).random(GEOMETRY.span).astype(np.float32)
    image = IMAGES.sum(0) + 0.2
    result = reconstruct(segment(light[:, None, None] * image), 3, 1, static_image=5 * image)
    lit = np.flatnonzero(CODE[GEOMETRY.trusted])
    found = result.video[result.trusted].mean((1, 2))[lit] / image.mean()
    np.testing.assert_allclose(found, light[GEOMETRY.trusted][lit], atol=0.05)


def test_another_denoiser_replaces_total_variation() -> None:
    result = reconstruct(segment(), 3, 1, iterations=30, denoiser=HaarShrink())
    assert "patterns" not in result.parameters
    assert result.quality.prediction < 0.3
    frames = np.random.default_rng(0).random((2, 12, 9)).astype(np.float32)
    np.testing.assert_allclose(HaarShrink().prox(frames, 0.0), frames, atol=1e-6)
    flat = HaarShrink(1).prox(frames, 1e3)
    assert flat.std() < frames.std()
    assert flat.mean() == pytest.approx(frames.mean(), rel=1e-5)


def test_a_stop_returns_the_best_so_far() -> None:
    stop = threading.Event()

    def seen(progress: Progress) -> None:
        if progress.iteration == 4:
            stop.set()

    result = reconstruct(segment(), 3, 1, progress=seen, stop=stop)
    assert (result.iterations, result.ended) == (4, "stopped")
    assert np.isfinite(result.video).all()
    assert result.frame_error.shape == (GEOMETRY.span,)


def test_arrays_that_do_not_fit_are_refused() -> None:
    for option, shape in (("initial", (3, 3, 3)), ("static_image", (12, 12))):
        with pytest.raises(UsageError, match="shape"):
            reconstruct(segment(), 3, 1, **{option: np.zeros(shape)})
    with pytest.raises(UsageError, match="denoiser"):
        reconstruct(segment(), 3, 1, solver="twist", denoiser=HaarShrink())
