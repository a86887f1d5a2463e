"""The estimated error of a video compared with the truth, and cases in which none is claimed."""

from __future__ import annotations

import threading
import time
import tracemalloc
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import spearmanr

from acquire.recon import Reconstruction, api, reconstruct
from acquire.recon import clock as clocks
from acquire.recon.error import (
    BY_LINES,
    BY_PRIOR,
    REGIONS,
    Indicators,
    VideoError,
    combined_facts,
    error_from,
    in_regions,
    measure_indicators,
    regions_of,
)
from acquire.showing import error_in_words
from acquire.sim.procedural import CLEAN, CameraNoise, Recorded, record

EVERY = slice(None)


@cache
def recorded(scene: str, stages: int = 24, lines: int = 120) -> Recorded:
    return record(scene, 71, stages=stages, lines=lines)


@cache
def solved(scene: str) -> Reconstruction:
    return reconstruct(recorded(scene).segment, 3, 1, "fast")


def test_indicators_of_a_long_video_take_little_memory() -> None:
    rng = np.random.default_rng(1)
    video, other = rng.random((2, 1500, 40, 40), np.float32)
    tracemalloc.start()
    found = measure_indicators(video, other, 0.1, slice(100, 1400), BY_LINES)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # a large sensor's video is a gigabyte, and every copy of it another one
    assert peak < video.nbytes
    assert found is not None
    np.testing.assert_allclose(found.sensitivity**2, in_regions(np.square(other - video)), rtol=1e-4)
    shown = video[100:1400]
    spread = in_regions(np.square(shown - shown.mean(0))).mean(0)
    np.testing.assert_allclose(found.change**2, spread, rtol=1e-4)
    edge = np.zeros_like(shown)
    edge[:, :-1] += np.square(np.diff(shown, axis=1))
    edge[:, :, :-1] += np.square(np.diff(shown, axis=2))
    np.testing.assert_allclose(found.edge**2, in_regions(edge).mean(0), rtol=1e-4)


@pytest.mark.parametrize("scene", ["splash", "leds", "runner"])
def test_it_is_close_to_the_error_and_shows_where_it_is_large(scene: str) -> None:
    result = solved(scene)
    assert isinstance(result.error, VideoError)
    off = result.video[result.trusted] - recorded(scene).truth(3, 1)
    true = np.sqrt(np.square(off).mean())
    assert result.error.rms / 3 < true < 3 * result.error.rms
    assert result.error.low < result.error.rms < result.error.high < result.error.full_scale
    regions = np.sqrt(np.square(result.error.regions[result.trusted]).mean(0))
    assert spearmanr(regions.ravel(), np.sqrt(in_regions(np.square(off)).mean(0)).ravel())[0] > 0.5
    assert result.error.frames.shape == (len(result.video),)
    assert np.sqrt(np.square(result.error.frames[result.trusted]).mean()) == pytest.approx(result.error.rms)


def test_estimating_it_does_not_change_the_video() -> None:
    for scene in ("splash", "leds"):
        without = reconstruct(recorded(scene).segment, 3, 1, "fast", error=False)
        assert np.array_equal(without.video, solved(scene).video)
        assert without.error == "it was not requested"
        assert without.iterations == solved(scene).iterations


def test_it_has_the_unit_of_the_video() -> None:
    segment = recorded("splash").segment
    brighter = reconstruct(replace(segment, responsivity_dn=segment.responsivity_dn / 7), 3, 1, "fast")
    error = solved("splash").error
    assert isinstance(error, VideoError)
    assert isinstance(brighter.error, VideoError)
    assert brighter.error.rms == pytest.approx(7 * error.rms, rel=0.02)


def test_no_estimate_is_made_without_a_basis() -> None:
    segment = recorded("splash").segment
    paper = reconstruct(segment, 3, 1, solver="twist", iterations=3)
    assert paper.error == "its solver offers no way to estimate it"
    stop = threading.Event()
    stop.set()
    stopped = reconstruct(segment, 3, 1, "fast", stop=stop)
    assert stopped.error == "the reconstruction was stopped"
    one_frame = reconstruct(segment, 3, segment.geometry.span, "fast")
    assert one_frame.error == "no frame is sampled in full"
    swapped = replace(segment, lines=segment.lines[::-1].copy(), mask=segment.mask[::-1].copy())
    wrong = reconstruct(swapped, 3, 1, "fast")
    assert not wrong.believed
    assert wrong.error == "the lines contradict their description"
    assert np.isnan(regions_of(wrong.error, 5)).all()


