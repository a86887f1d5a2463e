"""What turns about a fixed centre: its turn, the path that follows it, and whole reconstructions."""

from __future__ import annotations

import array_api_strict
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from acquire.evaluate.metrics import psnr
from acquire.recon import reconstruct
from acquire.recon.ground import GroundedTv
from acquire.recon.reuse import Choice
from acquire.recon.rotation import Rotation, find_rotation
from acquire.recon.volume import VolumeTv
from acquire.sim.procedural import record

COUNT = 36
TIMES = (np.arange(COUNT) + 0.5) / COUNT - 0.5


def turning(seed: int, side: int, rotation: tuple[float, float, float], rise: float = 0.0) -> np.ndarray:
    """Soft balls (COUNT, side, side) on a wheel that turns about a centre; its speed may rise."""
    rng, (turns, row, column) = np.random.default_rng(seed), rotation
    y, x = np.mgrid[:side, :side] - (side - 1) / 2
    radius, start = side * rng.uniform(0.05, 0.25, 12), rng.uniform(0, 2 * np.pi, 12)
    height = rng.uniform(0.5, 1, 12)
    angle = start + 2 * np.pi * turns * (TIMES + rise * TIMES**2)[:, None]
    down, right = row * side + radius * np.sin(angle), column * side + radius * np.cos(angle)
    far = (y - down[..., None, None]) ** 2 + (x - right[..., None, None]) ** 2
    return np.sum(height[:, None, None] * np.exp(-far / 2 / 1.5**2), axis=1)


@pytest.mark.parametrize(
    "rotation", [(0.3, 0.0, 0.0), (-0.65, 0.1, -0.05), (1.2, -0.2, 0.1), (-2.0, 0.0, 0.15)]
)
@pytest.mark.parametrize("side", [24, 51])
def test_the_turn_is_found_before_a_ground_and_in_noise(
    side: int, rotation: tuple[float, float, float]
) -> None:
    rng = np.random.default_rng(3)
    ground = 3 * gaussian_filter(rng.standard_normal((side, side)), 2)
    video = turning(1, side, rotation) + ground + 0.05 * rng.standard_normal((COUNT, side, side))
    assert find_rotation(video) == pytest.approx(rotation, abs=0.02)


@pytest.mark.parametrize("rise", [0.2, -0.4])
def test_a_speed_that_changes_is_found_and_followed(rise: float) -> None:
    rotation = (-0.8, 0.1, -0.05)
    x = turning(4, 33, rotation, rise)
    assert find_rotation(x) == pytest.approx((*rotation, rise), abs=0.02)
    assert find_rotation(x, steady=True) == pytest.approx(rotation, abs=0.1)
    y = Rotation(rotation, COUNT, 33, x, rise).follow(x)
    assert y.std(axis=0).max() < 0.02 * x.std(axis=0).max()


def test_what_does_not_turn_has_no_turn() -> None:
    rng, side = np.random.default_rng(6), 24
    picture = gaussian_filter(rng.standard_normal((side, side)), 1.0, mode="wrap")
    passing = np.stack([np.roll(picture, round(24 * t), axis=1) for t in TIMES])
    blinking = (1 + np.cos(40 * TIMES))[:, None, None] * np.abs(picture)
    noise = rng.standard_normal((COUNT, side, side))
    still = picture + 0 * noise
    for video in (passing, blinking, noise, np.zeros((COUNT, 8, 8)), still):
        assert find_rotation(video) is None


@pytest.mark.parametrize("side", [7, 8])
def test_the_path_is_orthonormal(side: int) -> None:
    rng = np.random.default_rng(7)
    x, other = rng.standard_normal((2, 5, side, side))
    path = Rotation((1.3, 0.11, -0.2), 5, side, x)
    y = path.follow(x)
    np.testing.assert_allclose(path.restore(y), x, atol=1e-12)
    assert np.vdot(y, other) == pytest.approx(np.vdot(x, path.restore(other)), rel=1e-12)


