"""The link's requests and answers, without a link: the test chooses bytes and times."""

from __future__ import annotations

import heapq
import math
from itertools import count

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.errors import TriggerError
from acquire.trigger import registers as r
from acquire.trigger.dialogue import Dialogue, RefusedError, are_settled, results
from acquire.trigger.frames import (
    MAX_ENCODED,
    Decoder,
    Frame,
    FrameLengthError,
    encode,
    nak_payload,
    parse_read,
    parse_write,
    read_payload,
    write_payload,
)
from acquire.trigger.registers import MAX_PAYLOAD, ErrorCode, FrameType

REPLY_S, ATTEMPTS, DELAY_S, LATE_S = 1.0, 3, 0.1, 1.05
READ_BYTES = len(encode(Frame(FrameType.DATA, 0, write_payload(0, [0]))))
"""What one read of one word takes of the window: its answer is longer than itself."""


def word_at(address: int) -> int:
    return address * 0x9E3779B1 & 0xFFFFFFFF


def answer_to(request: Frame) -> Frame:
    address, words = parse_read(request.payload)
    return Frame(
        FrameType.DATA,
        request.sequence,
        write_payload(address, [word_at(address + k) for k in range(words)]),
    )


def garbled(data: bytes) -> bytes:
    return bytes([*data[:-2], data[-2] ^ 0x80, 0])


FATES = {
    "answered": lambda request: [(DELAY_S, encode(answer_to(request)))],
    "lost": lambda request: [],
    "garbled": lambda request: [(DELAY_S, garbled(encode(answer_to(request))))],
    "late": lambda request: [(LATE_S, encode(answer_to(request)))],
    "twice": lambda request: [(DELAY_S, 2 * encode(answer_to(request)))],
    # in two pieces, between which nothing else comes: a link keeps its bytes in order
    "torn": lambda request: [
        (DELAY_S, encode(answer_to(request))[:4]),
        (DELAY_S, encode(answer_to(request))[4:]),
    ],
    "another's": lambda request: [
        (DELAY_S, encode(answer_to(Frame(request.type, request.sequence, read_payload(99, 1)))))
    ],
    "refused": lambda request: [
        (DELAY_S, encode(Frame(FrameType.NAK, request.sequence, nak_payload(ErrorCode.BUSY, 5))))
    ],
}


