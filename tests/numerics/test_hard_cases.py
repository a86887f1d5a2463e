"""Hard cases: a good result, a masked one that says so, or an error; never NaN, never silent nonsense."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acquire.codes import mix_seed, prbs
from acquire.errors import AcquireError, NumericsError, UsageError
from acquire.forward import DualArm, merge_video
from acquire.geometry import Geometry
from acquire.lines import Segment
from acquire.recon import Reconstruction, reconstruct
from acquire.recon.problem import MaskedOperator, build_problem
from acquire.recon.solve import TwistSolver
from acquire.recon.twist import Twist, TwistParameters

GEOMETRY = Geometry(16, 3, 80)
GOOD_DB = 40.0
"""PSNR of an error of 1 % of full light, where rounding does not matter; unmasked faults give less."""
SOLVERS = ("admm", "twist", "twist-band")


def scene(geometry: Geometry = GEOMETRY) -> np.ndarray:
    """A slow square and a faster bar: (T, n, n)."""
    n, t = geometry.size, np.arange(geometry.span)
    video = np.zeros((geometry.span, n, n), np.float32)
    video[:, n // 8 : n // 2, n // 8 : n // 2] = (0.6 + 0.3 * np.sin(2 * np.pi * t / 140))[:, None, None]
    video[:, 5 * n // 8 : 7 * n // 8, n // 4 : n // 2] += (0.5 + 0.4 * np.sin(2 * np.pi * t / 60))[
        :, None, None
    ]
    return video


CODE = prbs(64, mix_seed(5, 64), 0, GEOMETRY.span)
TRUTH = scene()
CLEAN = DualArm(GEOMETRY, CODE).forward(TRUTH).astype(np.float32)


def segment(lines: np.ndarray = CLEAN, code: np.ndarray = CODE, geometry: Geometry = GEOMETRY) -> Segment:
    return Segment(
        lines=lines,
        mask=np.ones(geometry.lines_shape, bool),
        code=code,
        geometry=geometry,
        time_ns=np.arange(geometry.lines, dtype=np.int64) * 30_000,
        substep_ns=10_000.0,
    )


def solve(
    given: Segment, solver: str = "admm", merges: tuple[int, int] = (3, 1), **options: object
) -> Reconstruction:
    result = reconstruct(given, *merges, solver=solver, **{"iterations": 40} | options)
    assert np.isfinite(result.video).all()
    assert np.isfinite(result.quality.misfit)
    return result


def psnr(result: Reconstruction, scale: float = 1.0) -> float:
    truth = merge_video(TRUTH, 3, 1)[result.trusted]
    error = np.mean((result.video[result.trusted].astype(np.float64) / scale - truth) ** 2)
    return float(10 * np.log10(truth.max() ** 2 / error))


def test_the_clean_case_is_good() -> None:
    assert psnr(solve(segment())) > GOOD_DB


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e7, -1e7])
@pytest.mark.parametrize("solver", SOLVERS)
def test_wild_samples_are_masked_and_counted(value: float, solver: str) -> None:
    lines = CLEAN.copy()
    lines[0, 30, 4] = lines[1, 50, 9] = value
    result = solve(segment(lines), solver, iterations=10)
    assert sum(result.masked.values()) == 2
    assert result.quality.coverage == pytest.approx(1 - 2 / lines.size)


def test_a_wild_sample_costs_nothing() -> None:
    lines = CLEAN.copy()
    lines[0, 30, 4] = 1e7
    assert psnr(solve(segment(lines))) > GOOD_DB


@pytest.mark.parametrize(("value", "cause"), [(1e7, "hot column"), (0.0, "stuck column")])
def test_a_hot_and_a_dead_column_are_found(value: float, cause: str) -> None:
    lines = CLEAN.copy()
    lines[0, :, 4] = value
    result = solve(segment(lines))
    assert result.masked[cause] == GEOMETRY.lines
    assert psnr(result) > GOOD_DB


def test_lost_lines_and_half_saturation_are_masked() -> None:
    lost = segment()
    lost.mask[:, 30:33] = False
    assert psnr(solve(lost)) > GOOD_DB
    level = np.median(CLEAN)
    clipped = replace(segment(np.minimum(CLEAN, level)), mask=level > CLEAN)
    result = solve(clipped)
    assert result.quality.coverage == pytest.approx(0.5, abs=0.05)
    assert any("samples could be used" in warning for warning in result.warnings)


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_all_zero_code_is_refused(solver: str) -> None:
    dark = segment(np.zeros_like(CLEAN), np.zeros_like(CODE))
    with pytest.raises(NumericsError, match="dark"):
        solve(dark, solver)


@pytest.mark.parametrize("density", [0.01, 0.99, 1.0])
def test_extreme_codes_are_solved_with_a_warning(density: float) -> None:
    rng = np.random.default_rng(0)
    code = (rng.random(GEOMETRY.span) < density).astype(np.uint8)
    code[100] = 1
    lines = DualArm(GEOMETRY, code).forward(TRUTH).astype(np.float32)
    assert any("sub-steps" in warning for warning in solve(segment(lines, code)).warnings)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("weight", [0.0, 1e-30, 1e8])
def test_any_weight_gives_a_finite_video(solver: str, weight: float) -> None:
    solve(segment(), solver, tv_weight=weight, iterations=5)


@pytest.mark.parametrize("factor", [1e-6, 65535.0])
def test_units_do_not_matter(factor: float) -> None:
    assert psnr(solve(segment(CLEAN * np.float32(factor))), factor) > GOOD_DB


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("geometry", [Geometry(8, 3, 1), Geometry(1, 3, 40), Geometry(1, 1, 1)])
def test_one_line_and_one_stage(geometry: Geometry, solver: str) -> None:
    code = np.ones(geometry.span, np.uint8)
    lines = DualArm(geometry, code).forward(
        np.ones((geometry.span, geometry.size, geometry.size), np.float32)
    )
    result = solve(segment(lines, code, geometry), solver, (1, 1), iterations=10)
    if geometry.lines < geometry.stages:
        assert any("fewer lines than stages" in warning for warning in result.warnings)


@pytest.mark.parametrize("geometry", [Geometry(1, 2, 1), Geometry(5, 5, 15)])
def test_lines_below_the_black_level_give_a_warning(geometry: Geometry) -> None:
    """A dark video explains nothing, whatever its brightness."""
    code = prbs(64, 7, 0, geometry.span)
    below = replace(segment(np.zeros(geometry.lines_shape), code, geometry), black_level_dn=100.0)
    assert any("misses the lines" in warning for warning in solve(below, merges=(1, 1)).warnings)


@pytest.mark.parametrize("merges", [(3, 1000), (5, 1), (7, 13), (48, 1), (1, GEOMETRY.span)])
def test_merges_that_divide_nothing(merges: tuple[int, int]) -> None:
    result = solve(segment(), merges=merges, iterations=10)
    assert result.video.shape == GEOMETRY.video_shape(*merges)
    assert result.frame_error.shape == result.video.shape[:1]


def test_inconsistent_data_give_a_warning() -> None:
    noise = np.random.default_rng(1).random(CLEAN.shape).astype(np.float32) * CLEAN.max()
    assert any("misses the lines" in warning for warning in solve(segment(noise), merges=(5, 287)).warnings)


def test_a_wrong_orientation_gives_a_warning() -> None:
    turned = np.stack([CLEAN[0], CLEAN[1, :, ::-1]])
    assert any("orientation" in warning for warning in solve(segment(turned)).warnings)
    assert not solve(segment()).warnings


def test_twist_survives_an_underestimated_norm() -> None:
    """A step that is too long is not taken, so that the objective never rises above its start."""
    problem = build_problem(segment(), 3, 1, hold_out=0.0)
    whole = DualArm(GEOMETRY, CODE, 3, 1)
    loud = MaskedOperator(whole, problem.weight / np.float32(0.7 * problem.norm))
    solver = Twist(loud, problem.used_samples, whole.video_shape, TwistParameters())
    start = solver.objective
    for _ in range(20):
        solver.step()
    assert np.isfinite(solver.theta).all()
    assert solver.objective <= start


def test_a_million_substeps() -> None:
    """In float32: such long sums are computed in float64."""
    geometry = Geometry(2, 3, 333_333)
    code = prbs(64, mix_seed(1, 64), 0, geometry.span)
    whole = DualArm(geometry, code, 6, 1)
    video = np.ones(whole.video_shape, np.float32)
    lines = whole.forward(video)
    long = segment(lines, code, geometry)
    result = solve(long, merges=(6, 1000), iterations=20, bandwidth=0.03, dtype="float32")
    assert result.video.dtype == np.float32
    np.testing.assert_allclose(result.video[result.trusted], 1, atol=0.01)


def test_solvers_refuse_rather_than_return_nan() -> None:
    with pytest.raises(UsageError, match="no sample"):
        solve(segment(np.full_like(CLEAN, np.nan)))
    with pytest.raises(AcquireError):
        solve(segment(), initial=np.full(GEOMETRY.video_shape(3, 1), np.nan))


class Wrong:
    """A denoiser that breaks its contract."""

    def __init__(self, answer: object) -> None:
        self.answer = answer

    def prox(self, frames: np.ndarray, weight: object) -> object:
        return self.answer(frames) if callable(self.answer) else self.answer


@pytest.mark.parametrize("answer", [lambda frames: frames[1:], lambda frames: None, 3.0])
def test_a_denoiser_of_another_shape_is_named(answer: object) -> None:
    with pytest.raises(UsageError, match="denoiser Wrong gave back") as refused:
        solve(segment(), denoiser=Wrong(answer))
    assert "same shape" in str(refused.value.possible)


class Answer:
    """What a solver of anybody's gives back: all right, but for what a test changes."""

    held_out_error = None

    def __init__(self, **changed: object) -> None:
        self.changed = {"predict": CLEAN, "video": np.ones(GEOMETRY.video_shape(3, 1)), "facts": {}} | changed

    def __getattr__(self, name: str) -> object:
        return lambda: self.changed[name]


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (None, "gave back None"),
        (Answer(facts=None), "gave back None as facts"),
        (Answer(predict=np.zeros(3)), r"gave back lines of shape \(3,\)"),
        (Answer(predict=CLEAN * np.nan), "gave back lines with values that are not finite"),
        (Answer(video=np.ones((4, 8, 8))), r"gave back a video of shape \(4, 8, 8\)"),
        (Answer(video=np.ones(GEOMETRY.video_shape(3, 1)) * 1j), "gave back a video of complex numbers"),
        (
            Answer(video=np.full(GEOMETRY.video_shape(3, 1), np.inf)),
            "gave back a video with values that are not finite",
        ),
    ],
)
def test_a_wrong_answer_of_a_solver_is_refused_by_name(
    monkeypatch: pytest.MonkeyPatch, answer: object, told: str
) -> None:
    """A video with a frame less was written, with the times of others."""
    monkeypatch.setattr(TwistSolver, "solve", lambda *_: answer)
    with pytest.raises((UsageError, NumericsError), match=f"solver twist {told}"):
        solve(segment(), solver="twist")


