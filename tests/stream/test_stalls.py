"""Which arm is taken for stalled, and when, with clocks set by hand."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from test_session import MemoryWriter, feed, make_session, ring_block

from acquire.processes.shared import Counters
from acquire.store import RunCondition
from acquire.stream.losses import Cause
from acquire.stream.ring import Ring, RingShape
from acquire.stream.session import Session
from acquire.stream.stalls import HELD_UP_S, ArmView, Excess, Heartbeat, HoldUps, find_stall

LIMIT_S, SKEW = 10.0, 1000


@pytest.fixture
def arms() -> Iterator[dict[str, ArmView]]:
    rings = {name: Ring(name, RingShape(4, 16, 1, "uint8")) for name in "ab"}
    yield {name: ArmView(ring) for name, ring in rings.items()}
    for ring in rings.values():
        ring.close()


def silence(arms: dict[str, ArmView], a: float, b: float) -> None:
    now_s = time.monotonic()
    arms["a"].revive(now_s - a)
    arms["b"].revive(now_s - b)


def make(lines: int | None = None) -> Session:
    session = make_session(MemoryWriter(), lines=lines)
    feed(session, 100, 80)
    return session


@pytest.mark.parametrize(
    ("a", "b", "stalled"),
    [
        (0.0, 0.0, None),
        (0.0, LIMIT_S * 0.9, None),
        (0.0, LIMIT_S * 1.1, ("b",)),
        (LIMIT_S * 1.1, 1.0, ("a",)),
        (LIMIT_S * 1.1, LIMIT_S * 0.9, ("a", "b")),
    ],
)
def test_silent_arms_are_named(
    arms: dict[str, ArmView], a: float, b: float, stalled: tuple[str, ...] | None
) -> None:
    silence(arms, a, b)
    found = find_stall(make(), arms, time.monotonic(), LIMIT_S, SKEW)
    assert (found and found.arms) == stalled
    if found is not None:
        both = len(found.arms) == 2
        assert found.condition is (RunCondition.INTERRUPTED if both else RunCondition.INCOMPLETE)
        assert "no line for 10 s" in found.reason


def test_an_arm_that_has_all_its_lines_or_is_given_up_is_not_waited_for(arms: dict[str, ArmView]) -> None:
    silence(arms, LIMIT_S * 2, 0.0)
    assert find_stall(make(lines=100), arms, time.monotonic(), LIMIT_S, SKEW) is None
    session = make()
    session.lost["a"] = Cause.STALLED
    assert find_stall(session, arms, time.monotonic(), LIMIT_S, SKEW) is None


def test_an_arm_that_lags_too_far_is_named(arms: dict[str, ArmView]) -> None:
    session = make()
    assert session.skew == 20
    session.take("a", ring_block("a", 100, SKEW))
    found = find_stall(session, arms, time.monotonic(), LIMIT_S, SKEW)
    assert found is not None
    assert (found.arms, found.condition) == (("b",), RunCondition.INCOMPLETE)
    assert f"{SKEW + 20} lines behind" in found.reason


def test_what_waits_in_the_ring_is_life(arms: dict[str, ArmView]) -> None:
    arm = arms["a"]
    now_s = arm.alive_s
    arm.watch(now_s + 1)
    assert arm.alive_s == now_s
    slot = arm.ring.claim(0, 16)
    assert slot is not None
    arm.ring.commit(slot)
    del slot
    for later in (2, 3):
        arm.watch(now_s + later)
        assert arm.alive_s == now_s + later
    assert arm.ring.acquire() is not None
    arm.ring.release()
    arm.watch(now_s + 4)
    assert arm.alive_s == now_s + 3


@pytest.fixture
def counters() -> Iterator[Counters]:
    made = Counters(("beats",))
    yield made
    made.close()


def test_a_counter_that_stands_still_shows_no_life(counters: Counters) -> None:
    now_s = time.monotonic()
    heart = Heartbeat(counters, "beats")
    for k in range(1, 6):
        still_s = heart.update(now_s + 0.3 * k)
    assert still_s == pytest.approx(1.5, abs=0.01)
    counters.add("beats", 1)
    assert heart.update(now_s + 1.6) == 0
    assert heart.update(now_s + 1.8) == pytest.approx(0.2)
    heart.revive()
    assert heart.update(now_s + 1.9) == pytest.approx(0.1)


def test_the_watchers_own_absence_is_not_held_against_the_watched(counters: Counters) -> None:
    heart = Heartbeat(counters, "beats")
    assert heart.update(time.monotonic() + 1000) < 1


def test_a_camera_ahead_of_the_trigger_is_told_but_not_from_a_pause_of_the_watcher() -> None:
    counters = Counters(("next_line",))
    try:
        counters["next_line"] = 1000
        now_s, excess = time.monotonic(), Excess(counters, 100, 3.0)
        assert excess.update(899, now_s + 0.1) == 0
        # The tags are unread, too, of a time in which this process did not run.
        assert excess.update(899, now_s + 60.0) == 0
        assert excess.update(900, now_s + 60.1) == 0
        found = [excess.update(899, now_s + 60.1 + 0.3 * k) for k in range(1, 12)]
        assert found == [0] * 10 + [1000]
    finally:
        counters.close()


def test_a_hold_up_counts_until_lines_that_came_after_it_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [1000.0]
    monkeypatch.setattr("acquire.stream.stalls.time.monotonic", lambda: clock[0])
    found = HoldUps()
    for step_s, longest_s in ((HELD_UP_S / 2, 0.0), (3.0, 3.0), (0.1, 3.0), (1.0, 3.0)):
        clock[0] += step_s
        found.update()
        assert found.longest_s == pytest.approx(longest_s)
    assert found.over_s == clock[0]
    found.took(clock[0] - 2.0)
    assert found.longest_s == pytest.approx(3.0)
    found.took(clock[0] + 0.1)
    assert found.longest_s == 0.0
