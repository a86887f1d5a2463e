"""A host that falls silent at any time: gateware and model end the run alike, and stay dark.

Nobody reads STATUS to find out, since that is a sign of life: pins and tags are what is looked at.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise

import pytest
from device_bench import BUILD, bench
from hypothesis import given, settings
from hypothesis import strategies as st
from pair import Pair

from acquire.sim.trigger_registers import BARK_CLOCKS, RUN_CLOCKS
from acquire.trigger import registers as r
from acquire.trigger.frames import Frame, encode, read_payload, write_payload
from acquire.trigger.registers import Command, FrameType, TagFlag, TagRecord
from firmware import timing, watchdog
from firmware.cxxrtl import Pin

RUN = 0x1234_5678_9ABC_DEF0
LATE = 50_000
"""Clocks after which everything has ended and every tag has come."""
BYTE_CLOCKS = 10 * BUILD.divisor
HEARD_CLOCKS = 96
"""From the start bit of a frame's last byte to the clock in which it is heard, give or take a few."""
LIFE = {
    "read": Frame(FrameType.READ, 77, read_payload(r.ID.address, 1)),
    "write": Frame(FrameType.WRITE, 77, write_payload(r.RUN_ID.address, [1])),
    "refused": Frame(FrameType.WRITE, 77, write_payload(r.WATCHDOG.address, [0])),
}
"""Requests of good form, done or refused: the host lives."""
NOISE = {
    "silence": b"",
    "half a frame": encode(LIFE["read"])[:5],
    "damaged": b"\x05" + encode(LIFE["read"])[1:],
    "zeros": bytes(8),
    "another version": encode(Frame(FrameType.READ, 77, read_payload(0, 1), version=2)),
    "unknown type": encode(Frame(0x55, 77)),
    "no words": encode(Frame(FrameType.READ, 77, b"\0\0\0")),
}
"""What a host that has died, or never knew the protocol, may send: no sign of life."""


@contextmanager
def pair() -> Iterator[Pair]:
    with bench() as device:
        made = Pair(device)
        try:
            yield made
        finally:
            made.wire.close()


def arm(both: Pair, period: int, substep: int, substeps: int, lead: int, invert: int, budget: int = 0) -> int:
    """Arm the run in both, with as much light as possible; return the clocks of a line."""
    config = {
        r.SUBSTEP_CLOCKS: substep,
        r.WINDOW_CLOSE: substep,
        r.LINE: r.LINE.pack(substeps=substeps),
        r.CODE_SOURCE: r.CODE_SOURCE.pack(value=1),
        r.LED: r.LED.pack(enable=1, invert=invert, lead=lead),
        r.TRIGGER_A: r.TRIGGER_A.pack(enable=1),
        r.TRIGGER_A_WIDTH: 2,
        r.TAG_INTERVAL: 1 << 20,
        r.LINE_BUDGET: budget,
        r.WATCHDOG: period,
        r.EXTERNAL_ARM: r.EXTERNAL_ARM.pack(enable=1),
    }
    for register, value in config.items():
        assert both.write(register.address, list(register.to_words(value)))
    assert both.command(Command.ARM, RUN)
    both.device.tags.clear()
    return substep * substeps


def start(both: Pair, by_edge: bool) -> None:
    if by_edge:
        both.device.twin.set("external_arm", True)
        both.model.external_edge()
    else:
        assert both.command(Command.START, RUN)


def compare_ends(both: Pair, reason: TagFlag | None) -> int:
    """Both have ended for ``reason`` with the same tags and pulses, and are dark; the number of lines."""
    device = both.device
    device.run(LATE)
    both.clock.now_ns += LATE
    both.take()
    ends = [_since_line_0(tags) for tags in (device.tags, both.tags)]
    assert [tag._replace(timestamp=0) for tag in ends[0]] == [tag._replace(timestamp=0) for tag in ends[1]]
    assert all(0 <= theirs.timestamp - mine.timestamp < 16 for theirs, mine in zip(*ends, strict=True))
    first, last = ends[0]
    assert first.flags & TagFlag.FIRST
    assert last.flags == TagFlag.LAST | (reason or 0)
    seen = device.twin.latest_run
    assert not seen.running
    assert seen.pulses_a == both.wire.read().issued == last.line + 1
    assert both.wire.read().stopped
    return last.line + 1


def _since_line_0(tags: list[tuple[int, TagRecord]]) -> list[TagRecord]:
    begun = tags[0][1].timestamp
    return [tag._replace(timestamp=tag.timestamp - begun) for _, tag in tags]


def assert_dark_after(both: Pair, invert: int) -> None:
    """No light from the run's end on; the changes of pins are those since the arming."""
    changes = both.device.changes
    (end,) = (
        clock for (_, was), (clock, now) in pairwise(changes) if was & Pin.RUNNING and not now & Pin.RUNNING
    )
    assert any(bool(pins & Pin.LED) != bool(invert) for clock, pins in changes if clock < end), "never lit"
    assert all(bool(pins & Pin.LED) == bool(invert) for clock, pins in changes if clock > end + 2)
    assert bool(both.device.twin.pins & Pin.LED) == bool(invert)


