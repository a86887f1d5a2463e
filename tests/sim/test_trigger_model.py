"""The behavioural model on its own, frame by frame, with a manual clock."""

from __future__ import annotations

import pytest
from sim_helpers import ManualClock

from acquire.sim import trigger_model
from acquire.sim.clock import Wire
from acquire.sim.trigger_code import prbs_state
from acquire.sim.trigger_model import TriggerModel
from acquire.trigger import registers as r
from acquire.trigger.frames import Decoder, Frame, encode, parse_nak, parse_write, read_payload, write_payload
from acquire.trigger.registers import Command, EndReason, ErrorCode, FrameType, State, TagFlag

HZ = 90_000_000
LINE_NS = 30_000
LATENCY_NS = 89
"""From START to line 0: 8 clocks, up to a whole ns."""


class Bench:
    """The model, the host's end of its link, and its time."""

    def __init__(self, speed: float = 1.0) -> None:
        self.clock = ManualClock()
        self.wire = Wire(self.clock)
        self.model = TriggerModel(self.wire, HZ, speed)
        self.decoder = Decoder()
        self.tags: list[r.TagRecord] = []

    def frames(self) -> list[Frame]:
        """Answers; tags are put by."""
        found = self.decoder.feed(self.model.take())
        self.tags += [r.unpack_tag(frame.payload) for frame in found if frame.type == FrameType.TAG]
        return [frame for frame in found if frame.type != FrameType.TAG]

    def ask(self, kind: int, payload: bytes, **changes: int) -> Frame:
        self.model.feed(encode(Frame(kind, 7, payload)._replace(**changes)))
        (answer,) = self.frames()
        assert answer.sequence == 7
        return answer

    def read(self, register: r.Register) -> int:
        answer = self.ask(FrameType.READ, read_payload(register.address, register.words))
        return sum(word << 32 * i for i, word in enumerate(parse_write(answer.payload)[1]))

    def write(self, register: r.Register, value: int) -> None:
        answer = self.ask(FrameType.WRITE, write_payload(register.address, register.to_words(value)))
        assert answer.type == FrameType.ACK, parse_nak(answer.payload)

    def command(self, command: int, number: int = 5) -> None:
        words = [*r.RUN_ID.to_words(number), command]
        assert self.ask(FrameType.WRITE, write_payload(r.RUN_ID.address, words)).type == FrameType.ACK

    def run(self, **values: int) -> None:
        self.write(r.CODE_SOURCE, r.Source.CONSTANT)
        for name, value in values.items():
            self.write(getattr(r, name), value)
        self.command(Command.ARM)
        self.command(Command.START)
        self.clock.now_ns += LATENCY_NS

    def status(self) -> dict[str, int]:
        return r.STATUS.unpack(self.read(r.STATUS))


@pytest.fixture
def bench():
    bench = Bench()
    yield bench
    bench.wire.close()


@pytest.mark.parametrize("speed", [0.5, 1.0, 50.0])
def test_lines_follow_the_clock_at_the_configured_speed(speed) -> None:
    bench = Bench(speed)
    bench.run(TAG_INTERVAL=7)
    for _ in range(5):
        bench.clock.now_ns += 7 * LINE_NS
    assert bench.read(r.LINES) == int(35 * speed) + 1
    assert [tag.line for tag in bench.tags] == list(range(0, int(35 * speed) + 1, 7))
    start = bench.read(r.START_TIME)
    assert all(tag.timestamp == start + 2700 * tag.line for tag in bench.tags)
    lines = bench.wire.read().issued
    bench.command(Command.STOP)
    assert bench.status()["state"] == State.STOPPING  # the line that runs is finished
    bench.clock.now_ns += int(LINE_NS / speed) + 1
    assert bench.status()["state"] == State.ENDED
    assert (bench.wire.read().stopped, bench.wire.read().issued) == (True, lines)
    bench.wire.close()


def test_nothing_is_lit_or_pulsed_before_a_start(bench) -> None:
    bench.write(r.CODE_SOURCE, r.Source.CONSTANT)
    bench.command(Command.ARM)
    bench.clock.now_ns += 10**9
    assert bench.wire.read().issued == 0
    assert (bench.read(r.LINES), bench.read(r.START_TIME), bench.status()["state"]) == (0, 0, State.ARMED)
    bench.command(Command.STOP)
    (tag,) = bench.tags
    assert tag.flags == TagFlag.LAST | TagFlag.NO_LINES


def test_a_budget_ends_the_run_whenever_it_is_read(bench) -> None:
    bench.run(LINE_BUDGET=100, TAG_INTERVAL=40)
    bench.clock.now_ns += 10**12
    assert bench.status()["end_reason"] == EndReason.LINE_BUDGET
    assert [(tag.line, tag.flags) for tag in bench.tags] == [
        (0, TagFlag.LINE | TagFlag.FIRST),
        (40, TagFlag.LINE),
        (80, TagFlag.LINE),
        (99, TagFlag.LAST | TagFlag.BUDGET),
    ]
    assert bench.tags[-1].timestamp == bench.tags[0].timestamp + 100 * 2700
    assert bench.wire.read().issued == 100


