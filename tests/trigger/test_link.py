"""Requests and answers over a link that damages, delays and loses them, or dies."""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager

import pytest
from noisy import DeafTransport, NoisyTransport, storm
from trigger_twins import DEVICES, wired_model

from acquire.errors import TriggerError
from acquire.trigger import registers as r
from acquire.trigger.dialogue import RefusedError
from acquire.trigger.frames import Decoder, Frame, encode, nak_payload, read_payload, write_payload
from acquire.trigger.link import Link
from acquire.trigger.registers import ErrorCode, FrameType


@contextmanager
def linked(transport, **settings):
    link = Link(transport, **settings)
    try:
        yield link
    finally:
        link.close()


@pytest.mark.parametrize("name", DEVICES)
def test_bad_bytes_cost_time_and_never_a_wrong_value(name) -> None:
    commands, reply_s = (4000, 0.05) if name == "model" else (1000, 0.5)
    with DEVICES[name]() as twin, linked(NoisyTransport(twin, 0.01, 5), reply_s=reply_s, attempts=40) as link:
        link.window_bytes = 1024
        damage = storm(link, commands)
        statistics = link.statistics()
    assert damage == (0, 0)
    assert statistics["repeated"] > commands / 10
    assert statistics["FrameChecksumError"] + statistics["FrameStuffingError"] > commands / 50
    assert statistics["longest_s"] > 0


def test_a_link_that_only_makes_noise_fails_in_time() -> None:
    with (
        wired_model() as model,
        linked(NoisyTransport(model, 0.9, 5), reply_s=0.02, attempts=3) as link,
        pytest.raises(TriggerError, match=r"no answer to READ came in 3 attempts of 0\.02 s"),
    ):
        link.read(0)


def test_requests_are_pipelined_as_far_as_the_window_goes() -> None:
    deaf = DeafTransport()
    with linked(deaf, reply_s=0.05, attempts=1) as link:
        link.window_bytes = 100
        with pytest.raises(TriggerError, match="no answer"):
            link.transact([(FrameType.READ, read_payload(0, 1))] * 20)
    answer = len(encode(Frame(FrameType.DATA, 0, write_payload(0, [1]))))
    sent = Decoder().feed(deaf.written)
    assert len(sent) == 100 // answer, "the rest had to wait for answers that did not come"
    assert [frame.sequence for frame in sent] == list(range(len(sent)))


def test_a_dead_link_fails_every_present_and_later_waiter_at_once() -> None:
    deaf = DeafTransport()
    with linked(deaf, reply_s=20, attempts=3) as link:
        told: list[str] = []

        def wait(call) -> None:
            try:
                call()
            except TriggerError as error:
                told.append(str(error))

        calls = [lambda: link.read(0), lambda: link.write(1, [2]), lambda: link.tags(600)] * 4
        waiters = [threading.Thread(target=wait, args=(call,)) for call in calls]
        for waiter in waiters:
            waiter.start()
        deaf.hang_up()
        begun = time.monotonic()
        for waiter in waiters:
            waiter.join(300)
        assert told == ["deaf is gone"] * 12
        assert time.monotonic() - begun < 60
        with pytest.raises(TriggerError, match="deaf is gone"):
            link.read(0)
    assert deaf.closed == 1


def test_closing_ends_a_wait() -> None:
    link = Link(DeafTransport(), reply_s=20)
    errors: list[TriggerError] = []

    def wait() -> None:
        try:
            link.read(0)
        except TriggerError as error:
            errors.append(error)

    waiter = threading.Thread(target=wait)
    waiter.start()
    link.close()
    waiter.join(300)
    assert "closed" in str(errors[0])


class Scripted(DeafTransport):
    """Device that answers each request with the result of a script."""

    def __init__(self, script) -> None:
        super().__init__()
        self.script, self.decoder, self.out = script, Decoder(), b""

    def write(self, data: bytes) -> None:
        for frame in self.decoder.feed(data):
            self.out += b"".join(map(encode, self.script(frame)))

    def read(self) -> bytes:
        data, self.out = self.out, b""
        return data or super().read()