@settings(max_examples=25, deadline=None)
@given(
    by_edge=st.booleans(),
    invert=st.integers(0, 1),
    substep=st.sampled_from([5, 6, 50, 233]),
    substeps=st.sampled_from([1, 2, 3, 6]),
    lead=st.sampled_from([0, 1, 4]),
    lines=st.integers(0, 9),
    off=st.integers(-2, 2),
    budget=st.integers(0, 9),
)
def test_silence_from_the_start_on_ends_the_run_in_the_same_line(
    by_edge: bool, invert: int, substep: int, substeps: int, lead: int, lines: int, off: int, budget: int
) -> None:
    """The period is exactly this number of lines: the first that does not fit ends the run a line later."""
    with pair() as both:
        period = max(1, lines * substep * substeps + off)
        line = arm(both, period, substep, substeps, lead, invert, budget)
        both.device.changes.clear()
        start(both, by_edge)
        allowed = period // line + 1
        last = budget if 0 < budget <= allowed else allowed
        barks = period + BARK_CLOCKS - RUN_CLOCKS - lead  # since line 0
        budget_first = 0 < budget <= allowed and (budget - 1) * line < barks
        assert compare_ends(both, TagFlag.BUDGET if budget_first else TagFlag.WATCHDOG) == last
        assert_dark_after(both, invert)


@settings(max_examples=15, deadline=None)
@given(
    by_edge=st.booleans(),
    lead=st.sampled_from([0, 7, 200]),
    gaps=st.lists(st.integers(10, 14), min_size=1, max_size=3),
    sign=st.sampled_from(sorted(LIFE)),
    noise=st.sampled_from(sorted(NOISE)),
)
def test_silence_is_counted_from_the_last_request(
    by_edge: bool, lead: int, gaps: list[int], sign: str, noise: str
) -> None:
    """Requests every ten to fourteen lines keep a watchdog of sixteen and a half quiet; noise does not."""
    with pair() as both:
        line = arm(both, 1200 * 16 + 600, 400, 3, lead, invert=0)
        both.device.changes.clear()
        start(both, by_edge)
        both.device.run(8000)  # line 0 has its tag, and the link is free
        begun, zero = both.device.tags[0][1].timestamp, start_tick(both)
        at = 0
        for gap in gaps:
            at += gap * line
            say(both, encode(LIFE[sign]), begun + at, zero + at)
        say(both, NOISE[noise], begun + at + 4 * line, zero + at + 4 * line)
        both.device.answers.clear()
        assert compare_ends(both, TagFlag.WATCHDOG) == sum(gaps) + 17
        assert_dark_after(both, invert=0)


def start_tick(both: Pair) -> int:
    return both.model._run.start_tick


def say(both: Pair, data: bytes, heard: int, tick: int) -> None:
    """Send bytes that arrive in clock ``heard`` of the gateware's TIME, and at ``tick`` of the model."""
    device = both.device
    ahead = heard - device.twin.clock - BYTE_CLOCKS * max(len(data) - 1, 0) - HEARD_CLOCKS
    assert ahead >= 0
    device.run(ahead)
    device.twin.feed(data)
    both.clock.now_ns += tick - both.model._tick()
    both.model.feed(data)


@pytest.mark.parametrize("by_edge", [False, True])
def test_a_requested_stop_is_not_reported_as_a_watchdog_end(by_edge: bool) -> None:
    with pair() as both:
        line = arm(both, 1200 * 16 + 600, 400, 3, 0, 0)
        both.device.changes.clear()
        start(both, by_edge)
        both.device.run(8000)
        begun, zero = both.device.tags[0][1].timestamp, start_tick(both)
        stop = Frame(
            FrameType.WRITE, 78, write_payload(r.RUN_ID.address, [*r.RUN_ID.to_words(RUN), Command.STOP])
        )
        at = 10 * line + line // 2
        say(both, encode(stop), begun + at, zero + at)
        assert compare_ends(both, None) == 11
        assert_dark_after(both, invert=0)


@pytest.mark.parametrize("invert", [0, 1])
def test_a_host_that_dies_before_the_start_leaves_it_dark(invert: int) -> None:
    with pair() as both:
        arm(both, 100, 5, 1, 0, invert)
        both.device.changes.clear()
        both.device.run(LATE)
        dark = [
            (bool(pins & Pin.LED) == bool(invert), bool(pins & Pin.RUNNING))
            for _, pins in both.device.changes
        ]
        assert set(dark) <= {(True, False)}
        assert bool(both.device.twin.pins & Pin.LED) == bool(invert)
        assert both.take() == []
        assert both.device.tags == both.tags == []


def test_the_model_has_the_gateware_s_latencies() -> None:
    assert (RUN_CLOCKS, BARK_CLOCKS) == (timing.START_CLOCKS, watchdog.BARK_CLOCKS)
