"""Light beyond the band is reported with its frequency; motion, slower lamps and noise are not."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from recon_cases import given_for
from scipy.fft import dct

from acquire.evaluate.metrics import psnr
from acquire.forward import DualArm
from acquire.recon import Reconstruction, blinking, reconstruct
from acquire.recon.aliasing import detect_unresolved_light, name_gaps
from acquire.recon.clock import IterationClock
from acquire.recon.problem import build_problem
from acquire.sim.procedural import Recorded, record

SIZES = {"stages": 32, "lines": 150}


def told(warnings: tuple[str, ...]) -> list[str]:
    return [each for each in warnings if each.startswith("light changes at about")]


def test_a_lamp_of_20_khz_that_a_band_leaves_out_is_reported_with_its_frequency() -> None:
    result = reconstruct(record("fastled", 23, **SIZES).segment, 3, 1, bandwidth=0.1)
    (words,) = told(result.warnings)
    found_hz = float(words.removeprefix("light changes at about ").split()[0])
    assert found_hz == pytest.approx(20e3, rel=0.01)
    assert result.parameters["resolved_hz"] < 10e3
    assert f"the {result.parameters['resolved_hz']:.5g} Hz that" in words


@pytest.mark.parametrize("seed", [22, 23, 24])
def test_a_lamp_of_20_khz_is_shown(seed: int) -> None:
    """That of 22 stands out of the residual; the band mimics most of the others."""
    recorded = record("fastled", seed, **SIZES)
    result = reconstruct(recorded.segment, 3, 1, error=False)
    assert not told(result.warnings)
    assert result.parameters["resolved_hz"] > 20e3
    # 20 dB if it is shown as steady
    assert psnr(result.video[result.trusted], recorded.truth(3, 1)) > 28


def held_against(recorded: Recorded, result: Reconstruction, clock: IterationClock) -> tuple[str, ...]:
    """The report on a video, even if its residual is too small for `reconstruct` to check it."""
    segment = recorded.segment
    problem = build_problem(segment, 3, 1, hold_out=0.0)
    lines = DualArm(segment.geometry, segment.code, 3, 1).forward(result.video.astype(np.float32))
    predicted = lines / (problem.norm * problem.scale)
    resolved_hz = result.parameters["resolved_hz"]
    given = given_for(segment, problem, (3, 1), clock=clock)
    return detect_unresolved_light(given, predicted, result.video, resolved_hz)


@pytest.mark.parametrize("scene", ["still", "leds", "splash", "flame", "spark", "disc", "bullet"])
def test_nothing_is_reported_for_scenes_without_fast_light(scene: str) -> None:
    recorded = record(scene, 22, **SIZES)
    result = reconstruct(recorded.segment, 3, 1, "fast", iterations=20, check=False)
    assert not held_against(recorded, result, IterationClock(1))


def test_the_bands_of_lamps_are_named_where_a_video_holds_nothing_between_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # as patterns beside something that moves, it would hold all of the band
    monkeypatch.setattr(blinking, "find_lamps", lambda *_: [])
    recorded = record("leds_dot", 62, **SIZES)
    result = reconstruct(recorded.segment, 3, 1, error=False)
    bands = result.parameters["resolved_bands_hz"]
    assert len(bands) > 1, "a dot that moves is no sum of patterns"
    assert bands[0][0] == 0
    assert result.parameters["resolved_hz"] == bands[-1][1]
    spectrum = np.square(dct(result.video, axis=0, norm="ortho")).sum((1, 2))
    hz = np.arange(len(spectrum)) / len(spectrum) / (2e-9 * recorded.segment.substep_ns)
    for (_, end), (begin, _) in pairwise(bands):
        between = (hz > end) & (hz < begin)
        # negative light is cut off, which adds a little
        assert spectrum[between].sum() < 0.02 * spectrum[1:].sum()
    (words,) = [each for each in result.warnings if each.startswith("the video holds changes of")]
    assert f"{bands[-1][0]:.0f} to {bands[-1][1]:.0f} Hz only" in words


def test_a_band_without_gaps_is_no_warning() -> None:
    assert name_gaps([(0.0, 5000.0)]) == ()
    result = reconstruct(record("splash", 62, **SIZES).segment, 3, 1, "fast", check=False, error=False)
    assert result.parameters["resolved_bands_hz"] == [(0, result.parameters["resolved_hz"])]