def test_a_device_of_another_protocol_is_named_with_both_versions() -> None:
    def answer(frame):
        return [Frame(FrameType.NAK, frame.sequence, nak_payload(ErrorCode.BAD_VERSION, 0), version=9)]

    with (
        linked(Scripted(answer)) as link,
        pytest.raises(TriggerError, match="speaks protocol 9, but this program speaks 1"),
    ):
        link.read(0)


def test_answers_to_others_are_not_taken() -> None:
    def answer(frame):
        if frame.sequence == 0:
            stranger = Frame(FrameType.DATA, 0, read_payload(1, 1) + b"\0\0\0")
            return [stranger, Frame(FrameType.DATA, 77, b"\0\0\1\0\0\0")]
        return [Frame(FrameType.DATA, frame.sequence, b"\0\0\5\0\0\0")]

    with linked(Scripted(answer), reply_s=0.05) as link:
        assert link.read(0) == (5,)
        statistics = link.statistics()
    assert (statistics["unexpected"], statistics["timeouts"], statistics["repeated"]) == (2, 1, 1)


def test_a_refusal_carries_its_reason_through_a_pickle() -> None:
    import pickle

    error = pickle.loads(pickle.dumps(RefusedError(ErrorCode.BUSY, 0x50)))
    assert (error.code, error.address, str(error)) == (
        ErrorCode.BUSY,
        0x50,
        "the trigger refused SUBSTEP_CLOCKS at 0x0050: BUSY",
    )


def test_the_queue_of_tags_is_bounded_and_the_excess_is_counted(monkeypatch) -> None:
    monkeypatch.setattr("acquire.trigger.link._TAGS_KEPT", 10)
    transport = Scripted(lambda frame: [])
    tags = [Frame(FrameType.TAG, k, r.pack_tag(r.TagRecord(1, k, 3 * k, k, 1))) for k in range(25)]
    with linked(transport) as link:
        transport.out = b"".join(map(encode, tags))
        deadline = time.monotonic() + 300
        while link.statistics().get("tags_dropped", 0) < 15:
            assert time.monotonic() < deadline
        assert [arrival.number for arrival in link.tags(1)] == list(range(15, 25))


def test_callers_in_many_threads_get_their_own_answers_on_a_bad_link() -> None:
    wrong: list[tuple[int, ...]] = []
    with wired_model() as model, linked(NoisyTransport(model, 0.01, 3), reply_s=0.05, attempts=40) as link:
        link.window_bytes = 100
        registers = [register for register in r.REGISTERS if register.access == "config"]
        want = {register: tuple(link.read(register.address, register.words)) for register in registers}

        def ask(mine) -> None:
            for _ in range(30):
                for register in mine:
                    words = link.read(register.address, register.words)
                    wrong.extend([words] if words != want[register] else [])

        threads = [threading.Thread(target=ask, args=(registers[k::8],)) for k in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(300)
        assert not any(thread.is_alive() for thread in threads)
    assert not wrong
    assert [want[register] for register in registers] == [
        register.to_words(register.reset) for register in registers
    ]


def test_a_late_answer_is_awaited_without_repetition_while_others_arrive() -> None:
    transport = Scripted(lambda frame: [])
    with linked(transport, reply_s=1.0, attempts=5) as link:
        link.window_bytes = 200
        script = threading.Thread(target=_answer_slowly, args=(transport, 24))
        script.start()
        link.transact([(FrameType.READ, read_payload(0, 1))] * 24)
        script.join(300)
        statistics = link.statistics()
    assert statistics["longest_s"] > 0.3
    assert (statistics["repeated"], statistics.get("timeouts", 0)) == (0, 0)


def _answer_slowly(transport: Scripted, count: int) -> None:
    for sequence in range(count):
        threading.Event().wait(0.06)
        transport.out += encode(Frame(FrameType.DATA, sequence, write_payload(0, [1])))


def test_a_slow_link_is_given_more_time() -> None:
    deaf = DeafTransport()
    deaf.bytes_per_s = 960.0
    with linked(deaf, reply_s=0.1, attempts=2) as link:
        link.window_bytes = 2048
        assert link.limit_s == pytest.approx(2 * (0.1 + 2 * 2048 / 960))
