"""A volume before a still ground: its prox, the steps of its search, and whole reconstructions with noise."""

from __future__ import annotations

import array_api_strict
import numpy as np
import pytest

from acquire.evaluate.metrics import psnr
from acquire.recon import choose, following, reconstruct
from acquire.recon.candidates import CYCLE, GROUND, GROUNDED, STILL, VOLUME, Candidate
from acquire.recon.ground import GroundedTv
from acquire.recon.tv import FrameTv
from acquire.recon.volume import VolumeTv
from acquire.sim.procedural import record

PACE, WEIGHT = 2.0, 0.05


def settled(denoiser: VolumeTv, theta: np.ndarray, calls: int = 400) -> np.ndarray:
    """The prox after so many calls that volume and ground no longer change."""
    for _ in range(calls):
        cleaned = denoiser.prox(theta, WEIGHT)
    return np.asarray(cleaned)


@pytest.mark.parametrize("drift", [(), (0.4, -0.25)])
@pytest.mark.parametrize("weight", [0.1, 0.5])
def test_a_still_costs_its_own_total_variation(weight: float, drift: tuple[float, ...]) -> None:
    """Of light that never changes, all is the ground's: its prox is that of one frame, whatever drifts."""
    theta = np.zeros((7, 8, 8), np.float32)
    theta[0] = np.random.default_rng(0).random((8, 8))
    expected = FrameTv(3000).prox(theta[:1], WEIGHT * weight * 7**0.5)
    cleaned = settled(GroundedTv(PACE, weight, drift=drift), theta)
    np.testing.assert_allclose(cleaned[:1], expected, atol=2e-3)
    np.testing.assert_allclose(cleaned[1:], 0, atol=2e-3)


def test_it_is_the_minimum_over_every_ground() -> None:
    theta = np.random.default_rng(1).random((5, 6, 6)).astype(np.float32)
    denoiser = GroundedTv(PACE, 0.3)
    cleaned = settled(denoiser, theta)
    ground = denoiser._still
    volume = settled(VolumeTv(PACE), theta)

    def cost(x: np.ndarray, still: np.ndarray) -> float:
        moving = x.copy()
        moving[:1] -= still
        instants = np.tensordot(cosines.T, moving, axes=1)
        steps = [np.diff(instants, axis=axis, append=instants.take([-1], axis)) for axis in range(3)]
        variation = np.sqrt((PACE * steps[0]) ** 2 + steps[1] ** 2 + steps[2] ** 2).sum()
        detail = 0.3 * 5**0.5 * FrameTv(1).value(still.astype(np.float32))
        return float(0.5 * np.square(x - theta).sum() + WEIGHT * (variation + detail))

    k = np.arange(5)
    cosines = np.cos(np.pi * k[:, None] * (k + 0.5) / 5) * np.where(k, 0.4, 0.2)[:, None] ** 0.5
    least = cost(cleaned, ground)
    assert least < cost(volume, np.zeros_like(ground)) - 1e-3
    rng = np.random.default_rng(2)
    for size in (1e-1, 1e-2, 3e-3):
        for _ in range(20):
            other = cleaned + size * rng.standard_normal(cleaned.shape)
            assert least < cost(other, ground + size * rng.standard_normal(ground.shape)) + 1e-4


def test_another_library_makes_the_same_steps() -> None:
    theta = np.random.default_rng(3).standard_normal((5, 8, 8)).astype(np.float32)
    ours, theirs = GroundedTv(PACE, 0.2), GroundedTv(PACE, 0.2)
    for _ in range(3):
        strict = theirs.prox(array_api_strict.asarray(theta), 0.2)
        np.testing.assert_allclose(ours.prox(theta, 0.2), np.from_dlpack(strict), atol=1e-5)


def test_another_trial_goes_on_from_where_one_ended() -> None:
    theta = np.random.default_rng(4).random((5, 6, 6)).astype(np.float32)
    first, second = GroundedTv(PACE, 0.2), GroundedTv(PACE, 0.2)
    for _ in range(5):
        first.prox(theta, WEIGHT)
    second.resume(first)
    np.testing.assert_array_equal(second.prox(theta, WEIGHT), first.prox(theta, WEIGHT))


def test_a_search_finds_a_ground_for_any_volume_and_cycle() -> None:
    def reached(candidate: Candidate) -> set[float]:
        return {each.ground for step in candidate.steps(200) if (each := step(candidate)) is not None}

    assert reached(VOLUME) == reached(CYCLE) == {0.0, GROUND}
    assert reached(STILL) == {0.0}
    assert reached(GROUNDED) == {GROUND, 0.0316, 0.316}
    assert VOLUME.is_stronger_than(GROUNDED)
    heavier = GROUNDED.with_ground(3)
    assert heavier is not None
    assert heavier.is_stronger_than(GROUNDED)
    assert GROUNDED.with_ground(0.01) is None
    assert GROUNDED.with_ground(10) is None


def test_what_moves_before_a_textured_ground_leaves_it_its_detail(monkeypatch: pytest.MonkeyPatch) -> None:
    """A figure of many limbs, by which a still alone is spoiled: more than 1 dB, chosen without the truth."""
    recorded = record("runner", 97, stages=32, lines=160)
    truth = recorded.truth(3, 1)
    grounded = reconstruct(recorded.segment, 3, 1, error=False)
    assert grounded.parameters["ground"] > 0
    monkeypatch.setattr(choose, "GROUNDED", VOLUME)
    monkeypatch.setattr(following, "GROUND", 0.0)
    monkeypatch.setattr(Candidate, "with_ground", lambda *_, **__: None)
    without = reconstruct(recorded.segment, 3, 1, error=False)
    assert not without.parameters.get("ground")
    quality = [psnr(each.video[each.trusted], truth) for each in (grounded, without)]
    assert quality[0] > quality[1] + 1