def test_a_denoiser_that_returns_nan_is_named() -> None:
    with pytest.raises(NumericsError, match="denoiser Wrong gave back values that are not finite"):
        solve(segment(), denoiser=Wrong(lambda frames: frames * np.nan))


@pytest.mark.parametrize("option", ["static_image", "initial"])
def test_images_without_light_and_below_it_are_refused(option: str) -> None:
    n, shape = GEOMETRY.size, GEOMETRY.video_shape(3, 1)
    image = np.ones((n, n) if option == "static_image" else shape)
    with pytest.raises(UsageError, match="values down to -1"):
        solve(segment(), **{option: -image})
    if option == "static_image":
        with pytest.raises(UsageError, match="dark everywhere"):
            solve(segment(), static_image=0 * image)


@pytest.mark.parametrize("given", [{"responsivity_dn": 0.0}, {"black_level_dn": (0.0, np.nan)}])
def test_a_camera_without_responsivity_is_refused(given: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="responsivity"):
        replace(segment(), **given)


def test_a_stuck_camera_gives_a_warning() -> None:
    stuck = CLEAN.copy()
    stuck[1] = CLEAN[1].mean()
    assert any("arm b is stuck" in warning for warning in solve(segment(stuck), iterations=5).warnings)


@pytest.mark.parametrize("share", [0.2, -0.2])
def test_a_wrong_black_level_masks_nothing_and_gives_a_warning(share: float) -> None:
    """Unlit columns are all constant at one wrong value: they are dark, not stuck."""
    result = solve(segment(CLEAN + np.float32(share * CLEAN.mean())), iterations=10)
    assert "stuck column" not in result.masked
    assert any("the black level is too" in warning for warning in result.warnings)