def test_a_second_is_latched_and_tagged_in_a_run(bench) -> None:
    bench.model.pps_edge()
    assert bench.status()["pps_seen"]
    bench.run()
    bench.clock.now_ns += 5 * LINE_NS
    bench.model.pps_edge()
    assert (bench.read(r.PPS_COUNT), bench.tags[-1].flags) == (2, TagFlag.PPS)
    assert bench.tags[-1].timestamp == bench.read(r.PPS_TIME)
    assert bench.tags[-1].line == 5


def test_a_lost_clock_ends_the_run_and_forbids_the_next(bench) -> None:
    bench.run()
    bench.clock.now_ns += 5 * LINE_NS
    bench.model.lose_clock()
    bench.clock.now_ns += LINE_NS
    status = bench.status()
    assert (status["state"], status["end_reason"]) == (State.ENDED, EndReason.CLOCK_LOST)
    assert (status["clock_locked"], status["clock_losses"]) == (0, 1)
    words = [*r.RUN_ID.to_words(6), Command.ARM]
    refused = bench.ask(FrameType.WRITE, write_payload(r.RUN_ID.address, words))
    assert parse_nak(refused.payload)[0] == ErrorCode.CLOCK_UNLOCKED
    bench.model.lose_clock(False)
    bench.command(Command.ARM, 6)


def test_the_watchdog_ends_the_run_of_a_silent_host_in_time(bench) -> None:
    bench.run(WATCHDOG=10 * 2700)
    for _ in range(5):
        bench.clock.now_ns += 9 * LINE_NS
        assert bench.status()["state"] == State.RUNNING
    bench.model.feed(encode(Frame(FrameType.READ, 1, b"rubbish")))
    bench.frames()
    bench.clock.now_ns += 11 * LINE_NS
    bench.frames()
    bench.clock.now_ns += LINE_NS
    assert bench.status()["end_reason"] == EndReason.WATCHDOG
    assert bench.tags[-1].flags == TagFlag.LAST | TagFlag.WATCHDOG


def test_tags_without_room_are_counted_and_the_next_one_is_flagged(bench, monkeypatch) -> None:
    monkeypatch.setattr(trigger_model, "TAG_ROOM", 4)
    bench.run(TAG_INTERVAL=1)
    bench.clock.now_ns += 9 * LINE_NS
    bench.frames()
    bench.clock.now_ns += 2 * LINE_NS
    bench.frames()
    assert [tag.line for tag in bench.tags] == [0, 1, 2, 3, 10, 11]
    assert [bool(tag.flags & TagFlag.TAGS_LOST) for tag in bench.tags] == [False] * 4 + [True, False]
    assert (bench.read(r.TAG_LOST), bench.read(r.TAG_COUNT)) == (6, 12)
    assert r.TAG_FIFO.unpack(bench.read(r.TAG_FIFO)) == {"fill": 0, "peak": 4}


@pytest.mark.parametrize(
    ("kind", "payload", "version", "error"),
    [
        (FrameType.READ, read_payload(0, 1), 2, ErrorCode.BAD_VERSION),
        (0x55, b"", 1, ErrorCode.BAD_TYPE),
        (FrameType.READ, b"\0", 1, ErrorCode.BAD_LENGTH),
        (FrameType.READ, read_payload(0, 60), 1, ErrorCode.BAD_LENGTH),
        (FrameType.WRITE, b"\0\0\0", 1, ErrorCode.BAD_LENGTH),
        (FrameType.READ, read_payload(0x7000, 1), 1, ErrorCode.BAD_ADDRESS),
        (FrameType.WRITE, write_payload(r.STATUS.address, [0]), 1, ErrorCode.READ_ONLY),
    ],
)
def test_invalid_requests_are_refused_with_their_error_code(bench, kind, payload, version, error) -> None:
    answer = bench.ask(kind, payload, version=version)
    assert (answer.type, answer.version) == (FrameType.NAK, r.PROTOCOL_VERSION)
    assert parse_nak(answer.payload)[0] == error


def test_bad_bytes_are_counted_and_not_answered(bench) -> None:
    bench.model.feed(b"\1\2\3\0" + encode(Frame(FrameType.READ, 1, read_payload(0, 1)))[:-2] + b"\0")
    assert bench.frames() == []
    assert bench.read(r.RX_ERRORS) == 2


@pytest.mark.parametrize("index", [0, 1, 63, 1000])
def test_the_state_jumps_to_any_code_index(index) -> None:
    mask, state = 0xD800000000000000, 0x123456789
    stepped = state
    for _ in range(index):
        stepped = stepped >> 1 ^ (mask if stepped & 1 else 0)
    assert prbs_state(mask, state, index) == stepped
