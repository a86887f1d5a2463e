"""What drifts across the picture: its velocity, the path that follows it, and whole reconstructions."""

from __future__ import annotations

import array_api_strict
import numpy as np
import pytest
from scipy.ndimage import fourier_shift, gaussian_filter, rotate

from acquire.evaluate.metrics import psnr
from acquire.recon import reconstruct
from acquire.recon.drift import Path, find_drift
from acquire.recon.ground import GroundedTv
from acquire.recon.reuse import Choice
from acquire.recon.volume import VolumeTv
from acquire.sim.procedural import record

SIDE, COUNT = 24, 24
TIMES = (np.arange(COUNT) + 0.5) / COUNT - 0.5


def texture(seed: int, side: int = SIDE) -> np.ndarray:
    return gaussian_filter(np.random.default_rng(seed).standard_normal((side, side)), 1.0, mode="wrap")


def moving(picture: np.ndarray, velocity: tuple[float, float], rise: float = 0.0) -> np.ndarray:
    """The picture, which moves by ``velocity`` sides over the video and wraps around; its speed may rise."""
    spectrum = np.fft.fft2(picture)
    by = [np.array(velocity) * len(picture) * t for t in TIMES + rise * TIMES**2]
    return np.stack([np.fft.ifft2(fourier_shift(spectrum, each)).real for each in by])


@pytest.mark.parametrize("velocity", [(0.0, 0.35), (-0.8, 0.0), (1.2, -0.4), (0.3, 0.2)])
def test_the_velocity_is_found_before_a_ground_and_in_noise(velocity: tuple[float, float]) -> None:
    rng = np.random.default_rng(5)
    video = moving(texture(1), velocity) + 3 * texture(2) + 0.1 * rng.standard_normal((COUNT, SIDE, SIDE))
    # Until the part was counted that the mean over time holds, this was off by 0.01 to 0.02.
    assert find_drift(video) == pytest.approx(velocity, abs=0.006)


@pytest.mark.parametrize("rise", [0.2, -0.4])
def test_a_speed_that_changes_is_found_and_followed(rise: float) -> None:
    rng, velocity = np.random.default_rng(5), (0.2, -0.8)
    still = 3 * texture(2) + 0.1 * rng.standard_normal((COUNT, SIDE, SIDE))
    assert find_drift(moving(texture(1), velocity, rise) + still) == pytest.approx(
        (*velocity, rise), abs=0.02
    )
    x = moving(texture(1), velocity, rise)
    y = Path(velocity, COUNT, SIDE, x, rise).follow(x)
    assert np.ptp(y, axis=0).max() < 0.02 * np.ptp(x, axis=0).max()  # the finest wave has one phase only


def test_what_does_not_move_as_one_has_no_velocity() -> None:
    rng, picture = np.random.default_rng(6), texture(3)
    square = np.pad(picture, 8)
    turning = np.stack([rotate(square, 180 * t, reshape=False, order=1) for t in TIMES])
    blinking = (1 + np.cos(40 * TIMES))[:, None, None] * np.abs(picture)
    noise = rng.standard_normal((COUNT, SIDE, SIDE))
    angles = 2 * np.pi * np.arange(7) / 7
    apart = sum(moving(texture(10 + k), (np.sin(each), np.cos(each))) for k, each in enumerate(angles))
    for video in (turning, blinking, noise, np.asarray(apart), np.zeros((COUNT, 8, 8)), picture + 0 * noise):
        assert find_drift(video) is None
    assert find_drift(moving(picture, (0.0, 0.4))[:8]) is None  # too few instants to tell


@pytest.mark.parametrize("side", [7, 8])
def test_the_path_is_orthonormal_and_moves_whole_pixels_as_they_are(side: int) -> None:
    x = np.random.default_rng(7).standard_normal((5, side, side))
    path = Path((0.37, -1.1), 5, side, x)
    y = path.follow(x)
    np.testing.assert_allclose(path.restore(y), x, atol=1e-12)
    other = np.random.default_rng(8).standard_normal(x.shape)
    assert np.vdot(y, other) == pytest.approx(np.vdot(x, path.restore(other)), rel=1e-12)
    rolled = np.stack([np.roll(x[k], (k - 2, 2 * (2 - k)), axis=(0, 1)) for k in range(5)])
    by = 5 / side
    np.testing.assert_allclose(Path((by, -2 * by), 5, side, x).restore(x), rolled, atol=1e-12)