@pytest.mark.parametrize("side", [7, 8])
def test_quarter_turns_move_pixels_as_they_are(side: int) -> None:
    x = np.random.default_rng(8).standard_normal((5, side, side))
    path = Rotation((1.25, 0.0, 0.0), 5, side, x)  # by a quarter from each instant to the next
    # `rot90` with a negative count turns rows towards columns, as a growing angle does.
    expected = np.stack([np.rot90(x[k], -(k - 2)) for k in range(5)])
    np.testing.assert_allclose(path.restore(x), expected, atol=1e-12)


def test_a_quarter_turn_about_a_pixel_leaves_it_in_place() -> None:
    x = np.zeros((5, 9, 9))
    x[:, 5, 2] = 1  # the centre of the turn
    x[:, 5, 4] = 2  # to its right, from where it turns down
    moved = Rotation((1.25, 1 / 9, -2 / 9), 5, 9, x).restore(x)
    np.testing.assert_allclose(moved[:, 5, 2], 1, atol=1e-12)
    for k, at in enumerate([(5, 0), (3, 2), (5, 4), (7, 2), (5, 0)]):
        assert moved[k][at] == pytest.approx(2, abs=1e-12)


@pytest.mark.parametrize("rotation", [(0.1, 0.0, 0.0), (-0.8, 0.1, -0.07), (0.9, -0.1, 0.05)])
def test_what_turns_along_hardly_changes(rotation: tuple[float, float, float]) -> None:
    x = turning(2, 33, rotation)
    y = Rotation(rotation, COUNT, 33, x).follow(x)
    # what wraps around at the picture's edges is not there, as the balls are not
    assert y.std(axis=0).max() < 0.02 * x.std(axis=0).max()


def test_another_library_makes_the_same_steps_and_another_trial_continues() -> None:
    theta = np.random.default_rng(3).standard_normal((6, 8, 8)).astype(np.float32)
    ours, theirs, third = (GroundedTv(2.0, 0.2, rotation=(0.8, 0.1, -0.05)) for _ in range(3))
    for _ in range(3):
        strict = theirs.prox(array_api_strict.asarray(theta), 0.2)
        mine = ours.prox(theta, 0.2)
        assert mine.dtype == np.float32
        np.testing.assert_allclose(mine, np.from_dlpack(strict), atol=1e-5)
    third.resume(ours)
    np.testing.assert_array_equal(third.prox(theta, 0.2), ours.prox(theta, 0.2))
    # The dual field of what stands still does not fit.
    fresh, resting = VolumeTv(2.0, rotation=(0.8, 0.0, 0.0)), VolumeTv(2.0)
    resting.prox(theta, 0.2)
    fresh.resume(resting)
    expected = VolumeTv(2.0, rotation=(0.8, 0.0, 0.0)).prox(theta, 0.2)
    np.testing.assert_array_equal(fresh.prox(theta, 0.2), expected)


@pytest.mark.parametrize("scene", ["wheel", "disc"])
def test_what_turns_is_followed(scene: str, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded = record(scene, 1303, stages=32, lines=200)
    truth = recorded.truth(3, 1)
    found = reconstruct(recorded.segment, 3, 1, preset="fast")
    assert found.parameters["rotation"]
    cyclic = found.parameters["period_frames"] > 0
    assert cyclic == (scene == "disc")  # whose six sectors are alike
    # A next range of half the length turns half as far, and a cycle as before.
    choice = Choice.of(found)
    assert choice is not None
    half = choice.candidate(len(found.video) // 2).rotation
    turns, *centre = found.parameters["rotation"]
    assert half == pytest.approx((turns if cyclic else turns / 2, *centre), abs=1e-2)
    monkeypatch.setattr("acquire.recon.following.turning", lambda _: None)
    before = reconstruct(recorded.segment, 3, 1, preset="fast")
    assert before.parameters["rotation"] == ()
    assert found.quality.prediction < 0.9 * before.quality.prediction
    assert psnr(found.video[found.trusted], truth) > psnr(before.video[before.trusted], truth) + 1
