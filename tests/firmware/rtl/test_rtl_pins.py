"""The compiled gateware compared with the documentation of the registers, in random configurations."""

from __future__ import annotations

import random

import expected
import numpy as np
import pytest
from device_bench import Bench, bench, start
from numpy.typing import NDArray
from random_runs import random_run

from acquire.sim.trigger_code import prbs_state
from acquire.trigger import registers as r
from acquire.trigger.registers import Command, EndReason, Source, State, TagFlag
from firmware.cxxrtl import Pin
from firmware.top import PIN_CLOCKS

BEFORE, AFTER = 260, 40
CONFIGURATIONS = 64


@pytest.mark.parametrize("seed", range(CONFIGURATIONS))
def test_pins_tags_and_counters_are_those_of_the_model(seed: int) -> None:
    choose = random.Random(seed)
    config, code = random_run(choose)
    budget = choose.choice([0, *range(1, 14)])
    config[r.LINE_BUDGET] = budget
    period = config[r.SUBSTEP_CLOCKS] * r.LINE.substeps.of(config[r.LINE])
    with bench() as device:
        load(device, config, code)
        start(device, config, run=seed + 1)
        if not budget:
            device.run(choose.randrange(12 * period))
            assert device.command(Command.STOP, choose.choice([0, seed + 1])) is None
        device.finish(2_000_000)
        lines = device.read(r.LINES)
        assert lines == budget or (not budget and lines > 0)
        check_pins(device, config, code, lines)
        check_tags(device, config, lines, seed + 1)
        status = r.STATUS.unpack(device.read(r.STATUS))
        assert status["state"] == State.ENDED
        assert status["end_reason"] == (EndReason.LINE_BUDGET if budget else EndReason.STOPPED)
        if r.CODE_SOURCE.kind.of(config[r.CODE_SOURCE]) == Source.PRBS:
            index = (lines - 1) * r.LINE.substeps.of(config[r.LINE])
            state = prbs_state(config[r.PRBS_MASK], config[r.PRBS_SEED], index)
            assert device.read(r.CODE_STATE) == state


def check_pins(device: Bench, config: dict[r.Register, int], code: NDArray[np.uint8], lines: int) -> None:
    begun = device.read(r.START_TIME) + PIN_CLOCKS  # a change is noted with the TIME it is first seen at
    want = expected.pins(config, code, lines, BEFORE, AFTER)
    got = device.levels(begun - BEFORE, len(want)) & ~np.uint16(Pin.RUNNING)
    differs = np.flatnonzero(got != want)
    at = int(differs[0]) if len(differs) else 0
    assert not len(differs), f"clock {at - BEFORE}: {Pin(int(got[at]))!r} instead of {Pin(int(want[at]))!r}"


def check_tags(device: Bench, config: dict[r.Register, int], lines: int, run: int) -> None:
    every, begun = config[r.TAG_INTERVAL], device.read(r.START_TIME)
    S = r.LINE.substeps.of(config[r.LINE])
    tags = [tag for _, tag in device.tags]
    assert [number for number, _ in device.tags] == list(range(len(tags)))
    assert [(tag.run, tag.line, tag.code_index, tag.timestamp - begun) for tag in tags[:-1]] == [
        (run, line, S * line, S * line * config[r.SUBSTEP_CLOCKS]) for line in range(0, lines, every)
    ]
    assert [tag.flags for tag in tags[:-1]] == [
        TagFlag.LINE | (TagFlag.FIRST if line == 0 else 0) for line in range(0, lines, every)
    ]
    last = tags[-1]
    assert (last.line, last.code_index) == (lines - 1, S * (lines - 1))
    assert 0 <= last.timestamp - begun - lines * S * config[r.SUBSTEP_CLOCKS] < 16
    assert device.read(r.TAG_COUNT) == len(tags)
    assert device.read(r.TAG_LOST) == 0


def load(device: Bench, config: dict[r.Register, int], code: NDArray[np.uint8]) -> None:
    """Load the code memory, if the run uses it."""
    if r.CODE_SOURCE.kind.of(config[r.CODE_SOURCE]) == Source.MEMORY:
        length = config[r.CODE_LENGTH]
        packed = np.packbits(code[:length], bitorder="little").tobytes()
        packed += bytes(-len(packed) % 4)
        words = np.frombuffer(packed, "<u4").tolist()
        assert device.write(r.CODE_MEMORY, words) is None
        device.put(r.CODE_LENGTH, length)
        assert device.command(Command.CHECK_CODE) is None
