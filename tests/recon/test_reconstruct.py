"""`reconstruct` as users call it, on a small scene of blinking shapes."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acquire import recon
from acquire.codes import mix_seed, prbs
from acquire.errors import NumericsError, UsageError
from acquire.forward import DualArm, merge_video
from acquire.geometry import Geometry
from acquire.lines import Segment
from acquire.recon import Progress, reconstruct

GEOMETRY = Geometry(20, 3, 120)  # T = 419, trusted 59..359


GOOD_DB = 40.0
"""An error of 1 % of full light: above it, rounding counts, which differs from processor to processor."""


def scene() -> np.ndarray:
    """Two shapes, one slow and one fast, on a dark ground: (T, n, n)."""
    n, t = GEOMETRY.size, np.arange(GEOMETRY.span)
    video = np.zeros((GEOMETRY.span, n, n), np.float32)
    video[:, 8:28, 8:28] += (0.5 + 0.45 * np.sin(2 * np.pi * t / 140))[:, None, None]
    video[:, 30:54, 30:51] += (0.5 + 0.45 * np.sin(2 * np.pi * t / 50))[:, None, None]
    return video


TRUTH = scene()
CODE = prbs(64, mix_seed(11, 64), 0, GEOMETRY.span)


def segment(gain: float = 20.0, black: float = 64.0) -> Segment:
    lines = DualArm(GEOMETRY, CODE).forward(TRUTH) * gain + black
    return Segment(
        lines=np.rint(lines).astype(np.float32),
        mask=np.ones(GEOMETRY.lines_shape, bool),
        code=CODE,
        geometry=GEOMETRY,
        time_ns=np.arange(GEOMETRY.lines, dtype=np.int64) * 30_000,
        substep_ns=10_000.0,
        black_level_dn=black,
        responsivity_dn=gain,
    )


def psnr(video: np.ndarray, trusted: slice, T_m: int = 1) -> float:
    truth = merge_video(TRUTH, 3, T_m)[trusted]
    return float(10 * np.log10(truth.max() ** 2 / np.mean((video[trusted] - truth) ** 2)))


def still() -> np.ndarray:
    image = np.zeros((60, 60), np.float32)
    for width in (2, 3, 5):
        bars = np.arange(5 * width) // width % 2 == 0
        image[6 : 6 + 5 * width, 10 * width : 10 * width + 8] = bars[:, None]
    image[36:54, 12:48] = np.indices((18, 36)).sum(axis=0) % 12 < 6
    return image


@pytest.mark.parametrize("T_m", [GEOMETRY.span, 70])
def test_a_scene_at_rest_is_found_at_full_resolution(T_m: int) -> None:
    """In slow voxels: the mean light must not suppress the details."""
    seen = DualArm(GEOMETRY, CODE).forward(np.broadcast_to(still(), (GEOMETRY.span, 60, 60)))
    lines = np.rint(seen * 20 + 64).astype(np.float32)
    result = reconstruct(replace(segment(), lines=lines), 1, T_m)
    assert -10 * np.log10(np.mean((result.video - still()) ** 2)) > GOOD_DB


def test_the_default_finds_the_scene() -> None:
    result = reconstruct(segment(), 3, 1)
    assert result.video.shape == (419, 20, 20)
    assert result.video.dtype == np.float32
    assert result.trusted == slice(59, 360)
    assert psnr(result.video, result.trusted) > GOOD_DB
    assert result.video.min() >= 0
    assert result.quality.coverage == 1
    assert result.quality.misfit < 0.1
    assert result.quality.prediction < 0.1


def test_frames_carry_the_time_of_the_lines() -> None:
    result = reconstruct(segment(), 3, 4, iterations=1)
    assert np.all(np.diff(result.time_ns) == 40_000)
    first = reconstruct(segment(), 3, 1, iterations=1)
    assert first.time_ns[first.trusted][0] == segment().time_ns[0]


def test_the_default_beats_twist_at_equal_iterations() -> None:
    twist = reconstruct(segment(), 3, 1, solver="twist", iterations=40)
    admm = reconstruct(segment(), 3, 1, iterations=40)
    assert twist.solver == "twist"
    assert 8 < psnr(twist.video, twist.trusted) < psnr(admm.video, admm.trusted) - 3


@pytest.mark.parametrize("solver", ["admm", "twist"])
def test_masked_samples_have_no_influence(solver: str) -> None:
    clean = segment()
    mask = clean.mask.copy()
    mask[0, 40:43] = False  # lost lines
    mask[1, :, 7] = False  # a dead column
    ruined = clean.lines.copy()
    ruined[~mask] = 1e7
    ruined[0, 41, 3] = np.nan
    a = reconstruct(replace(clean, mask=mask), 3, 1, solver=solver, iterations=15)
    b = reconstruct(replace(clean, mask=mask, lines=ruined), 3, 1, solver=solver, iterations=15)
    np.testing.assert_allclose(a.video, b.video, atol=1e-4)
    assert a.quality.coverage == pytest.approx(mask.mean())


def test_unflagged_nan_is_masked_too() -> None:
    lines = segment().lines.copy()
    lines[0, 10, 4] = np.nan
    result = reconstruct(replace(segment(), lines=lines), 3, 1, iterations=10)
    assert np.isfinite(result.video).all()
    assert result.quality.coverage < 1


def test_losing_a_few_lines_costs_little() -> None:
    clean = segment()
    mask = clean.mask.copy()
    mask[0, 60:63] = False
    mask[1, :, 5] = False
    ruined = np.where(mask, clean.lines, np.float32(clean.black_level_dn))  # 16 dB if these samples counted
    holed = reconstruct(replace(clean, mask=mask, lines=ruined), 3, 1)
    assert psnr(holed.video, holed.trusted) > GOOD_DB


@pytest.mark.parametrize("factor", [1e-6, 65535.0])
def test_units_of_the_light_do_not_matter(factor: float) -> None:
    plain = reconstruct(replace(segment(), black_level_dn=64.0), 3, 1, iterations=20)
    scaled = reconstruct(replace(segment(), responsivity_dn=20.0 / factor), 3, 1, iterations=20)
    np.testing.assert_allclose(scaled.video, plain.video * factor, rtol=1e-3, atol=1e-3 * factor)


def test_a_budget_is_kept_and_progress_is_reported() -> None:
    steps: list[Progress] = []
    result = reconstruct(segment(), 3, 1, budget_s=1e-6, progress=steps.append, refuse=False)
    assert 1 <= result.iterations == len(steps) <= 2
    assert steps[0].iterations == result.iterations_asked == 150
    assert result.ended == "budget"


@pytest.mark.parametrize(("N_m", "T_m"), [(1, 419), (3, 4), (2, 5), (7, 1), (60, 1000)])
def test_any_merging(N_m: int, T_m: int) -> None:
    result = reconstruct(segment(), N_m, T_m, iterations=3)
    assert result.video.shape == GEOMETRY.video_shape(N_m, T_m)
    assert np.isfinite(result.video).all()


@pytest.mark.parametrize("solver", ["admm", "twist"])
@pytest.mark.parametrize("weight", [0.0, 1e-30, 1e8])
def test_extreme_weights_stay_finite(solver: str, weight: float) -> None:
    result = reconstruct(segment(), 3, 1, solver=solver, tv_weight=weight, iterations=5)
    assert np.isfinite(result.video).all()


def test_a_black_scene_is_black() -> None:
    black = replace(segment(), lines=np.full(GEOMETRY.lines_shape, 64.0, np.float32))
    assert np.abs(reconstruct(black, 3, 1, iterations=5).video).max() < 1e-6


@pytest.mark.parametrize("geometry", [Geometry(1, 1, 1), Geometry(1, 3, 4), Geometry(4, 3, 1)])
def test_tiny_segments_give_a_finite_result(geometry: Geometry) -> None:
    tiny = Segment(
        lines=np.ones(geometry.lines_shape),
        mask=np.ones(geometry.lines_shape, bool),
        code=np.ones(geometry.span, np.uint8),
        geometry=geometry,
        time_ns=np.zeros(geometry.lines, np.int64),
    )
    result = reconstruct(tiny, 1, 1, iterations=10)
    assert np.isfinite(result.video).all()


def test_what_cannot_be_is_refused_with_what_can() -> None:
    good = segment()
    for error, match, call in (
        (UsageError, "possible: admm, twist, twist-band", {"solver": "gap"}),
        (UsageError, "possible: fast, balanced, best", {"preset": "magic"}),
        (UsageError, "bandwidth 0", {"bandwidth": 0.0}),
        (UsageError, "TV weight nan", {"tv_weight": float("nan")}),
        (UsageError, "budget of -1", {"budget_s": -1.0}),
        (UsageError, "0 iterations", {"iterations": 0}),
        (UsageError, "2.5 iterations", {"iterations": 2.5}),
        (UsageError, "bandwidth = '1' is not a number", {"bandwidth": "1"}),
        (UsageError, "tv_weight = True is not a number", {"tv_weight": True}),
        (UsageError, r"budget_s = \[5\] is not a number", {"budget_s": [5]}),
        (UsageError, "solver_options = 5 are not named options", {"solver_options": 5}),
        (UsageError, "solver_options = {1: 2} are not named options", {"solver_options": {1: 2}}),
        (UsageError, "progress = True cannot be called", {"progress": True}),
        (UsageError, "look = 'x' cannot be called", {"look": "x"}),
        (UsageError, "stop = True has no method is_set", {"stop": True}),
        (UsageError, "choice = 'tv' is not the choice", {"choice": "tv"}),
    ):
        with pytest.raises(error, match=match):
            reconstruct(good, 3, 1, **call)
    with pytest.raises(UsageError, match="N_m = 61"):
        reconstruct(good, 61, 1)
    with pytest.raises(UsageError, match="no sample"):
        reconstruct(replace(good, mask=np.zeros_like(good.mask)), 3, 1)
    with pytest.raises(NumericsError, match="dark"):
        reconstruct(replace(good, code=np.zeros_like(good.code)), 3, 1)


def test_frame_error_is_a_residual_that_shows_unexplained_lines() -> None:
    good = segment()
    wrong = good.lines.copy()
    wrong[:, 70:74] *= 1.3
    seen = slice(GEOMETRY.substeps * 70, GEOMETRY.substeps * 74 + GEOMETRY.size)
    clean, spoilt = (
        reconstruct(replace(good, lines=lines), 3, 1, iterations=40) for lines in (good.lines, wrong)
    )
    assert seen.start <= int(np.argmax(spoilt.frame_error)) < seen.stop
    assert spoilt.frame_error.max() > 2 * np.median(clean.frame_error[clean.trusted])
    # not the error of the frames, which is larger: what `frame_error` says of itself
    truth = merge_video(TRUTH, 3, 1)[clean.trusted]
    error = np.linalg.norm(clean.video[clean.trusted] - truth) / np.linalg.norm(truth)
    assert 1 < error / clean.frame_error[clean.trusted].mean() < 20


def test_the_map_of_the_room_names_all_its_modules() -> None:
    rooms = {path.stem for path in Path(recon.__file__).parent.glob("*.py")} - {"__init__"}
    assert rooms <= {*re.findall(r"\w+", recon.__doc__ or "")}