class World:
    """A dialogue, a device that treats each request according to its fate, and a clock that jumps."""

    def __init__(self, fates, now_s: float = -1000.0, window_bytes: int = 1024) -> None:
        self.dialogue = Dialogue("way", math.inf, REPLY_S, ATTEMPTS)
        self.dialogue.window_bytes = window_bytes
        self.fates, self.now_s, self.begun_s = iter(fates), now_s, now_s
        self.sent: list[Frame] = []
        self._ears, self._coming, self._order = Decoder(), [], count()

    @property
    def elapsed_s(self) -> float:
        return self.now_s - self.begun_s

    def send(self) -> None:
        frames = self._ears.feed(self.dialogue.to_send(self.now_s))
        assert len(frames) <= max(1, self.dialogue.window_bytes // READ_BYTES)
        for frame in frames:
            self.sent.append(frame)
            for delay_s, data in FATES[next(self.fates, "answered")](frame):
                self.arrives(self.now_s + delay_s, data)

    def arrives(self, at_s: float, data: bytes) -> None:
        heapq.heappush(self._coming, (at_s, next(self._order), data))

    def step(self) -> None:
        """Advance to the next arrival or the deadline, whichever is first."""
        self.send()
        arrival_s = self._coming[0][0] if self._coming else math.inf
        self.now_s = min(arrival_s, self.dialogue.deadline_s)
        assert self.now_s < math.inf, "there is nothing to wait for"
        if arrival_s <= self.now_s:
            self.dialogue.receive(heapq.heappop(self._coming)[2], self.now_s)
        self.dialogue.expire(self.now_s)

    def settle(self, calls) -> None:
        while not are_settled(calls):
            self.step()

    def rest(self) -> None:
        """Deliver everything that arrives after the last wait."""
        while self._coming:
            at_s, _, data = heapq.heappop(self._coming)
            self.dialogue.receive(data, at_s)

    def counted(self) -> dict[str, float]:
        counts = self.dialogue.statistics()
        return {name: n for name, n in counts.items() if n and name not in ("frames", "longest_s")}


def reads(addresses) -> list[tuple[FrameType, bytes]]:
    return [(FrameType.READ, read_payload(address, 1)) for address in addresses]


ONE_REQUEST = {
    ("answered",): (0.1, 1, {}),
    ("torn",): (0.1, 1, {}),
    ("twice",): (0.1, 1, {"unexpected": 1}),
    ("lost", "answered"): (1.1, 2, {"timeouts": 1, "repeated": 1}),
    ("garbled", "answered"): (1.1, 2, {"timeouts": 1, "repeated": 1, "FrameChecksumError": 1}),
    ("late", "answered"): (1.1, 2, {"timeouts": 1, "repeated": 1, "unexpected": 1}),
    ("late", "lost", "answered"): (2.1, 3, {"timeouts": 2, "repeated": 2, "unexpected": 1}),
    ("another's", "answered"): (1.1, 2, {"timeouts": 1, "repeated": 1, "unexpected": 1}),
    ("lost", "garbled", "twice"): (
        2.1,
        3,
        {"timeouts": 2, "repeated": 2, "FrameChecksumError": 1, "unexpected": 1},
    ),
}


@pytest.mark.parametrize("fates", ONE_REQUEST, ids=", ".join)
def test_a_request_gets_its_answer_whatever_happened_to_its_attempts(fates) -> None:
    at_s, attempts, counts = ONE_REQUEST[fates]
    world = World(fates)
    calls = world.dialogue.ask(reads([7]))
    world.settle(calls)
    assert parse_write(results(calls)[0].payload) == (7, (word_at(7),))
    assert (world.elapsed_s, calls[0].attempts) == (pytest.approx(at_s), attempts)
    world.rest()
    assert world.counted() == counts
    assert world.dialogue.deadline_s == math.inf


@pytest.mark.parametrize("fate", ["lost", "garbled", "late", "another's"])
def test_a_request_without_an_answer_is_given_up_at_its_limit_and_not_before(fate) -> None:
    world = World([fate] * ATTEMPTS)
    calls = world.dialogue.ask(reads([7]))
    world.settle(calls)
    assert world.elapsed_s == pytest.approx(world.dialogue.limit_s) == ATTEMPTS * REPLY_S
    with pytest.raises(TriggerError, match=r"way: no answer to READ came in 3 attempts of 1 s"):
        results(calls)
    assert len(world.sent) == ATTEMPTS


def test_once_one_is_given_up_the_others_are_not_awaited() -> None:
    world = World(["lost"] * ATTEMPTS, window_bytes=READ_BYTES)
    calls = world.dialogue.ask(reads([7, 8]))
    world.settle(calls)
    assert world.elapsed_s == pytest.approx(world.dialogue.limit_s)
    with pytest.raises(TriggerError, match="no answer"):
        results(calls)


def test_a_refusal_is_an_answer_and_others_are_awaited_before_it_is_raised() -> None:
    world = World(["refused", "lost", "answered"])
    calls = world.dialogue.ask(reads([5, 6, 7]))
    world.settle(calls)
    assert [call.answer is not None for call in calls] == [True] * 3
    with pytest.raises(RefusedError, match="BUSY"):
        results(calls)


FIVE_REQUESTS = {
    # which of five is lost: when all are answered, and how its loss was noticed
    0: (0.2, {"lost": 1, "repeated": 1}),
    2: (0.2, {"lost": 1, "repeated": 1}),
    4: (1.2, {"timeouts": 1, "repeated": 1}),  # no successor tells: silence after the last answer does
}


@pytest.mark.parametrize("which", FIVE_REQUESTS)
def test_an_answer_to_a_later_request_reveals_a_loss_at_once(which) -> None:
    at_s, counts = FIVE_REQUESTS[which]
    world = World(["lost" if k == which else "answered" for k in range(5)])
    calls = world.dialogue.ask(reads(range(5)))
    world.settle(calls)
    assert world.elapsed_s == pytest.approx(at_s)
    assert world.counted() == counts
    assert [parse_write(answer.payload)[0] for answer in results(calls)] == list(range(5))
    assert [parse_read(frame.payload)[0] for frame in world.sent] == [*range(5), which]


def test_the_window_is_refilled_as_answers_come_with_what_was_lost_first() -> None:
    world = World([], window_bytes=3 * READ_BYTES)
    world.dialogue.ask(reads(range(8)))
    sent = Decoder().feed(world.dialogue.to_send(0))
    assert [parse_read(frame.payload)[0] for frame in sent] == [0, 1, 2]
    assert not world.dialogue.can_send
    world.dialogue.receive(encode(answer_to(sent[2])), 0.1)
    assert world.dialogue.can_send
    again = Decoder().feed(world.dialogue.to_send(0.1))
    assert [(frame.sequence, parse_read(frame.payload)[0]) for frame in again] == [(3, 0), (4, 1), (5, 3)]


def test_a_request_larger_than_the_window_goes_alone() -> None:
    world = World([], window_bytes=1)
    calls = world.dialogue.ask(reads(range(3)))
    world.settle(calls)
    assert world.elapsed_s == pytest.approx(3 * DELAY_S)


def test_no_request_is_repeated_while_answers_arrive() -> None:
    """As over a slow line: the last of many is answered long after its request could have timed out."""
    world = World(["lost"] * 10)
    calls = world.dialogue.ask(reads(range(10)))
    world.send()
    for k, frame in enumerate(world.sent):
        world.arrives(world.begun_s + 0.9 * (k + 1), encode(answer_to(frame)))
    world.settle(calls)
    assert world.counted() == {}
    assert world.dialogue.longest_s == pytest.approx(9.0)


def test_a_paused_host_makes_all_its_attempts_and_waits_for_the_last_answer() -> None:
    dialogue = Dialogue("way", math.inf, REPLY_S, ATTEMPTS)
    (call,) = dialogue.ask(reads([7]))
    for attempt in range(ATTEMPTS):
        now_s = 100.0 * attempt  # far beyond the limit each time
        dialogue.expire(now_s)
        (frame,) = Decoder().feed(dialogue.to_send(now_s))
        assert not dialogue.expire(now_s + 0.99)
    assert call.is_open
    dialogue.receive(encode(answer_to(frame)), now_s + 0.99)
    assert parse_write(results([call])[0].payload)[0] == 7


def test_answers_to_others_do_not_keep_a_last_attempt_waiting_beyond_its_limit() -> None:
    world = World([], window_bytes=1000)
    (first, *_) = world.dialogue.ask(reads(range(10)))
    for attempt in range(ATTEMPTS - 1):
        world.dialogue.to_send(REPLY_S * attempt)
        world.dialogue.expire(REPLY_S * (attempt + 1))
    requests = Decoder().feed(world.dialogue.to_send(2 * REPLY_S))
    world.dialogue.receive(encode(answer_to(requests[0])), 2.5 * REPLY_S)
    assert first.answer is not None
    assert world.dialogue.deadline_s == world.dialogue.limit_s == 3 * REPLY_S


def test_an_abandoned_request_makes_room_and_its_answer_is_counted() -> None:
    world = World(["answered"] * 3, window_bytes=2 * READ_BYTES)
    mine, others = world.dialogue.ask(reads(range(3))), world.dialogue.ask(reads([9]))
    world.send()
    world.dialogue.forget(mine)
    world.settle(others)
    world.rest()
    assert [parse_read(frame.payload)[0] for frame in world.sent] == [0, 1, 9]
    assert world.counted() == {"unexpected": 2}
    assert world.dialogue.to_send(world.now_s) == b""


def test_a_request_too_large_for_a_frame_is_refused_before_anything_is_queued() -> None:
    dialogue = Dialogue("way", math.inf, REPLY_S, ATTEMPTS)
    with pytest.raises(FrameLengthError):
        dialogue.ask([*reads([1]), (FrameType.WRITE, bytes(MAX_PAYLOAD + 1))])
    assert dialogue.to_send(0.0) == b""


def test_a_slow_link_is_given_more_time() -> None:
    dialogue = Dialogue("way", 100.0, REPLY_S, ATTEMPTS)
    assert dialogue.reply_s == REPLY_S + 2 * (MAX_ENCODED + 1) / 100
    dialogue.ask(reads([1]))
    dialogue.to_send(5.0)
    assert dialogue.deadline_s == 5.0 + dialogue.reply_s


def test_tags_between_answers_belong_to_no_request() -> None:
    world = World([])
    calls = world.dialogue.ask(reads([1]))
    (request,) = Decoder().feed(world.dialogue.to_send(0.0))
    tag = r.TagRecord(1, 2, 3, 4, 1)
    data = encode(Frame(FrameType.TAG, 5, r.pack_tag(tag))) + encode(answer_to(request))
    assert world.dialogue.receive(data, 0.1) == [(5, tag)]
    assert are_settled(calls)


def test_sequences_begin_again_and_answers_still_find_their_requests() -> None:
    world = World([], window_bytes=50 * READ_BYTES)
    calls = world.dialogue.ask(reads(k & 0xFF for k in range((1 << 16) + 100)))
    while world.dialogue.can_send:
        frames = Decoder().feed(world.dialogue.to_send(0.0))
        world.dialogue.receive(b"".join(encode(answer_to(frame)) for frame in frames), 0.0)
    assert [parse_write(answer.payload)[0] for answer in results(calls)] == [
        k & 0xFF for k in range(len(calls))
    ]
    assert world.counted() == {}


@given(
    fates=st.lists(st.sampled_from([fate for fate in FATES if fate != "refused"]), max_size=60),
    batches=st.lists(st.integers(1, 12), min_size=1, max_size=4),
    window=st.integers(1, 20),
    start_s=st.sampled_from([-1e6, 0.0, 1e9]),
)
def test_every_request_is_settled_in_time_with_its_own_value(fates, batches, window, start_s) -> None:
    world = World(fates, start_s, window * READ_BYTES)
    addresses = count()
    asked = [world.dialogue.ask(reads(next(addresses) for _ in range(size))) for size in batches]
    open_calls = [call for calls in asked for call in calls]
    while any(call.is_open for call in open_calls):
        world.step()
        assert world.dialogue.deadline_s > world.now_s
    world.rest()

    for call in open_calls:
        address = parse_read(call.payload)[0]
        if call.failure is None:
            assert parse_write(results([call])[0].payload) == (address, (word_at(address),))
        assert call.attempts <= ATTEMPTS
    given_up = sum(call.failure is not None for call in open_calls)
    assert given_up * ATTEMPTS <= sum(fate not in ("answered", "twice", "torn") for fate in fates)
    assert [frame.sequence for frame in world.sent] == list(range(len(world.sent)))
    assert len(world.sent) == sum(call.attempts for call in open_calls)
    assert world.elapsed_s <= len(world.sent) * (REPLY_S + LATE_S)
    counted = world.dialogue.statistics()
    assert counted["repeated"] == len(world.sent) - len(open_calls)
    assert counted["lost"] + counted["timeouts"] == counted["repeated"] + given_up
