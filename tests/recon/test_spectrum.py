"""The spectrum of what flows: its denoiser against a closed form, and whole reconstructions."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.fft import dctn, idctn

from acquire.evaluate.metrics import psnr
from acquire.recon import reconstruct
from acquire.recon.reuse import Choice
from acquire.recon.smooth import Wiener
from acquire.sim.procedural import CameraNoise, Recorded, record

if TYPE_CHECKING:
    from acquire.recon.result import Reconstruction


@cache
def recorded(scene: str) -> Recorded:
    return record(scene, 2201, stages=32, lines=200, camera=CameraNoise(1e4))


@cache
def found(scene: str) -> Reconstruction:
    return reconstruct(recorded(scene).segment, 3, 1, error=False)


def quality_db(result: Reconstruction, scene: str) -> float:
    return psnr(result.video[result.trusted], recorded(scene).truth(3, 1))


def test_the_denoiser_is_wieners_filter() -> None:
    rng = np.random.default_rng(1)
    theta, penalty = rng.standard_normal((3, 8, 8)), rng.uniform(0, 5, (3, 8, 8))
    wanted = idctn(dctn(theta, axes=(1, 2), norm="ortho") / (1 + 0.7 * penalty), axes=(1, 2), norm="ortho")
    np.testing.assert_allclose(Wiener(lambda *_: penalty).prox(theta, 0.7), wanted, atol=1e-12)


@pytest.mark.parametrize("scene", ["flame", "waves"])
def test_what_flows_is_better_with_its_own_spectrum(scene: str, monkeypatch: pytest.MonkeyPatch) -> None:
    learned = found(scene)
    assert learned.parameters["prior"] == "smooth"
    assert learned.parameters["learned"]
    monkeypatch.setattr("acquire.recon.choose.learn_spectrum", lambda smooth: smooth)
    without = reconstruct(recorded(scene).segment, 3, 1, error=False)
    assert quality_db(learned, scene) > quality_db(without, scene) + 1.0


def test_what_flows_is_recognised_on_a_larger_sensor() -> None:
    """There, a smooth volume takes more iterations until it predicts as well as the cosines."""
    larger = record("flame", 5302, stages=80, lines=150)
    found, truth = reconstruct(larger.segment, 3, 1, "fast", error=False), larger.truth(3, 1)
    assert found.parameters["learned"]
    mean = np.broadcast_to(truth.mean(axis=0), truth.shape)
    assert psnr(found.video[found.trusted], truth) > psnr(mean, truth) + 0.3


@pytest.mark.parametrize("scene", ["runner", "splash", "flicker"])
def test_what_moves_or_flickers_does_not_flow(scene: str) -> None:
    """A quadratic prior admits noise that hardly shows in the lines, with any spectrum."""
    parameters = found(scene).parameters
    assert not parameters.get("learned")
    assert not any(each.get("learned") for each in parameters["candidates"])


def test_the_next_part_learns_a_spectrum_of_its_own() -> None:
    choice = Choice.of(found("flame"))
    assert choice is not None
    # With a known noise, a choice that leaves more than that is not handed over.
    choice = replace(choice, noise=0.0)
    again = reconstruct(recorded("flame").segment, 3, 1, error=False, choice=choice)
    assert choice.kept(again.parameters)
    assert again.parameters["learned"]
    assert len(again.parameters["candidates"]) < len(found("flame").parameters["candidates"])
    assert quality_db(again, "flame") == pytest.approx(quality_db(found("flame"), "flame"), abs=0.5)


def test_light_that_flickers_does_not_flow_even_where_that_predicts_better_than_motion() -> None:
    flickering = record("flicker", 2504, camera=CameraNoise(1e4))
    result = reconstruct(flickering.segment, 3, 1, preset="fast", error=False)
    assert result.parameters["brightness"]
    # Until it was compared with a volume of changing brightness, a smooth one was preferred, of 17 dB.
    assert psnr(result.video[result.trusted], flickering.truth(3, 1)) > 26
