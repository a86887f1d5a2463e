"""The gateware and its behavioural model get the same bytes and must behave in the same way."""

from __future__ import annotations

import random
from collections.abc import Iterator

import numpy as np
import pytest
from device_bench import bench
from numpy.typing import NDArray
from pair import Pair
from random_runs import random_run

from acquire.trigger import registers as r
from acquire.trigger.frames import Frame, encode, write_payload
from acquire.trigger.registers import Command, FrameType, LineMode, Source, TagFlag

CONFIGURATIONS = 64
RUNS = 4
"""Of each device: none may inherit from the one before."""


@pytest.fixture
def pair() -> Iterator[Pair]:
    with bench() as device:
        made = Pair(device)
        yield made
        made.wire.close()


@pytest.mark.parametrize("seed", range(CONFIGURATIONS))
def test_the_model_behaves_like_the_gateware(pair: Pair, seed: int) -> None:
    choose = random.Random(1000 + seed)
    for run in range(1, RUNS + 1):
        config, code = random_run(choose)
        config[r.LINE_BUDGET] = choose.choice([0, *range(1, 14)])
        config[r.EXTERNAL_ARM] = r.EXTERNAL_ARM.pack(enable=choose.getrandbits(1))
        if choose.random() < 0.6:
            spoil(choose, config)
        load(choose, pair, config, code)
        for register, value in config.items():
            pair.write(register.address, list(register.to_words(value)))
        armed = pair.command(Command.ARM, run)
        pair.read(r.REJECT)
        pair.command(Command.ARM, choose.choice([run, run + 7, 0]))
        if armed:
            go(choose, pair, config, run)
            compare_run(pair, config, code)
        assert not pair.command(Command.START, run + 1)


