"""The compiled gateware: its code from every source, its light, and how a run begins."""

from __future__ import annotations

import random
import zlib
from itertools import pairwise

import numpy as np
import pytest
from device_bench import RUN, bench, start

from acquire.sim.trigger_code import prbs_state
from acquire.trigger import registers as r
from acquire.trigger.frames import parse_write, read_payload
from acquire.trigger.registers import Command, ErrorCode, FrameType, State, TagFlag
from firmware.cxxrtl import Pin
from firmware.top import START_LATENCY


@pytest.mark.parametrize("lead", [0, 7])
def test_the_external_edge_starts_after_a_fixed_time(lead: int) -> None:
    config = RUN | {
        r.EXTERNAL_ARM: r.EXTERNAL_ARM.pack(enable=1),
        r.LED: r.LED.pack(enable=1, lead=lead),
        r.LINE_BUDGET: 3,
    }
    for delay in (0, 1, 13):
        with bench() as device:
            for register, value in config.items():
                device.put(register, value)
            assert device.command(Command.ARM, 1) is None
            device.run(1000 + delay)
            device.changes.clear()
            edge = device.twin.clock
            device.twin.set("external_arm", True)
            device.finish(10_000)
            rises = [clock for clock, pins in device.changes if pins & Pin.LINE]
            assert rises[0] - edge == START_LATENCY + lead
            assert device.tags[0][1].flags == TagFlag.LINE | TagFlag.FIRST | TagFlag.EXTERNAL


def test_the_self_test_finds_nothing_wrong() -> None:
    with bench() as device:
        assert device.command(Command.SELF_TEST) is None
        while r.STATUS.busy.of(device.read(r.STATUS)):
            pass
        assert device.read(r.SELF_TEST) == r.SELF_TEST.pack(done=1)
        assert not r.STATUS.code_checked.of(device.read(r.STATUS))


def test_a_long_run_equals_the_jump_ahead() -> None:
    device_lines = 5000
    seed, mask = 0x123456789ABCDEF1, sum(1 << tap - 1 for tap in (64, 63, 61, 60))
    config = RUN | {
        r.CODE_SOURCE: r.CODE_SOURCE.pack(kind=r.Source.PRBS),
        r.PRBS_MASK: mask,
        r.PRBS_SEED: seed,
        r.LINE_BUDGET: device_lines,
        r.TAG_INTERVAL: 999,
    }
    with bench() as device:
        start(device, config, 1)
        device.finish(60 * device_lines + 100_000)
        assert device.read(r.CODE_STATE) == prbs_state(mask, seed, 3 * (device_lines - 1))


def test_the_whole_code_memory_is_played_checked_and_read_back() -> None:
    """512 kbit: the last word is as good as the first, and the code repeats after it."""
    bits = np.random.default_rng(5).integers(0, 2, 1 << 19, np.uint8)
    words = np.packbits(bits, bitorder="little").view("<u4").tolist()
    with bench() as device:
        for at in range(0, len(words), 59):
            assert device.write(r.CODE_MEMORY + at, words[at : at + 59]) is None
        device.put(r.CODE_LENGTH, 1 << 19)
        assert device.command(Command.CHECK_CODE) is None
        while r.STATUS.busy.of(device.read(r.STATUS)):
            pass
        assert device.read(r.CODE_CRC) == zlib.crc32(np.packbits(bits, bitorder="little").tobytes())
        for at in (0, 8191, (1 << 14) - 59):
            answer = device.ask(FrameType.READ, read_payload(r.CODE_MEMORY + at, 59))
            assert list(parse_write(answer.payload)[1]) == words[at : at + 59]
        lines = (1 << 19) // 6 + 20
        memory = r.CODE_SOURCE.pack(kind=r.Source.MEMORY)
        dense = {r.SUBSTEP_CLOCKS: 5, r.WINDOW_CLOSE: 5, r.LINE: 6, r.TAG_INTERVAL: 1 << 20, r.LED: 1}
        start(device, RUN | dense | {r.CODE_SOURCE: memory, r.LINE_BUDGET: lines}, 1)
        device.finish(40 * lines)
        lit = np.frombuffer(device.twin.take_light(), np.uint8)
        np.testing.assert_array_equal(lit, np.resize(bits, 6 * lines))


