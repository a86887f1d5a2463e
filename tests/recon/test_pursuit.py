"""The first look at lamps: which cosines it keeps, and that scenes without lamps are left to the search."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from recon_cases import given_for

from acquire.arrays import host
from acquire.evaluate.metrics import psnr
from acquire.lines import Segment
from acquire.recon import cosines, pursuit, reconstruct
from acquire.recon.bandwidth import FEWEST_COEFFICIENTS, MARGIN
from acquire.recon.basis import LearnedBasis, TemporalBasis, reachable
from acquire.recon.given import Given
from acquire.recon.problem import build_problem
from acquire.recon.pursuit import pursue, widened
from acquire.sim.procedural import record

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.recon.estimates import InBand


@cache
def posed(scene: str, seed: int) -> Given:
    segment = record(scene, seed, stages=32, lines=200).segment
    return given_for(segment, build_problem(segment, 3, 1, hold_out=0.08), (3, 1))


def without_limit(_: InBand, most: int) -> Iterator[int]:
    yield from range(most)


def look_at(scene: str, seed: int, last_lamp: int = 0) -> InBand | None:
    return pursue(posed(scene, seed), without_limit, lambda: last_lamp)


def kept(look: InBand) -> list[int]:
    assert isinstance(look.basis, LearnedBasis)
    return np.flatnonzero(look.basis.curves.any(axis=1)).tolist()


def end_of_lamps(segment: Segment) -> int:
    """Number of cosines up to the lamp of 5 kHz, the fastest of `leds`, at 100 kHz."""
    return round(2 * segment.geometry.span * 5e3 / 1e5)


@pytest.mark.parametrize("seed", range(61, 69))
def test_lamps_are_found_without_the_cosines_between_them(seed: int) -> None:
    look = look_at("leds", seed)
    assert look is not None
    last = end_of_lamps(posed("leds", seed).segment)
    held = kept(look)
    assert {*range(FEWEST_COEFFICIENTS), last - 1, last, last + 1} <= {*held}
    assert len(held) < FEWEST_COEFFICIENTS + 25
    # no sidelobe of the code widens the band
    assert look.basis.cosines <= round(MARGIN * (last + 4))


@pytest.mark.parametrize("scene", ["still", "runner", "splash", "flame", "bullet", "text"])
@pytest.mark.parametrize("seed", [61, 62])
def test_scenes_without_lamps_are_left_to_the_search_of_the_band(scene: str, seed: int) -> None:
    assert look_at(scene, seed) is None


def test_a_lamp_of_the_covariance_is_looked_at_wherever_it_is() -> None:
    assert look_at("runner", 61, last_lamp=150) is None, "without others it is no scene of lamps"
    look = look_at("leds", 61, last_lamp=150)
    assert look is not None
    assert {*range(143, 151)} <= {*kept(look)}


def test_another_cosine_leaves_the_picture_as_it_is() -> None:
    leds, look = posed("leds", 61), look_at("leds", 61)
    assert look is not None
    wider = widened(leds, look, 200)
    assert {*kept(look), 198, 199, 200, 201, 202} == {*kept(wider)}
    assert wider.basis.cosines >= 203
    np.testing.assert_allclose(wider.video(), look.video(), atol=1e-5 * look.video().max())
    whole = cosines.begin_in_cosines(leds, TemporalBasis(look.basis.frames, 40), None)
    whole.solver.step()
    beyond = widened(leds, whole, 100)
    assert kept(beyond) == [*range(40), *range(98, 103)]
    np.testing.assert_allclose(host(beyond.solver.theta)[:40], host(whole.solver.theta))


def test_only_lamps_that_the_held_out_samples_need_are_sure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fig. 9 with code 694 had a sidelobe of 3 % of a lamp's energy, for which no patterns were found."""
    monkeypatch.setattr(pursuit, "DOUBTFUL", np.inf)
    leds, look = posed("leds", 61), look_at("leds", 61)
    assert look is not None
    lamp, sidelobe = end_of_lamps(leds.segment), 200
    wider = widened(leds, look, sidelobe)
    near = np.abs(wider.basis.held - sidelobe) <= pursuit.BESIDE
    theta = host(wider.solver.theta).copy()
    noise = np.random.default_rng(3).standard_normal(theta[near].shape).astype(theta.dtype)
    energy = np.square(theta[np.abs(wider.basis.held - lamp) <= pursuit.BESIDE]).sum()
    theta[near] = noise * np.sqrt(0.03 * energy / np.square(noise).sum())
    wider.solver.theta = theta
    both = np.array([lamp, sidelobe])
    found = pursuit._Look(leds, wider, wider.basis.held)
    np.testing.assert_array_equal(found.needed(both), [lamp])
    unheld = replace(leds, problem=leds.problem.with_all_samples())
    found = pursuit._Look(unheld, wider, wider.basis.held)
    np.testing.assert_array_equal(found.needed(both), both)


def test_a_look_that_may_not_iterate_ends() -> None:
    assert pursue(posed("leds", 61), lambda *_: iter(()), lambda: 0) is None


def test_a_short_video_has_no_fast_cosines_to_look_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pursuit, "begin_in_cosines", lambda *_: pytest.fail("begun"))
    leds = posed("leds", 61)
    T_m = leds.segment.geometry.span // 40
    problem = build_problem(leds.segment, 3, T_m, hold_out=0.08)
    coarse = replace(leds, problem=problem, options=replace(leds.options, temporal_merge=T_m))
    assert pursue(coarse, without_limit, lambda: 0) is None


def test_lamps_are_shown_better_and_sooner_than_in_the_whole_band() -> None:
    segment = posed("leds", 61).segment
    lamps = reconstruct(segment, 3, 1, check=False, error=False)
    last = end_of_lamps(segment)
    assert lamps.parameters["patterns"] <= 5
    assert last < lamps.parameters["temporal_coefficients"] < 1.4 * last


@pytest.mark.parametrize(
    ("frames", "temporal_merge", "share", "reach"),
    [(981, 1, 0.25, 245), (981, 1, 0.5, 490), (245, 4, 0.25, 245), (123, 8, 0.25, 123), (123, 8, 0.5, 123)],
)
def test_slow_frames_reach_as_far_as_they_can_show(
    frames: int, temporal_merge: int, share: float, reach: int
) -> None:
    assert reachable(frames, temporal_merge, share) == reach


def test_lamps_are_followed_in_frames_of_many_substeps() -> None:
    """Frames of eight sub-steps (12.5 kHz) had a band of 1.6 kHz, and lamps of 2.5 and 5 kHz were lost."""
    recorded = record("leds", 1, stages=24)
    result = reconstruct(recorded.segment, 3, 8)
    assert result.parameters["prior"] == "cosines"
    assert result.parameters["resolved_bands_hz"][-1][1] > 5e3
    assert psnr(result.video[result.trusted], recorded.truth(3, 8)) > 25.5