def spoil(choose: random.Random, config: dict[r.Register, int]) -> None:
    """Change one setting so that arming may have to refuse it, often at the very limit."""
    clocks, line = config[r.SUBSTEP_CLOCKS], r.LINE.unpack(config[r.LINE])
    distance = clocks if line["mode"] == LineMode.PER_SUBSTEP else line_clocks(config)
    by = choose.choice([-1, 0, 1, choose.randrange(100)])
    register, value = choose.choice(
        [
            (r.SUBSTEP_CLOCKS, 5 + by),
            (r.LINE, choose.getrandbits(5)),
            (r.PHASE_CLOCKS, clocks * S(config) // 6 + by),
            (r.TAG_INTERVAL, 0),
            (r.CODE_SOURCE, choose.randrange(8)),
            (r.PRBS_MASK, 0),
            (r.PRBS_SEED, 0),
            (r.CODE_LENGTH, choose.choice([0, 5, 1 << 19, (1 << 19) + 1])),
            (r.WINDOW_CLOSE, clocks + by),
            (r.WINDOW_OPEN, config[r.WINDOW_CLOSE] + by),
            (r.TRIGGER_A_DELAY, distance - config[r.TRIGGER_A_WIDTH] + by),
            (r.TRIGGER_A_WIDTH, distance - config[r.TRIGGER_A_DELAY] + by),
            (r.TRIGGER_B_DELAY, distance - config[r.TRIGGER_B_WIDTH] + by),
            (r.TRIGGER_B_WIDTH, choose.choice([0, distance + by])),
            (r.CAMERA_MIN_PERIOD, distance + by),
            (r.LED, r.LED.pack(enable=1, lead=choose.choice([0, 255]))),
        ]
    )
    config[register] = max(0, value)


def load(choose: random.Random, pair: Pair, config: dict[r.Register, int], code: NDArray[np.uint8]) -> None:
    """Load the code memory, sometimes without the check that a run with it needs."""
    if r.CODE_SOURCE.kind.of(config[r.CODE_SOURCE]) != Source.MEMORY:
        return
    packed = np.packbits(code[:200], bitorder="little").tobytes() + bytes(3)
    pair.write(r.CODE_MEMORY, np.frombuffer(packed, "<u4").tolist())
    pair.write(r.CODE_LENGTH.address, [config.get(r.CODE_LENGTH, 0)])
    if choose.random() < 0.9 and pair.command(Command.CHECK_CODE):
        while r.STATUS.busy.of(pair.read(r.STATUS, compare=False)[0]):
            pass
        pair.read(r.CODE_CRC)


def go(choose: random.Random, pair: Pair, config: dict[r.Register, int], run: int) -> None:
    """Start both, and let both end after the same line."""
    device, period = pair.device, line_clocks(config)
    device.twin.take_light()
    device.tags.clear()
    pair.tags.clear()
    if config[r.EXTERNAL_ARM]:
        device.twin.set("external_arm", True)
        pair.model.external_edge()
        device.run(100)
        device.twin.set("external_arm", False)
    else:
        assert pair.command(Command.START, run)
    if config[r.LINE_BUDGET]:
        device.finish(2_000_000)
        pair.clock.now_ns += 20 * period + 1000
    else:
        device.run(choose.randrange(12 * period))
        assert device.command(Command.STOP, run) is None
        device.finish(2_000_000)
        lines = device.read(r.LINES)
        pair.clock.now_ns += 300  # the lead and the latency are over: line 0 runs
        start_tick = pair.read(r.START_TIME, compare=False)[1]
        now_tick = pair.read(r.TIME, compare=False)[1]
        pair.clock.now_ns += start_tick + (lines - 1) * period + period // 2 - now_tick
        pair.model.feed(encode(Frame(FrameType.WRITE, 9, stop(run))))
        pair.clock.now_ns += 2 * period
    pair.take()


def stop(run: int) -> bytes:
    return write_payload(r.RUN_ID.address, [*r.RUN_ID.to_words(run), Command.STOP])


def compare_run(pair: Pair, config: dict[r.Register, int], code: NDArray[np.uint8]) -> None:
    began = pair.read(r.START_TIME, compare=False)
    gateware, model = (
        [(number, tag._replace(timestamp=tag.timestamp - begin)) for number, tag in tags]
        for tags, begin in zip((pair.device.tags, pair.tags), began, strict=True)
    )
    assert gateware[:-1] == model[:-1]
    (number, last), (model_number, model_last) = gateware[-1], model[-1]
    assert (number, last._replace(timestamp=0)) == (model_number, model_last._replace(timestamp=0))
    assert last.flags & TagFlag.LAST
    assert 0 <= last.timestamp - model_last.timestamp < 16
    for register in (r.LINES, r.TAG_COUNT, r.TAG_LOST, r.CURRENT_RUN, r.REJECT):
        pair.read(register)
    if r.CODE_SOURCE.kind.of(config[r.CODE_SOURCE]) == Source.PRBS:
        pair.read(r.CODE_STATE)
    states = [r.STATUS.unpack(status) for status in pair.read(r.STATUS, compare=False)]
    assert states[0]["state"] == states[1]["state"]
    assert states[0]["end_reason"] == states[1]["end_reason"]
    compare_pins(pair, config)


def compare_pins(pair: Pair, config: dict[r.Register, int]) -> None:
    """Pulses and light that simulated cameras would see, where the model's cameras can see them."""
    lines = pair.device.read(r.LINES)
    seen, light = pair.device.twin.latest_run, pair.device.twin.take_light()
    train = pair.wire.read().train
    assert train is not None
    assert train.line_period_ns == seen.line_clocks == line_clocks(config)
    a = r.TRIGGER_A.unpack(config[r.TRIGGER_A])
    if a["enable"] and not a["invert"] and r.LINE.mode.of(config[r.LINE]) == LineMode.PER_LINE:
        assert seen.pulses_a == pair.wire.read().issued == lines
        assert seen.delay_a == config[r.TRIGGER_A_DELAY]
    led = r.LED.unpack(config[r.LED])
    shown = 2 * (config[r.WINDOW_CLOSE] - config[r.WINDOW_OPEN]) > config[r.SUBSTEP_CLOCKS]
    memory = r.CODE_SOURCE.kind.of(config[r.CODE_SOURCE]) == Source.MEMORY
    if shown and not led["lead"] and not led["invert"] and not memory:
        assert list(light) == pair.wire.code(train).bits(0, lines * S(config)).tolist()


def line_clocks(config: dict[r.Register, int]) -> int:
    return S(config) * config[r.SUBSTEP_CLOCKS]


def S(config: dict[r.Register, int]) -> int:
    return r.LINE.substeps.of(config[r.LINE])
