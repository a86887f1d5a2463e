"""The compiled gateware with realistic boards and hosts."""

from __future__ import annotations

import random
import zlib

import pytest
from device_bench import BUILD, RUN, TAG_FRAME_BYTES, bench, start

from acquire.trigger import registers as r
from acquire.trigger.frames import Frame, encode, parse_nak, parse_write, read_payload, write_payload
from acquire.trigger.registers import Command, EndReason, ErrorCode, FrameType, State, TagFlag
from firmware.cxxrtl import Pin
from firmware.top import Build


def test_reset_values_and_constants_are_those_of_the_definition() -> None:
    with bench() as device:
        constants = BUILD.constants()
        for register in r.REGISTERS:
            if register.access in {"config", "operand", "command"}:
                assert device.read(register) == register.reset, register.name
            elif register.access == "constant":
                assert device.read(register) == constants[register], register.name


def test_every_writable_register_keeps_every_bit() -> None:
    choose = random.Random(2)
    with bench() as device:
        for register in r.REGISTERS:
            if register.access in {"config", "operand"}:
                for value in (0, (1 << register.width) - 1, choose.getrandbits(register.width)):
                    device.put(register, value)
                    assert device.read(register) == value, register.name


def test_a_wide_counter_is_read_in_one_piece() -> None:
    """Both words of TIME belong to one clock, also when the low one runs over between them."""
    with bench() as device:
        before = 0
        for _ in range(200):
            now = device.read(r.TIME)
            assert before < now <= device.twin.clock + 1
            before = now


def test_pipelined_requests_and_tags_do_not_push_each_other_out() -> None:
    """A prototype lost a request that came while a tag was being sent."""
    with bench() as device:
        start(device, RUN | {r.SUBSTEP_CLOCKS: 400, r.WINDOW_CLOSE: 400}, 9)
        for count in range(1, 41):
            device.send(FrameType.READ, read_payload(r.CODE_LENGTH.address, count % 8 + 1))
            device.run(random.Random(count).randrange(2000))
        answers = [device.answer() for _ in range(40)]
        assert [len(parse_write(answer.payload)[1]) for answer in answers] == [
            count % 8 + 1 for count in range(1, 41)
        ]
        assert [answer.sequence for answer in answers] == list(
            range(answers[0].sequence, answers[0].sequence + 40)
        )
        assert device.command(Command.STOP, 9) is None
        device.finish(100_000)
        assert [number for number, _ in device.tags] == list(range(len(device.tags)))
        assert not device.decoder.faults


def test_requests_that_fill_the_announced_room_are_all_answered() -> None:
    request = encode(Frame(FrameType.WRITE, 1, write_payload(r.CODE_MEMORY, range(1, 60))))
    with bench() as device:
        count = BUILD.rx_bytes // len(request)
        for at in range(count):
            words = [zlib.crc32(bytes([at, i])) for i in range(59)]
            device.send(FrameType.WRITE, write_payload(r.CODE_MEMORY, words))
        assert [device.answer().type for _ in range(count)] == [FrameType.ACK] * count


def test_damaged_bytes_are_counted_and_never_accepted() -> None:
    choose = random.Random(4)
    with bench() as device:
        device.put(r.SUBSTEP_CLOCKS, 777)
        for _ in range(60):
            data = bytearray(encode(Frame(FrameType.WRITE, 7, write_payload(r.SUBSTEP_CLOCKS.address, [5]))))
            at = choose.randrange(len(data))
            data[at] ^= choose.randrange(1, 256)
            device.twin.feed(b"\0" + bytes(data) + b"\0")
            device.run(4000)
        assert not device.answers
        assert device.read(r.SUBSTEP_CLOCKS) == 777
        assert 60 <= device.read(r.RX_ERRORS) <= 120


