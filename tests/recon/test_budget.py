"""A budget is kept in wall time, however long iterations take, and refused if that is impossible."""

from __future__ import annotations

import threading
import time
from itertools import pairwise

import numba
import numpy as np
import pytest
from recon_cases import Wall

from acquire.errors import UsageError
from acquire.geometry import Geometry
from acquire.lines import Segment
from acquire.recon import Look, reconstruct
from acquire.recon import clock as clocks
from acquire.recon.clock import IterationClock


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> Wall:
    made = Wall()
    monkeypatch.setattr(clocks, "time", made)
    return made


def segment(geometry: Geometry) -> Segment:
    """Light that differs from line to line and from pixel to pixel."""
    draw = np.random.default_rng(3)
    return Segment(
        lines=draw.uniform(100, 200, geometry.lines_shape).astype(np.float32),
        mask=np.ones(geometry.lines_shape, bool),
        code=draw.integers(0, 2, geometry.span).astype(np.uint8),
        geometry=geometry,
        time_ns=np.arange(geometry.lines, dtype=np.int64) * 30_000,
        substep_ns=10_000.0,
    )


@pytest.mark.parametrize("each_s", [0.01, 0.1, 0.4])
def test_the_work_after_the_last_iteration_fits_into_the_budget(wall: Wall, each_s: float) -> None:
    clock = IterationClock(1000, 5.0)
    for _ in clock.run(1000, "solve"):
        wall.now += each_s
    wall.now += 1.5 * each_s  # the video
    assert 4.5 - 2 * each_s < clock.seconds <= 5.0
    assert clock.ended == "budget"


def test_a_machine_that_gets_busy_ends_it_earlier(wall: Wall) -> None:
    clock = IterationClock(1000, 10.0)
    for number in clock.run(1000, "solve"):
        wall.now += 0.1 if number < 50 else 0.6
    wall.now += 0.9
    assert 8.0 < clock.seconds <= 10.6


def test_a_stage_with_longer_iterations_is_not_started_too_late(wall: Wall) -> None:
    clock = IterationClock(1000, 10.0)
    for _ in clock.run(1000, "first look", 0.95):
        wall.now += 0.2
    assert clock.ended == "done"
    assert list(clock.run(1000, "refine")) == []
    assert clock.ended == "budget"
    assert clock.longest_s == pytest.approx(0.2)


def test_a_stage_that_goes_on_is_no_new_one(wall: Wall) -> None:
    clock = IterationClock(1000, 10.0)
    for most in (95, 1000):  # at 8.55 s four times a long iteration no longer fits, but one does
        for number in clock.run(most, "refine"):
            wall.now += 0.41 if number % 5 == 4 else 0.01
    assert clock.ended == "budget"
    assert 8.8 < clock.seconds <= 10.0 - 0.02 * 10.0 - 1.5 * 0.41


@pytest.mark.parametrize(("first", "begins"), [(4.0, True), (20.0, False)])
def test_a_stage_says_how_long_its_beginning_may_take(wall: Wall, first: float, begins: bool) -> None:
    clock = IterationClock(1000, 10.0)
    for _ in clock.run(80, "first look"):
        wall.now += 0.1
    assert bool(list(clock.run(1, "refine", first=first))) == begins


def test_the_first_iteration_runs_even_after_the_deadline(wall: Wall) -> None:
    clock = IterationClock(10, 1.0)
    wall.now += 2.0
    assert list(clock.run(10, "solve")) == [0]


def test_time_is_reserved_for_iterations_after_the_last(wall: Wall) -> None:
    clock = IterationClock(1000, 10.0)
    clock.reserve(10)
    for _ in clock.run(1000, "solve"):
        wall.now += 0.1
    assert 8.3 < clock.seconds <= 9.0
    for _ in clock.run_reserved(1000):
        wall.now += 0.1
    assert 9.3 < clock.seconds <= 10.0
    clock = IterationClock(1000, 10.0)
    clock.reserve(1000)
    for _ in clock.run(1000, "solve"):
        wall.now += 0.01
    assert clock.seconds == pytest.approx(8.3, abs=0.1)  # no more than 15 % are kept


def test_one_long_iteration_in_five_does_not_end_the_reserved_ones(wall: Wall) -> None:
    clock = IterationClock(1000, 10.0)
    wall.now += 8.0
    made = 0
    for made in clock.run_reserved(1000):
        wall.now += 0.5 if made % 5 == 4 else 0.02
    assert made > 8
    assert clock.seconds <= 10.0


