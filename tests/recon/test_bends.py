"""What moves on a path that bends: the path, and whole reconstructions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from acquire.evaluate.metrics import psnr
from acquire.recon import reconstruct
from acquire.recon.bends import ORDERS, _seen_from, _tracked, find_bends
from acquire.recon.drift import Path, Waves, displacements, fastest, find_drift
from acquire.recon.reuse import Choice
from acquire.sim.procedural import record

SIDE, COUNT = 32, 24
FALLS = (0.1, 0.5, 0.3, 0.0)
SWINGS = (0.0, -0.2, 0.1, 0.05, 0.0, 0.4, -0.05, 0.0, 0.0, -0.15)


def texture(seed: int) -> np.ndarray:
    return gaussian_filter(np.random.default_rng(seed).standard_normal((SIDE, SIDE)), 1.5, mode="wrap")


def moving(drift: tuple[float, ...], seed: int = 1, noise: float = 0.05) -> np.ndarray:
    """A texture that moves before another one, in noise."""
    picture = np.broadcast_to(texture(seed), (COUNT, SIDE, SIDE)).copy()
    moved = Path(drift, COUNT, SIDE, picture).restore(picture) + 2 * texture(seed + 1)
    return np.asarray(moved + noise * np.random.default_rng(seed).standard_normal(moved.shape))


def test_a_path_is_a_sum_of_polynomials() -> None:
    t = (np.arange(COUNT) + 0.5) / COUNT * 2 - 1
    by = displacements((0.2, -0.4, 0.1, 0.3), COUNT)
    np.testing.assert_allclose(by[:, 0], 0.1 * t + 0.1 * (3 * t**2 - 1) / 2, atol=1e-12)
    np.testing.assert_allclose(by[:, 1], -0.2 * t + 0.3 * (3 * t**2 - 1) / 2, atol=1e-12)
    assert fastest((0.3, -0.4)) == pytest.approx(0.4)
    assert fastest((0.2, -0.4, 0.1, 0.3)) == pytest.approx(0.4 + 2 * 3 * 0.3, rel=0.02)


def test_the_slope_is_the_derivative_of_the_share() -> None:
    waves = Waves(moving(FALLS))
    by = displacements(FALLS, COUNT) + 0.02 * np.random.default_rng(3).standard_normal((COUNT, 2))
    change = np.random.default_rng(4).standard_normal(by.shape)
    step = 1e-6
    measured = (waves.share(by + step * change) - waves.share(by - step * change)) / (2 * step)
    assert np.vdot(waves.slope(by), change) == pytest.approx(measured, rel=1e-6)
    assert waves.share(displacements(FALLS, COUNT)) > 0.9


@pytest.mark.parametrize(
    "drift", [FALLS, SWINGS, (0.0, 0.0, 0.2, 0.2), (0.0, 0.8, 0.3, 0.0, 0.0, 0.0, 0.1, 0.0)]
)
def test_a_path_that_bends_is_found_before_a_ground_and_in_noise(drift: tuple[float, ...]) -> None:
    video = moving(drift)
    found = find_bends(video, find_drift(video))
    assert found is not None
    assert len(found) in {2 * order for order in ORDERS}
    np.testing.assert_allclose(displacements(found, COUNT), displacements(drift, COUNT), atol=0.01)
    # From a path nearby, it is found again.
    near = tuple(np.array(found) + 0.01)
    again = find_bends(video, None, near)
    assert again is not None
    np.testing.assert_allclose(displacements(again, COUNT), displacements(drift, COUNT), atol=0.01)


def test_instants_that_show_other_things_do_not_bend_a_path_away() -> None:
    video = moving(SWINGS)
    for k, row in ((3, 7), (9, 11)):  # ghosts, each of a later instant and elsewhere
        video[k] = np.roll(video[(k + 6) % COUNT], row, axis=0)
    found = find_bends(video, find_drift(video))
    assert found is not None
    np.testing.assert_allclose(displacements(found, COUNT), displacements(SWINGS, COUNT), atol=0.03)


def hopping(hops: float, count: int) -> np.ndarray:
    """The displacements of something that crosses the field in hops, in sides."""
    t = (np.arange(count) + 0.5) / count
    u = hops * t % 1
    by = np.column_stack([-1.6 * u * (1 - u), 0.5 * t])
    return by - by.mean(axis=0)


def on(by: np.ndarray, noise: float) -> np.ndarray:
    """A texture that is moved by so many sides at each instant, in noise."""
    waves = np.fft.fft2(texture(1))
    f = np.fft.fftfreq(SIDE, 1 / SIDE)
    turns = np.exp(-2j * np.pi * (by[:, :1, None] * f[:, None] + by[:, 1:, None] * f))
    moved = np.fft.ifft2(waves * turns).real
    return np.asarray(moved + noise * moved.std() * np.random.default_rng(2).standard_normal(moved.shape))


def test_the_corners_of_a_path_are_followed_where_there_are_instants_enough() -> None:
    for count, far in ((54, 0.03), (24, 0.08)):
        by = hopping(2.4, count)
        found = find_bends(on(by, 0.3), None)
        assert found is not None
        missed = displacements(found, count) - by
        assert np.median(np.linalg.norm(missed - np.median(missed, axis=0), axis=1)) < far
        assert len(found) == 2 * max(order for order in ORDERS if 2 * order < count)


def test_a_path_that_noise_leads_astray_is_found_from_end_to_end() -> None:
    by = hopping(1.7, 54)
    waves = Waves(on(by, 5.0))

    def missed(path: np.ndarray) -> float:
        off = path - by
        return float(np.median(np.linalg.norm(off - np.median(off, axis=0), axis=1)))

    assert missed(_tracked(waves, 5)) < 0.06
    assert missed(_seen_from(waves, 5)) > 1  # the next instant alone, without those after it


def test_what_moves_straight_or_not_at_all_does_not_bend() -> None:
    rng, t = np.random.default_rng(6), np.arange(COUNT) / COUNT
    blinking = (1 + np.cos(40 * t))[:, None, None] * abs(texture(3))
    noise = rng.standard_normal((COUNT, SIDE, SIDE))
    for video in (moving((0.3, -0.5)), blinking, noise, np.zeros((COUNT, 8, 8)), texture(3) + 0 * noise):
        assert find_bends(video, find_drift(video)) is None
    assert find_bends(moving(FALLS)[:12], None) is None  # too few instants to tell


@pytest.mark.parametrize(("scene", "gain_db"), [("ball", 0.4), ("pendulum", 1.5)])
def test_what_falls_and_swings_is_followed(
    scene: str, gain_db: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = record(scene, 1302, stages=32, lines=135)
    truth = recorded.truth(3, 1)
    found = reconstruct(recorded.segment, 3, 1)
    assert len(found.parameters["drift"]) > 2
    # The next range gets the velocity, and a path of its own.
    choice = Choice.of(found)
    assert choice is not None
    assert len(choice.drift) == 2
    monkeypatch.setattr("acquire.recon.bends.find_bends", lambda *_: None)
    before = reconstruct(recorded.segment, 3, 1)
    assert found.quality.prediction < 0.95 * before.quality.prediction
    assert psnr(found.video[found.trusted], truth) > psnr(before.video[before.trusted], truth) + gain_db


def test_what_hops_fast_is_not_taken_for_something_that_flows() -> None:
    recorded = record("hopper", 8, stages=80, lines=135)
    truth = recorded.truth(3, 1)
    found = reconstruct(recorded.segment, 3, 1, "fast")
    assert found.parameters["prior"] == "volume"
    # A smooth volume, which predicts as well, is no better than the mean over time.
    mean = np.broadcast_to(truth.mean(axis=0), truth.shape)
    assert psnr(found.video[found.trusted], truth) > psnr(mean, truth) + 6
