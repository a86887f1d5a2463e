"""PSNR and SSIM against closed forms and scikit-image."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from acquire.errors import NumericsError, UsageError
from acquire.evaluate.metrics import psnr, psnr_per_frame, ssim, ssim_per_frame


def random_pair(seed: int, shape: tuple[int, ...], noise: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = rng.random(shape)
    return truth + noise * rng.standard_normal(shape), truth


@given(shift=st.floats(1e-3, 10), peak=st.floats(0.1, 1e4))
def test_psnr_of_a_constant_error_has_a_closed_form(shift: float, peak: float) -> None:
    truth = np.linspace(0, 1, 60).reshape(3, 4, 5)
    assert psnr(truth + shift, truth, peak) == pytest.approx(20 * math.log10(peak / shift), abs=1e-6)


def test_peak_is_the_truths_maximum_unless_given() -> None:
    video, truth = random_pair(0, (3, 12, 12))
    assert psnr(video, 5 * truth) == psnr(video, 5 * truth, float(5 * truth.max()))
    assert psnr(video, truth, 2 * truth.max()) == pytest.approx(psnr(video, truth) + 20 * math.log10(2))


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_the_unit_of_light_makes_no_difference(scale: float) -> None:
    video, truth = random_pair(2, (2, 12, 12))
    assert psnr(scale * video, scale * truth) == pytest.approx(psnr(video, truth))
    assert ssim(scale * video, scale * truth) == pytest.approx(ssim(video, truth))


def test_equal_videos_are_infinitely_good() -> None:
    _, truth = random_pair(1, (2, 12, 12))
    assert psnr(truth, truth) == math.inf
    assert ssim(truth, truth) == pytest.approx(1)


def test_frames_share_one_peak_and_average_to_the_whole() -> None:
    video, truth = random_pair(2, (4, 12, 12))
    truth[0] *= 0.1
    each = psnr_per_frame(video, truth)
    assert each.shape == (4,)
    assert psnr(video, truth) == pytest.approx(-10 * math.log10(np.mean(10 ** (-each / 10))))


def test_narrow_integers_do_not_wrap_around() -> None:
    video, truth = np.full((1, 12, 12), 3, np.uint8), np.full((1, 12, 12), 255, np.uint8)
    assert psnr(video, truth) == pytest.approx(20 * math.log10(255 / 252))


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    rows=st.integers(11, 30),
    columns=st.integers(11, 30),
    noise=st.floats(0, 2),
    data_range=st.floats(0.5, 300),
)
def test_ssim_is_that_of_scikit_image(
    seed: int, rows: int, columns: int, noise: float, data_range: float
) -> None:
    video, truth = random_pair(seed, (2, rows, columns), noise)
    options = {"gaussian_weights": True, "use_sample_covariance": False, "data_range": data_range}
    oracle = [structural_similarity(y, x, **options) for x, y in zip(video, truth, strict=True)]
    np.testing.assert_allclose(ssim_per_frame(video, truth, data_range), oracle, atol=1e-9)
    assert ssim(video, truth, data_range) == pytest.approx(np.mean(oracle), abs=1e-9)


def test_single_precision_is_computed_in_double() -> None:
    video, truth = (x.astype(np.float32) for x in random_pair(3, (2, 16, 16)))
    assert ssim(video, truth) == ssim(video.astype(np.float64), truth.astype(np.float64))
    assert psnr(video, truth) == pytest.approx(psnr(video.astype(np.float64), truth), abs=1e-9)


def test_a_picture_is_a_video_of_one_frame() -> None:
    video, truth = random_pair(4, (1, 16, 16))
    assert psnr(video[0], truth[0]) == psnr(video, truth)
    assert ssim(video[0], truth[0]) == ssim(video, truth)


@pytest.mark.parametrize("metric", [psnr, psnr_per_frame, ssim, ssim_per_frame])
class TestRefusals:
    def test_shapes_that_differ(self, metric) -> None:
        with pytest.raises(UsageError, match=r"\(2, 12, 12\).*\(2, 12, 13\)"):
            metric(np.ones((2, 12, 12)), np.ones((2, 12, 13)))

    @pytest.mark.parametrize("shape", [(12,), (1, 2, 12, 12), (0, 12, 12)])
    def test_arrays_that_are_not_videos(self, metric, shape) -> None:
        with pytest.raises(UsageError):
            metric(np.ones(shape), np.ones(shape))

    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    def test_values_that_are_not_finite_on_either_side(self, metric, bad) -> None:
        video, truth = random_pair(5, (2, 12, 12))
        broken = video.copy()
        broken[1, 2, 3] = bad
        with pytest.raises(NumericsError, match=r"1 of 288 values of the video"):
            metric(broken, truth)
        with pytest.raises(NumericsError, match="of the truth"):
            metric(truth, broken)

    @pytest.mark.parametrize("peak", [0.0, -1.0, np.nan])
    def test_an_invalid_peak(self, metric, peak) -> None:
        video, truth = random_pair(6, (2, 12, 12))
        with pytest.raises(UsageError, match="peak"):
            metric(video, truth, peak)
        with pytest.raises(UsageError, match="peak"):
            metric(video, np.zeros_like(truth))


def test_frames_must_hold_the_window_of_ssim() -> None:
    with pytest.raises(UsageError, match="11 x 11"):
        ssim(np.ones((2, 10, 30)), np.ones((2, 10, 30)))