@pytest.mark.parametrize("invert", [0, 1])
def test_the_scene_gate_lets_light_through_only_while_it_is_high(invert: int) -> None:
    lit = r.LED.pack(enable=1, gate_enable=1, invert=invert)
    config = RUN | {r.CODE_SOURCE: r.CODE_SOURCE.pack(value=1), r.LED: lit}
    with bench() as device:
        start(device, config, 1)
        for level in (False, True, False, True):
            device.twin.set("scene_gate", level)
            device.run(4)  # two of the synchroniser, one of the gate, one to be seen
            device.changes.clear()
            device.run(500)
            shown = bool(device.twin.pins & Pin.LED) != bool(invert)
            assert shown == level
            assert all((bool(pins & Pin.LED) != bool(invert)) == level for _, pins in device.changes)
            assert r.STATUS.scene_gate.of(device.read(r.STATUS)) == level


def test_any_mask_and_seed_of_64_bits_make_the_code() -> None:
    choose = random.Random(11)
    for run in range(1, 9):
        mask, seed = (choose.getrandbits(64) >> choose.randrange(60) or 1 for _ in range(2))
        prbs = {
            r.CODE_SOURCE: r.CODE_SOURCE.pack(kind=r.Source.PRBS),
            r.PRBS_MASK: mask,
            r.PRBS_SEED: seed,
            r.LED: 1,
            r.LINE_BUDGET: 40,
        }
        with bench() as device:
            start(device, RUN | prbs, run)
            device.finish(1_000_000)
            assert list(device.twin.take_light()) == [prbs_state(mask, seed, k) & 1 for k in range(120)]


def test_a_falling_edge_starts_the_run_if_configured() -> None:
    config = RUN | {r.EXTERNAL_ARM: r.EXTERNAL_ARM.pack(enable=1, invert=1), r.LINE_BUDGET: 2}
    with bench() as device:
        for register, value in config.items():
            device.put(register, value)
        device.twin.set("external_arm", True)
        device.run(100)
        assert device.command(Command.ARM, 1) is None
        device.run(1000)
        assert device.state == State.ARMED
        device.twin.set("external_arm", False)
        device.finish(20_000)
        assert device.tags[0][1].flags & TagFlag.EXTERNAL


def test_an_edge_before_the_arming_starts_nothing() -> None:
    with bench() as device:
        for register, value in (RUN | {r.EXTERNAL_ARM: 1}).items():
            device.put(register, value)
        device.twin.set("external_arm", True)
        device.run(1000)
        assert device.command(Command.ARM, 1) is None
        device.run(10_000)
        assert device.state == State.ARMED
        assert device.command(Command.STOP, 1) is None
        device.finish(10_000)
        (tag,) = (tag for _, tag in device.tags)
        assert (tag.line, tag.flags) == (0, TagFlag.LAST | TagFlag.NO_LINES)
        assert device.read(r.LINES) == device.read(r.START_TIME) == 0


def test_the_shortest_substep_is_exact_with_every_code_source() -> None:
    """1.8 MHz is 50 clocks; five is the least."""
    with bench() as device:
        limits = r.LIMITS.unpack(device.read(r.LIMITS))
        assert limits["substep_min"] == 5
        start(device, RUN | {r.SUBSTEP_CLOCKS: 50, r.WINDOW_CLOSE: 50, r.LINE_BUDGET: 100}, 1)
        device.finish(1_000_000)
        lines = [tag.timestamp for _, tag in device.tags if tag.flags & TagFlag.LINE]
        assert {b - a for a, b in pairwise(lines)} == {4 * 3 * 50}
        device.put(r.SUBSTEP_CLOCKS, 4)
        assert device.command(Command.ARM, 2) == (ErrorCode.BAD_SUBSTEP, r.SUBSTEP_CLOCKS.address)
