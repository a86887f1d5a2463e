"""Which arm is taken for stalled, and when, with clocks set by hand."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
from test_session import MemoryWriter, feed, make_session, ring_block

from acquire.store import RunCondition
from acquire.stream.losses import Cause
from acquire.stream.ring import Ring, RingShape
from acquire.stream.session import Session
from acquire.stream.stalls import Arm, find_stall

LIMIT_S, SKEW = 10.0, 1000


@pytest.fixture
def arms() -> Iterator[dict[str, Arm]]:
    rings = {name: Ring(name, RingShape(4, 16, 1, "uint8")) for name in "ab"}
    yield {name: Arm(ring) for name, ring in rings.items()}
    for ring in rings.values():
        ring.close()


def silence(arms: dict[str, Arm], a: float, b: float) -> None:
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
    arms: dict[str, Arm], a: float, b: float, stalled: tuple[str, ...] | None
) -> None:
    silence(arms, a, b)
    found = find_stall(make(), arms, LIMIT_S, SKEW)
    assert (found and found.arms) == stalled
    if found is not None:
        both = len(found.arms) == 2
        assert found.condition is (RunCondition.INTERRUPTED if both else RunCondition.INCOMPLETE)
        assert "no line for 10 s" in found.reason


def test_an_arm_that_has_all_its_lines_or_is_given_up_is_not_waited_for(arms: dict[str, Arm]) -> None:
    silence(arms, LIMIT_S * 2, 0.0)
    assert find_stall(make(lines=100), arms, LIMIT_S, SKEW) is None
    session = make()
    session.lost["a"] = Cause.STALLED
    assert find_stall(session, arms, LIMIT_S, SKEW) is None


def test_an_arm_that_lags_too_far_is_named(arms: dict[str, Arm]) -> None:
    session = make()
    assert session.skew == 20
    session.take("a", ring_block("a", 100, SKEW))
    found = find_stall(session, arms, LIMIT_S, SKEW)
    assert found is not None
    assert (found.arms, found.condition) == (("b",), RunCondition.INCOMPLETE)
    assert f"{SKEW + 20} lines behind" in found.reason


def test_what_waits_in_the_ring_is_life(arms: dict[str, Arm]) -> None:
    arm = arms["a"]
    now_s = arm.alive_s
    arm.watch(now_s + 1)
    assert arm.alive_s == now_s
    arm.ring.claim()
    arm.ring.commit(0, 16)
    for later in (2, 3):
        arm.watch(now_s + later)
        assert arm.alive_s == now_s + later
    assert arm.ring.acquire() is not None
    arm.ring.release()
    arm.watch(now_s + 4)
    assert arm.alive_s == now_s + 3


def test_rate_is_measured_from_the_first_lines_on(arms: dict[str, Arm]) -> None:
    arm = arms["a"]
    assert arm.rate_hz(time.monotonic()) == 0
    begun = time.monotonic()
    for k in range(4):
        arm.ring.claim()
        arm.ring.commit(16 * k, 16)
        arm.watch(begun + k)
    assert arm.rate_hz(begun + 4) == pytest.approx(np.divide(48, 4))
