"""Where a camera goes on after it was away, told by its own clock."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from acquire.stream.lineclock import LineClock

PERIOD_NS = 30_000.0


def clock_after(blocks: int, ppm: float, jitter_ns: list[int] | None = None) -> tuple[LineClock, float]:
    """A clock that saw blocks of 256 lines, and the true period by the camera's clock."""
    clock, period_ns = LineClock(PERIOD_NS), PERIOD_NS * (1 + ppm * 1e-6)
    for k in range(blocks):
        wander = jitter_ns[k % len(jitter_ns)] if jitter_ns else 0
        clock.note(256 * k, round(10**15 + 256 * k * period_ns) + wander)
    return clock, period_ns


@given(ppm=st.floats(-200, 200), away=st.integers(300, 100_000), blocks=st.integers(200, 400))
def test_the_line_after_a_pause_is_found_whatever_the_drift(ppm: float, away: int, blocks: int) -> None:
    clock, period_ns = clock_after(blocks, ppm)
    line = 256 * (blocks - 1) + away
    assert clock.line_at(round(10**15 + line * period_ns)) == line
    assert abs(clock.drift_ppb - ppm * 1000) < 50


def test_a_time_without_a_certain_line_has_none() -> None:
    clock, period_ns = clock_after(50, 20.0)
    last = 256 * 49
    assert clock.line_at(round(10**15 + (last + 1000.5) * period_ns)) is None
    assert clock.line_at(10**15) is None, "before the last stamp"
    assert LineClock(PERIOD_NS).line_at(10**15) is None
    wandering, _ = clock_after(50, 0.0, [0, 12_000, -9_000])
    assert wandering.line_at(round(10**15 + (last + 1000) * PERIOD_NS)) is None


def test_the_drift_follows_the_camera_s_temperature() -> None:
    clock, time_ns = LineClock(PERIOD_NS), 0.0
    for k in range(40_000):
        clock.note(512 * k, round(time_ns))
        time_ns += 512 * PERIOD_NS * (1 + (10e-6 if k < 10_000 else 30e-6))
    assert abs(clock.drift_ppb - 30_000) < 10