@pytest.mark.parametrize(
    ("frame", "error"),
    [
        (Frame(FrameType.READ, 3, read_payload(0, 1), version=2), ErrorCode.BAD_VERSION),
        (Frame(0x55, 3), ErrorCode.BAD_TYPE),
        (Frame(FrameType.READ, 3, b"\0\0"), ErrorCode.BAD_LENGTH),
        (Frame(FrameType.READ, 3, b"\0\0\0"), ErrorCode.BAD_LENGTH),
        (Frame(FrameType.READ, 3, b"\0\0\x3c"), ErrorCode.BAD_LENGTH),
        (Frame(FrameType.WRITE, 3, b"\0\0\0\0\0"), ErrorCode.BAD_LENGTH),
        (Frame(FrameType.WRITE, 3, b""), ErrorCode.BAD_LENGTH),
    ],
)
def test_a_malformed_request_is_refused(frame: Frame, error: ErrorCode) -> None:
    with bench() as device:
        device.twin.feed(encode(frame))
        answer = device.answer()
        assert (answer.type, answer.sequence) == (FrameType.NAK, 3)
        assert parse_nak(answer.payload) == (error, 0)
        assert answer.version == r.PROTOCOL_VERSION


def test_a_silent_host_ends_the_run_after_a_whole_line() -> None:
    with bench() as device:
        start(device, RUN | {r.WATCHDOG: 50_000, r.TAG_INTERVAL: 999}, 1)
        for _ in range(4):
            device.run(40_000)
            assert device.state == State.RUNNING
        device.finish(70_000)
        assert device.tags[-1][1].flags == TagFlag.LAST | TagFlag.WATCHDOG
        assert r.STATUS.end_reason.of(device.read(r.STATUS)) == EndReason.WATCHDOG


def test_the_loss_of_the_clock_ends_the_run_and_forbids_the_next() -> None:
    with bench() as device:
        start(device, RUN, 1)
        device.twin.set("clock_locked", False)
        device.finish(70_000)
        assert device.tags[-1][1].flags == TagFlag.LAST | TagFlag.CLOCK_LOST
        status = r.STATUS.unpack(device.read(r.STATUS))
        assert (status["clock_locked"], status["clock_losses"]) == (0, 1)
        assert device.command(Command.ARM, 2) == (ErrorCode.CLOCK_UNLOCKED, r.STATUS.address)


def test_missed_and_unexpected_strobes_are_counted_and_reported_once() -> None:
    config = RUN | {
        r.TRIGGER_A: r.TRIGGER_A.pack(enable=1, strobe=1),
        r.SUBSTEP_CLOCKS: 100,
        r.TAG_INTERVAL: 999,
    }
    with bench() as device:
        start(device, config, 1)
        while not any(pins & Pin.TRIGGER_A for _, pins in device.changes):
            device.run(10)
        for line in range(20):  # one strobe per pulse; none in lines 5 and 11, two in line 8
            for _ in range({5: 0, 11: 0, 8: 2}.get(line, 1)):
                device.twin.set("strobe_a", True)
                device.run(20)
                device.twin.set("strobe_a", False)
                device.run(20)
            device.run(300 - 40 * {5: 0, 11: 0, 8: 2}.get(line, 1))
        seen = [device.read(getattr(r, f"STROBE_A_{what}")) for what in ("MISSED", "UNEXPECTED")]
        assert seen[0] >= 2
        assert seen[1] == 1
        flags = [tag.flags for _, tag in device.tags]
        assert flags.count(TagFlag.MISSED_A) == flags.count(TagFlag.UNEXPECTED_A) == 1


def test_the_pulse_per_second_is_latched() -> None:
    with bench() as device:
        for count in (1, 2):
            device.run(777)
            edge = device.twin.clock
            device.twin.set("pps", True)
            device.run(50)
            device.twin.set("pps", False)
            assert device.read(r.PPS_COUNT) == count
            assert 0 <= device.read(r.PPS_TIME) - edge <= 4


