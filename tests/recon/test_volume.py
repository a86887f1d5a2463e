"""The priors of volumes against closed forms, an independent implementation and the array standard."""

from __future__ import annotations

import array_api_strict
import numpy as np
import pytest
from scipy.fft import dct, dctn, idct
from skimage.restoration import denoise_tv_chambolle

from acquire.errors import UsageError
from acquire.recon.smooth import Smooth
from acquire.recon.volume import VolumeTv


def of_instants(prior: VolumeTv | Smooth, volume: np.ndarray, weight: float) -> np.ndarray:
    """The prox of a volume of instants by that of its coefficients."""
    cleaned = prior.prox(dct(volume, axis=0, norm="ortho"), weight)
    return np.asarray(idct(cleaned, axis=0, norm="ortho"))


def test_equals_an_independent_implementation_in_three_dimensions() -> None:
    volume = np.random.default_rng(0).random((6, 8, 10))
    ours = of_instants(VolumeTv(1.0, 4000), volume, 0.3)
    theirs = denoise_tv_chambolle(volume, weight=0.3, eps=1e-14, max_num_iter=50_000)
    np.testing.assert_allclose(ours, theirs, atol=1e-4)


def test_pace_is_the_weight_of_change() -> None:
    """Two instants of one pixel each move by weight · pace towards each other, until they meet."""
    volume = np.array([[[0.0]], [[1.0]]])
    for pace, left in ((0.5, 0.9), (2.0, 0.6), (8.0, 0.0)):
        low, high = of_instants(VolumeTv(pace, 500), volume, 0.1).ravel()
        assert high - low == pytest.approx(left, abs=1e-6)
        assert low + high == pytest.approx(1)


def test_with_pace_0_instants_are_independent_frames() -> None:
    volume = np.random.default_rng(1).random((3, 7, 9))
    frame = denoise_tv_chambolle(volume[1], weight=0.2, eps=1e-14, max_num_iter=50_000)
    np.testing.assert_allclose(of_instants(VolumeTv(0.0, 4000), volume, 0.2)[1], frame, atol=1e-4)


def test_other_libraries_make_the_same_steps_and_a_dual_field_is_resumed() -> None:
    frames = np.random.default_rng(2).standard_normal((5, 8, 8)).astype(np.float32)
    for prior, other in ((VolumeTv(2.0, 7), VolumeTv(2.0, 7)), (Smooth(0.5), Smooth(0.5))):
        strict = other.prox(array_api_strict.asarray(frames), 0.2)
        np.testing.assert_allclose(prior.prox(frames, 0.2), np.from_dlpack(strict), atol=1e-5)
    first, second = VolumeTv(1.0, 2000), VolumeTv(1.0, 1)
    wanted = first.prox(frames, 0.3)
    second.resume(first)
    np.testing.assert_allclose(second.prox(frames, 0.3), wanted, atol=1e-3)


def test_smoothness_is_wieners_filter() -> None:
    """The prox's optimality: x + weight·(second differences' square)·x = b, in cosines of space and time."""
    theta = np.random.default_rng(3).standard_normal((4, 6, 6))
    cleaned = Smooth(2.0).prox(theta, 0.7)
    spectrum, wanted = (dctn(each, axes=(1, 2), norm="ortho") for each in (theta, cleaned))
    k, t = (np.pi * np.arange(6) / 6) ** 2, (2.0 * np.pi * np.arange(4) / 6) ** 2
    square = (t[:, None, None] + k[:, None] + k) ** 2
    np.testing.assert_allclose(wanted * (1 + 0.7 * square), spectrum, atol=1e-9)
    np.testing.assert_array_equal(Smooth().prox(theta, 0.0), theta)


@pytest.mark.parametrize("pace", [-1.0, float("nan"), float("inf")])
def test_impossible_paces_are_refused(pace: float) -> None:
    for kind in (VolumeTv, Smooth):
        with pytest.raises(UsageError, match="pace"):
            kind(pace)