@pytest.mark.parametrize(
    ("scene", "size"), [("splash", (24, 120)), ("leds", (48, 160)), ("still", (24, 120))]
)
def test_a_budget_leaves_time_for_the_estimate(
    scene: str, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Time is processor time of one thread: wall time on a busy machine may allow one iteration only.

    Lamps are larger here: in half a second, the first fit of their curves may take all that is left.
    """
    own = SimpleNamespace(monotonic=time.process_time, process_time=time.process_time)
    monkeypatch.setattr(clocks, "time", own)
    monkeypatch.setattr(api, "time", own)
    monkeypatch.setattr(api, "idle_cores", lambda: 1)  # threads of BLAS that wait take processor time, too
    segment = recorded(scene, *size).segment
    whole_s = reconstruct(segment, 3, 1, "fast").processor_s
    for share in (0.4, 0.7):
        # twice: neighbours in the caches made an iteration too long once in sixty runs
        for _ in range(2):
            began_s = time.process_time()
            result = reconstruct(segment, 3, 1, budget_s=share * whole_s, refuse=False)
            if isinstance(result.error, VideoError):
                break
        assert isinstance(result.error, VideoError), result.error
        assert time.process_time() - began_s < 1.1 * share * whole_s + 0.3


@pytest.mark.parametrize("side", [1, 5, 8, 20, 33])
def test_regions_weigh_all_voxels_equally(side: int) -> None:
    frames = np.random.default_rng(side).random((3, side, side))
    means = in_regions(frames)
    assert means.shape == (3, REGIONS, REGIONS)
    assert np.allclose(means.mean((1, 2)), frames.mean((1, 2)))


def test_an_error_has_degree_one_in_its_indicators() -> None:
    rng = np.random.default_rng(3)
    sensitivity, change, edge = (
        rng.uniform(0.1, 1, (20, 8, 8)),
        rng.uniform(0.1, 1, (8, 8)),
        rng.random((8, 8)),
    )
    once = error_from(Indicators(BY_LINES, 0.1, 2.0, sensitivity, change, edge), EVERY)
    twice = error_from(Indicators(BY_LINES, 0.2, 4.0, 2 * sensitivity, 2 * change, 2 * edge), EVERY)
    assert twice.rms == pytest.approx(2 * once.rms)
    assert np.allclose(twice.regions, 2 * once.regions)
    unsure = error_from(Indicators(BY_LINES, 0.2, 2.0, 2 * sensitivity, change, edge), EVERY)
    assert unsure.rms > once.rms
    cut = Indicators(BY_PRIOR, 0.1, 2.0, sensitivity, change, edge, drift=0.3)
    assert error_from(replace(cut, fine=True), EVERY).rms > error_from(cut, EVERY).rms
    assert error_from(replace(cut, drift=0.9), EVERY).rms > error_from(cut, EVERY).rms
    assert np.sqrt(np.square(once.frames).mean()) == pytest.approx(once.rms)


def test_errors_of_sub_segments_are_combined() -> None:
    parts = [
        {"rms": 0.03, "low": 0.02, "high": 0.05, "full_scale": 1.0},
        {"rms": 0.04, "low": 0.03, "high": 0.08, "full_scale": 2.0},
    ]
    whole = combined_facts(parts, [1, 1])
    assert whole["rms"] == pytest.approx(np.sqrt((0.03**2 + 0.04**2) / 2))
    assert error_in_words(whole) == "about 1.8 % of full scale (1.3 to 3.3 % in nine of ten)"
    unknown = combined_facts([*parts, {"unknown": "the video is dark"}], [1, 1, 1])
    assert error_in_words(unknown) == "unknown: the video is dark"


@pytest.mark.parametrize("camera", [CLEAN, CameraNoise()], ids=["clean", "1e4"])
def test_a_still_finer_than_pixels_is_judged_by_its_prior(camera: CameraNoise) -> None:
    """Its lines are explained to a part in a thousand while the picture is some percent off."""
    made = record("still", 72, stages=24, lines=120, camera=camera)
    result = reconstruct(made.segment, 2, 8, "fast")
    assert isinstance(result.error, VideoError)
    assert result.error.indicators.fine
    off = np.sqrt(np.square(result.video[result.trusted] - made.truth(2, 8)).mean())
    assert result.error.low < off < result.error.high


@pytest.mark.parametrize(("scene", "seed"), [("leds", 71), ("leds", 72), ("leds", 79), ("leds_dot", 73)])
def test_a_video_that_was_cut_short_drifts_and_is_not_underestimated(scene: str, seed: int) -> None:
    """Its lines are explained long before the picture is right: the residual shows less than for others.

    The interval holds nine of ten, as it does for the codes 70 to 79: not 73, whose LEDs are 2.7 times worse.
    """
    made = record(scene, seed, stages=24, lines=120, camera=CLEAN)
    cut = reconstruct(made.segment, 3, 1, "best", iterations=40)
    assert cut.ended == "done"
    assert isinstance(cut.error, VideoError)
    assert cut.error.indicators.exponents is BY_PRIOR
    assert cut.error.indicators.drift > 0.1
    off = np.sqrt(np.square(cut.video[cut.trusted] - made.truth(3, 1)).mean())
    assert cut.error.low < off < cut.error.high
    settled = solved("splash")
    assert settled.ended == "converged"
    assert isinstance(settled.error, VideoError)
    assert settled.error.indicators.exponents is BY_LINES