def test_tags_lost_to_a_full_queue_are_counted_and_reported_by_the_next() -> None:
    with bench() as device:
        start(device, RUN | {r.TAG_INTERVAL: 1}, 4)
        device.twin.set("clear_to_send", False)  # the host stalls
        device.run(2 * BUILD.tags * 60)
        device.twin.set("clear_to_send", True)
        assert device.read(r.TAG_LOST) > BUILD.tags / 2
        assert device.command(Command.STOP, 4) is None
        device.finish(10_000_000)
        told = [number for number, tag in device.tags if tag.flags & TagFlag.TAGS_LOST]
        assert told
        missing = set(range(device.tags[-1][0] + 1)) - {number for number, _ in device.tags}
        assert len(missing) == device.read(r.TAG_LOST)
        assert {number - 1 for number in told} <= missing


def test_the_tag_fifo_outlasts_a_host_that_stalls_for_100_ms() -> None:
    """At a board's 3 Mbaud, and as many tags as this link can carry at all: 8333 a second."""
    bit = BUILD.divisor
    config = RUN | {r.LINE: 1, r.SUBSTEP_CLOCKS: TAG_FRAME_BYTES * 10 * bit, r.TAG_INTERVAL: 1}
    with bench() as device:
        start(device, config, 1)
        device.twin.set("clear_to_send", False)
        device.run(Build().baud // 10 * bit)
        device.twin.set("clear_to_send", True)
        fifo = r.TAG_FIFO.unpack(device.read(r.TAG_FIFO))
        assert 833 <= fifo["peak"] < BUILD.tags == Build().tags
        assert device.command(Command.STOP, 1) is None
        device.finish(10_000_000)
        assert device.read(r.TAG_LOST) == 0
        assert [number for number, _ in device.tags] == list(range(len(device.tags)))


def test_a_build_reports_its_properties() -> None:
    with bench() as device:
        assert device.read(r.SERIAL) == BUILD.serial
        assert device.read(r.CODE_BITS) == 1 << 19
        beyond = r.CODE_MEMORY + (1 << 14)
        assert device.write(beyond - 1, [7, 8]) == (ErrorCode.BAD_ADDRESS, beyond)
        assert device.write(beyond - 1, [7]) is None


def test_a_pulse_per_second_during_a_run_has_a_tag() -> None:
    with bench() as device:
        device.twin.set("pps", True)  # before the run: latched, and told to nobody
        device.run(100)
        device.twin.set("pps", False)
        start(device, RUN | {r.TAG_INTERVAL: 1 << 20}, 1)
        device.run(5000)
        device.twin.set("pps", True)
        device.run(5000)
        second = device.read(r.PPS_TIME)
        assert device.read(r.PPS_COUNT) == 2
        (tag,) = (tag for _, tag in device.tags if tag.flags & TagFlag.PPS)
        assert 0 <= tag.timestamp - second <= 15
        begun = device.read(r.START_TIME)
        assert tag.line == (second - begun) // 60
        assert tag.code_index == 3 * tag.line


@pytest.mark.parametrize("mode", list(r.LineMode))
def test_a_camera_that_answers_every_pulse_misses_none(mode: r.LineMode) -> None:
    """The strobe follows the pulse's pin, as a camera's does, in either mode and with any delay."""
    line = r.LINE.pack(substeps=3, mode=mode)
    config = RUN | {r.LINE: line, r.TRIGGER_A: r.TRIGGER_A.pack(enable=1, strobe=1), r.TRIGGER_A_DELAY: 7}
    with bench() as device:
        for register, value in (config | {r.LINE_BUDGET: 30, r.EXTERNAL_ARM: 1}).items():
            device.put(register, value)
        assert device.command(Command.ARM, 1) is None
        device.twin.set("external_arm", True)
        while not any(tag.flags & TagFlag.LAST for _, tag in device.tags):
            device.run(1)
            device.twin.set("strobe_a", bool(device.twin.pins & Pin.TRIGGER_A))
        names = ("SEEN", "MISSED", "UNEXPECTED")
        counts = [device.read(getattr(r, f"STROBE_A_{name}")) for name in names]
        assert counts == [30 * (3 if mode == r.LineMode.PER_SUBSTEP else 1), 0, 0]
