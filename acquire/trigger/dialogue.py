"""Requests and answers on the trigger's link: without I/O, without a thread and without a clock of its own.

::

    ask ──▶ [ queued ] ── to_send ──▶ [ on the way, in order ] ── receive ──▶ answered
                ▲                          │
                └───── lost, overdue ──────┴── after the last attempt ──▶ given up

Whoever holds a `Dialogue` brings it the bytes that came and the time, sends what it says, and calls `expire`
when `deadline_s` has passed. Answers come in the order of the requests: an answer to a later one means that
an earlier one, or its answer, was lost, and it is queued again; so is one whose deadline passes. The protocol
lets every request be repeated. So that the device's queue cannot overflow, nor answers pile up, no more than
``window_bytes`` of either are on the way.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from acquire.errors import TriggerError
from acquire.trigger.frames import MAX_ENCODED, Decoder, Frame, answers, encode, parse_nak, parse_read
from acquire.trigger.registers import (
    PROTOCOL_VERSION,
    REGISTERS,
    TAG_BYTES,
    ErrorCode,
    FrameType,
    TagRecord,
    unpack_tag,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

_UNSENT = Frame(0, 0)
_EMPTY_DATA_BYTES = len(encode(Frame(FrameType.DATA, 0, bytes(2))))
"""Each word adds four: in frames as short as ours, COBS takes one byte whatever they hold."""


class RefusedError(TriggerError):
    """The device said no; ``code`` is its reason, ``address`` the word that it is about."""

    def __init__(self, code: int, address: int) -> None:
        self.code, self.address = code, address
        errors = {error.value: error.name for error in ErrorCode}
        names = [r.name for r in REGISTERS if 0 <= address - r.address < r.words]
        where = " ".join([*names, f"at 0x{address:04x}"])
        super().__init__(f"the trigger refused {where}: {errors.get(code, f'error {code}')}")

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self.code, self.address)


class TagArrival(NamedTuple):
    """A tag and the 16-bit number it came with: consecutive unless one was lost."""

    number: int
    tag: TagRecord


@dataclass(slots=True, eq=False)
class Call:
    """One request and what became of it; ``frame`` has the sequence of its latest attempt.

    It is open until it has its ``answer``, or its ``failure`` where it was given up.
    """

    kind: FrameType
    payload: bytes
    size_bytes: int
    """Of the longer one of request and answer, encoded."""
    frame: Frame = _UNSENT
    attempts: int = 0
    begun_s: float = math.nan
    sent_s: float = math.nan
    answer: Frame | None = None
    failure: TriggerError | None = None

    @property
    def is_open(self) -> bool:
        return self.answer is None and self.failure is None


class Dialogue:
    """What is asked and answered over one link. All times are of one monotonic clock, which the caller reads.

    Parameters
    ----------
    name : of the way, for errors
    bytes_per_s : what the way carries in one direction
    silence_s : without an answer, after which a request is sent again, the way there and back not counted
    attempts : how often a request is sent before it is given up
    """

    def __init__(self, name: str, bytes_per_s: float, silence_s: float, attempts: int) -> None:
        self.window_bytes = MAX_ENCODED + 1
        """Of unanswered requests, or of their answers; to be raised to what the device says that it holds."""
        self.longest_s = 0.0
        """The longest that a request has waited for its answer, all its attempts together."""
        self._name, self._bytes_per_s = name, bytes_per_s
        self._silence_s, self._attempts = silence_s, attempts
        self._decoder = Decoder()
        self._counts = Counter(repeated=0, lost=0, timeouts=0, unexpected=0)
        self._queued: deque[Call] = deque()
        self._on_the_way: dict[int, Call] = {}
        self._sequence = 0
        self._progress_s = -math.inf

    @property
    def reply_s(self) -> float:
        """An answer may take so long, the way there and back counted."""
        return self._silence_s + 2 * self.window_bytes / self._bytes_per_s

    @property
    def limit_s(self) -> float:
        """A request has its answer by then, or is given up; `expire` that is called late may take longer."""
        return self._attempts * self.reply_s

    @property
    def deadline_s(self) -> float:
        """When `expire` has something to do, unless an answer comes before; inf with nothing on the way."""
        return min(map(self._due_s, self._on_the_way.values()), default=math.inf)

    @property
    def can_send(self) -> bool:
        """A request is queued that the window has room for."""
        return bool(self._queued) and self._fits(self._queued[0], self._room_bytes)

    def ask(self, requests: Iterable[tuple[FrameType, bytes]]) -> list[Call]:
        """Queue requests, type and payload, that do not depend on each other's order.

        Raises FrameLengthError for a payload that fits no frame; nothing is queued then.
        """
        calls = [Call(kind, payload, _size_bytes(kind, payload)) for kind, payload in requests]
        self._queued += calls
        return calls

    def to_send(self, now_s: float) -> bytes:
        """As many requests as the window has room for, oldest first; they count as sent at ``now_s``."""
        return b"".join(self._launch(now_s))

    def receive(self, data: bytes, now_s: float) -> list[TagArrival]:
        """Take bytes in any pieces: answers settle their calls, tags are returned, all else is counted."""
        tags = []
        for frame in self._decoder.feed(data):
            if frame.type == FrameType.TAG and len(frame.payload) == TAG_BYTES:
                tags.append(TagArrival(frame.sequence, unpack_tag(frame.payload)))
            else:
                self._take_answer(frame, now_s)
        return tags

    def expire(self, now_s: float) -> bool:
        """Send again, or give up, what is overdue; says whether there was any."""
        overdue = [call for call in self._on_the_way.values() if self._due_s(call) <= now_s]
        for call in overdue:
            del self._on_the_way[call.frame.sequence]
        self._counts["timeouts"] += len(overdue)
        self._send_again(overdue)
        return bool(overdue)

    def forget(self, calls: Sequence[Call]) -> None:
        """Nobody waits for these any more; an answer that still comes is counted as unexpected."""
        forgotten = {call for call in calls if call.is_open}
        if forgotten:
            self._queued = deque(call for call in self._queued if call not in forgotten)
            self._on_the_way = {k: call for k, call in self._on_the_way.items() if call not in forgotten}

    def statistics(self) -> dict[str, float]:
        """Frames received, dropped by error, requests repeated, lost and timed out, answers unexpected."""
        counts = {"frames": self._decoder.frames, **self._decoder.faults, **self._counts}
        return {**counts, "longest_s": round(self.longest_s, 6)}

    @property
    def _room_bytes(self) -> int:
        return self.window_bytes - sum(call.size_bytes for call in self._on_the_way.values())

    def _fits(self, call: Call, room_bytes: int) -> bool:
        """One request may always be on the way, whatever the device says that it holds."""
        return call.size_bytes <= room_bytes or not self._on_the_way

    def _launch(self, now_s: float) -> Iterator[bytes]:
        room_bytes = self._room_bytes
        while self._queued and self._fits(self._queued[0], room_bytes):
            call = self._queued.popleft()
            # Every attempt has a number of its own: a late answer to the one before is not taken for its.
            call.frame = Frame(call.kind, self._sequence, call.payload)
            call.begun_s, call.sent_s = call.begun_s if call.attempts else now_s, now_s
            call.attempts += 1
            self._counts["repeated"] += call.attempts > 1
            self._on_the_way[self._sequence] = call
            # 16 bits of a frame, and far fewer requests in a window: no two on the way have the same.
            self._sequence = self._sequence + 1 & 0xFFFF
            room_bytes -= call.size_bytes
            yield encode(call.frame)

    def _due_s(self, call: Call) -> float:
        """While answers come, one that is missing will be found out by its successor's.

        The last attempt does not wait for others beyond the limit, but always for its own answer: a host that
        was late itself, or stopped for a while, still makes all its attempts.
        """
        others_s = self._progress_s + self.reply_s
        if call.attempts == self._attempts:
            others_s = min(others_s, call.begun_s + self.limit_s)
        return max(call.sent_s + self.reply_s, others_s)

    def _take_answer(self, frame: Frame, now_s: float) -> None:
        """Answer the call it belongs to; those sent before it will not be answered any more."""
        call = self._on_the_way.get(frame.sequence)
        if call is None or not answers(call.frame, frame):
            self._counts["unexpected"] += 1
            return
        # The device answers in order: what was sent before and has no answer yet will get none.
        lost = []
        # Those of a dict come in the order in which they were put in: here, sent.
        for number, earlier in list(self._on_the_way.items()):
            del self._on_the_way[number]
            if earlier is call:
                break
            lost.append(earlier)
        self._counts["lost"] += len(lost)
        call.answer = frame
        self._progress_s = now_s
        self.longest_s = max(self.longest_s, now_s - call.begun_s)
        self._send_again(lost)

    def _send_again(self, calls: list[Call]) -> None:
        """Before all that has not been sent yet, the oldest first; what has had its attempts is given up."""
        for call in reversed(calls):
            if call.attempts < self._attempts:
                self._queued.appendleft(call)
                continue
            tried = f"{call.attempts} attempts of {self.reply_s:g} s"
            call.failure = TriggerError(
                f"{self._name}: no answer to {call.kind.name} came in {tried}",
                hint="is it the trigger's port, and its baud rate?",
            )


def are_settled(calls: Sequence[Call]) -> bool:
    """All are answered, or one is given up: then nobody needs the others."""
    return not any(call.is_open for call in calls) or any(call.failure for call in calls)


def results(calls: Sequence[Call]) -> list[Frame]:
    """The answers to settled calls. Raises what one was given up with, else the first refusal."""
    for call in calls:
        if call.failure is not None:
            raise call.failure
    found = [call.answer for call in calls if call.answer is not None]
    for answer in found:
        if answer.type != FrameType.NAK:
            continue
        error, address = parse_nak(answer.payload)
        if error == ErrorCode.BAD_VERSION:  # the only refusal that says nothing about the request itself
            raise TriggerError(
                f"the trigger speaks protocol {answer.version}, this program {PROTOCOL_VERSION}",
                hint="load the firmware that belongs to this program",
            )
        raise RefusedError(error, address)
    return found


def _size_bytes(kind: FrameType, payload: bytes) -> int:
    """Encoded bytes of the request, or of the answer to expect if that is longer."""
    request = len(encode(Frame(kind, 0, payload)))
    if kind != FrameType.READ:
        return request
    _, count = parse_read(payload)
    return max(request, _EMPTY_DATA_BYTES + 4 * count)