def test_the_prox_is_that_of_what_stands_still_on_the_path() -> None:
    """In cosines of as many instants as there are, the transform is orthonormal as well."""
    k = np.arange(COUNT)
    cosines = np.cos(np.pi * k[:, None] * (k + 0.5) / COUNT) * np.sqrt(np.where(k, 2, 1) / COUNT)[:, None]
    theta = np.tensordot(cosines, moving(texture(9), (0.3, 0.0)), axes=1)
    drift = (0.3, -0.2)
    path = Path(drift, COUNT, SIDE, theta)
    y = np.tensordot(cosines, path.follow(np.tensordot(cosines.T, theta, axes=1)), axes=1)
    at_rest = np.tensordot(cosines.T, VolumeTv(2.0, 20).prox(y, 0.1), axes=1)
    expected = np.tensordot(cosines, path.restore(at_rest), axes=1)
    np.testing.assert_allclose(VolumeTv(2.0, 20, drift=drift).prox(theta, 0.1), expected, atol=1e-6)


def test_another_library_makes_the_same_steps_and_another_trial_goes_on() -> None:
    theta = np.random.default_rng(3).standard_normal((6, 8, 8)).astype(np.float32)
    ours, theirs, third = (GroundedTv(2.0, 0.2, drift=(0.5, 0.25)) for _ in range(3))
    for _ in range(3):
        strict = theirs.prox(array_api_strict.asarray(theta), 0.2)
        np.testing.assert_allclose(ours.prox(theta, 0.2), np.from_dlpack(strict), atol=1e-5)
    third.resume(ours)
    np.testing.assert_array_equal(third.prox(theta, 0.2), ours.prox(theta, 0.2))
    # The dual field of what stands still does not fit.
    fresh, resting = VolumeTv(2.0, drift=(0.5, 0.25)), VolumeTv(2.0)
    resting.prox(theta, 0.2)
    fresh.resume(resting)
    np.testing.assert_array_equal(fresh.prox(theta, 0.2), VolumeTv(2.0, drift=(0.5, 0.25)).prox(theta, 0.2))


def test_text_that_scrolls_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    recorded = record("text", 1301, stages=32, lines=200)
    truth = recorded.truth(3, 1)
    found = reconstruct(recorded.segment, 3, 1)
    rows, columns = found.parameters["drift"]
    assert abs(rows) < 0.03
    assert -0.6 < columns < -0.3
    # A short budget has time for it: only a volume, a still, cosines and a smooth volume come first.
    assert any(each.get("drift") for each in found.parameters["candidates"][:6])
    # A next range of half the length moves half as far.
    choice = Choice.of(found)
    assert choice is not None
    half = choice.candidate(len(found.video) // 2)
    assert half.drift == pytest.approx((rows / 2, columns / 2), abs=1e-3)
    monkeypatch.setattr("acquire.recon.following.drifting", lambda *_: None)
    before = reconstruct(recorded.segment, 3, 1)
    assert before.parameters["drift"] == ()
    assert found.quality.prediction < 0.8 * before.quality.prediction
    assert psnr(found.video[found.trusted], truth) > psnr(before.video[before.trusted], truth) + 1.5


def test_fast_motion_gets_the_cosines_that_its_finest_wave_takes() -> None:
    recorded = record("text", 1301, stages=40, lines=180)
    found = reconstruct(recorded.segment, 2, 1, preset="fast")  # whose search has no time to arrive there
    moving = [each for each in found.parameters["candidates"] if each.get("drift")]
    side = found.video.shape[1]
    wanted = max(map(abs, moving[0]["drift"])) * side
    assert moving[0]["coefficients"] < wanted
    assert any(each["coefficients"] >= wanted for each in moving)