def test_the_fewest_reserved_iterations_run_if_they_fit(wall: Wall) -> None:
    for least, expected in ((0, 1), (2, 2)):
        clock = IterationClock(1000, 10.0)
        wall.now += 8.5
        for _ in clock.run_reserved(1000, least):
            wall.now += 0.6
        assert clock.seconds == pytest.approx(8.5 + 0.6 * expected)


@pytest.mark.parametrize(("left_s", "first"), [(6.0, 15), (2.0, 8), (0.9, 0)])
def test_iterations_to_be_repeated_leave_time_for_the_second_pass(
    wall: Wall, left_s: float, first: int
) -> None:
    clock = IterationClock(1000, 10.0)
    for _ in clock.run(1, "solve"):
        wall.now += 0.1
    wall.now += 9.9 - left_s
    made = again = 0
    for made, _ in enumerate(clock.run_reserved(15, repeat=4), 1):  # noqa: B007
        wall.now += 0.1
    for again, _ in enumerate(clock.run_reserved(max(made, 4), 2), 1):  # noqa: B007
        wall.now += 0.1
    assert made == first
    assert again == max(made, 4)
    assert clock.seconds <= 10.0


def test_compilation_is_not_counted() -> None:
    began = time.monotonic()
    clock = IterationClock(10, 1.0)
    numba.njit(lambda x: x * 2 + 1)(3)
    assert clock.compiled_s > 0
    assert clock.seconds + clock.compiled_s <= time.monotonic() - began + 1e-3


def test_a_budget_is_kept_in_wall_time() -> None:
    began = time.monotonic()
    result = reconstruct(
        segment(Geometry(20, 3, 120)), 3, 1, budget_s=0.8, solver="twist-band", iterations=100_000
    )
    took_s = time.monotonic() - began - result.compiled_s
    assert result.ended == "budget"
    assert 0.4 < took_s <= 1.1 * 0.8 + 0.3
    assert result.seconds <= took_s


@pytest.mark.parametrize("solver", ["admm", "twist"])
def test_look_receives_the_answer_so_far_and_its_time_is_not_counted(solver: str) -> None:
    seen: list[Look] = []
    videos: list[np.ndarray] = []

    def look(now: Look) -> None:
        seen.append(now)
        videos.append(now.video())
        time.sleep(0.1)

    result = reconstruct(segment(Geometry(20, 3, 120)), 3, 1, solver=solver, iterations=8, look=look)
    counts = [each.iteration for each in seen]
    assert counts == sorted(set(counts))
    assert 0 < len(seen) <= counts[-1] == result.iterations
    assert all(0 < one.seconds < other.seconds for one, other in pairwise(seen))
    assert 0 < seen[-1].processor_s <= result.processor_s
    np.testing.assert_allclose(videos[-1], result.video, rtol=1e-5, atol=1e-4)
    plain = reconstruct(segment(Geometry(20, 3, 120)), 3, 1, solver=solver, iterations=8)
    np.testing.assert_allclose(plain.video, result.video, rtol=1e-5, atol=1e-4)


def test_the_look_callback_uses_none_of_the_budget(wall: Wall) -> None:
    clock = IterationClock(1000, 5.0)
    clock.on_look = lambda _: setattr(wall, "now", wall.now + 2.0)
    for _ in clock.run(30, "solve", video=lambda: np.zeros((1, 1, 1))):
        wall.now += 0.1
    assert (clock.done, clock.ended) == (30, "done")
    assert clock.seconds == pytest.approx(3.0)


def test_an_impossible_budget_is_refused_with_what_is_possible() -> None:
    large = segment(Geometry(64, 3, 263))
    with pytest.raises(UsageError, match=r"budget of 0.001 s cannot be kept: .* at least [\d.]+ s here"):
        reconstruct(large, 1, 4, budget_s=0.001)


def test_an_impossible_budget_that_is_not_refused_does_the_minimum() -> None:
    result = reconstruct(segment(Geometry(20, 3, 120)), 3, 1, budget_s=1e-6, refuse=False)
    assert result.iterations <= 3
    assert result.ended == "budget"
    assert any("the budget left no time to try more" in each for each in result.warnings)
    assert any("its budget was too short" in each for each in result.warnings)


@pytest.mark.parametrize("budget_s", [None, 60.0])
def test_an_interrupted_run_names_the_interruption(budget_s: float | None) -> None:
    """It blamed a budget that it may not have had, and too few iterations."""
    stop = threading.Event()
    lines = segment(Geometry(20, 3, 120))
    result = reconstruct(lines, 3, 1, budget_s=budget_s, stop=stop, progress=lambda _: stop.set())
    assert result.ended == "stopped"
    assert any("the interruption left no time to try more" in each for each in result.warnings)
    assert any("it was interrupted too early" in each for each in result.warnings)
    assert not any("budget" in each or "too few" in each for each in result.warnings)
