"""Residuals compared with the cameras' noise: the noise against random draws, the verdict on videos."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acquire.calibrate.orientation import VIEWS, oriented
from acquire.errors import UsageError
from acquire.lines import merged
from acquire.noise import Noise
from acquire.recon import Quality, reconstruct
from acquire.sim.procedural import CameraNoise, record

NOISE = Noise((0.4, 0.2), (3.0, 5.0))


def test_variance_is_that_of_drawn_samples() -> None:
    """Electrons of Poisson's law, Gaussian read-out, rounded: EMVA 1288, Eq. (9)."""
    rng = np.random.default_rng(5)
    light = np.array([[0.0, 200.0, 3000.0], [0.0, 200.0, 3000.0]])[:, None, :]
    K = np.reshape(NOISE.dn_per_electron, (2, 1, 1))
    drawn = rng.poisson(np.broadcast_to(light / K, (2, 40_000, 3))) * K
    drawn = np.rint(drawn + rng.standard_normal(drawn.shape) * np.reshape(NOISE.dark_noise_dn, (2, 1, 1)))
    np.testing.assert_allclose(drawn.var(axis=1), NOISE.variance_dn2(light)[:, 0], rtol=0.03)


def test_variance_of_merged_samples_is_that_of_sums_of_rounded_ones() -> None:
    """Rounding was counted once: of a camera with little noise, merged lines seemed not to be explained."""
    rng = np.random.default_rng(5)
    quiet = Noise((0.0, 0.0), (0.3, 0.6))
    light = 100.0 + rng.random((2, 40_000, 9))  # the fractions are those of a scene
    drawn = light + rng.standard_normal(light.shape) * np.reshape(quiet.dark_noise_dn, (2, 1, 1))
    off = (np.rint(drawn) - light).sum(axis=2)
    np.testing.assert_allclose(
        off.var(axis=1), quiet.merged(3).variance_dn2(np.zeros((2, 1, 1)))[:, 0, 0], rtol=0.03
    )


@pytest.mark.parametrize("bad", [-1.0, float("nan"), float("inf")])
def test_impossible_noise_is_refused(bad: float) -> None:
    with pytest.raises(UsageError, match="noise"):
        Noise((bad, 1.0), (1.0, 1.0))


def test_merged_and_swapped_arms_keep_their_noise() -> None:
    segment = record("still", 1, stages=12, substeps=1, lines=24, camera=CameraNoise(1e4)).segment
    whole = replace(segment, noise=NOISE, lines=segment.lines.astype(np.float64), mask=segment.mask | True)
    summed = merged(whole, 3).variance()
    each = whole.variance()
    assert each is not None
    assert summed is not None
    np.testing.assert_allclose(summed, each.reshape(2, 8, 3, 4, 3).sum(axis=(2, 4)), rtol=1e-9)
    views = [view for view in VIEWS if view.crosses]
    assert {view.swapped for view in views} == {False, True}
    for view in views:
        assert oriented(whole, view).noise == (NOISE.swapped() if view.swapped else NOISE)


@pytest.mark.parametrize(
    ("misfit", "prediction", "noise", "standing"),
    [
        (0.010, 0.011, 0.010, "explained"),
        (0.009, 0.017, 0.010, "nearly explained"),
        (0.007, 0.050, 0.010, "over-fitted"),
        (0.030, 0.050, 0.010, "not explained"),
        (0.011, float("nan"), 0.010, "explained"),
        (0.010, 0.011, float("nan"), "unknown"),
    ],
)
def test_standings(misfit: float, prediction: float, noise: float, standing: str) -> None:
    assert Quality(misfit, prediction, 1.0, noise).standing == standing


def test_a_still_is_explained_and_text_in_motion_is_not() -> None:
    def standing(scene: str) -> str:
        segment = record(scene, 77, stages=32, lines=100, camera=CameraNoise(1e4)).segment
        return reconstruct(segment, 3, 3, "fast").quality.standing

    assert standing("still") in ("explained", "nearly explained")
    assert standing("text") in ("over-fitted", "not explained")
