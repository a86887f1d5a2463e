"""Requests and answers on the trigger's link, without I/O, thread or clock.

::

    ask ──▶ [ queued ] ── to_send ──▶ [ on the way, in order ] ── receive ──▶ answered
                ▲                          │
                └───── lost, overdue ──────┴── after the last attempt ──▶ given up

The owner of a `Dialogue` passes received bytes and the time to it, sends the bytes that it returns, and calls
`expire` when `deadline_s` has passed. Answers come in the order of the requests: an answer to a later one
means that an earlier one, or its answer, was lost, and it is queued again; so is one whose deadline passes.
The protocol permits the repetition of every request. To keep the device's queue from overflowing and answers
from piling up, no more than ``window_bytes`` of either are on the way.
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
    from collections.abc import Iterable, Sequence

_UNSENT = Frame(0, 0)
_EMPTY_DATA_BYTES = len(encode(Frame(FrameType.DATA, 0, bytes(2))))
"""Each word adds four: in frames as short as ours, COBS adds one byte whatever they contain."""


class RefusedError(TriggerError):
    """The device refused a request; ``code`` is its reason, ``address`` the word concerned."""

    def __init__(self, code: int, address: int) -> None:
        self.code, self.address = code, address
        errors = {error.value: error.name for error in ErrorCode}
        names = [r.name for r in REGISTERS if 0 <= address - r.address < r.words]
        where = " ".join([*names, f"at 0x{address:04x}"])
        super().__init__(f"the trigger refused {where}: {errors.get(code, f'error {code}')}")

    def __reduce__(self) -> tuple[object, ...]:
        # Exceptions are unpickled from their message by default, which `__init__` does not take.
        return type(self), (self.code, self.address)


class TagArrival(NamedTuple):
    """A tag and its 16-bit sequence number: consecutive unless a tag was lost."""

    number: int
    tag: TagRecord


@dataclass(slots=True, eq=False)
class Call:
    """One request and its outcome; ``frame`` has the sequence of its latest attempt.

    It is open until it has its ``answer``, or its ``failure`` if it was given up.
    """

    kind: FrameType
    payload: bytes
    size_bytes: int
    """Encoded size of the longer one of request and answer."""
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
    """Requests and answers on one link. All times are of one monotonic clock, which the caller reads.

    Parameters
    ----------
    name : name of the transport, for errors
    bytes_per_s : rate of the transport in one direction
    silence_s : time without an answer after which a request is repeated, without transmission times
    attempts : how often a request is sent before it is given up
    """

    def __init__(self, name: str, bytes_per_s: float, silence_s: float, attempts: int) -> None:
        # Until the device has stated its queue, one frame with its delimiter is certain to have room.
        self.window_bytes = MAX_ENCODED + 1
        """Limit of unanswered requests, or of their answers; to be raised to the device's capacity."""
        self.longest_s = 0.0
        """Longest time until a request had its answer, including all its attempts."""
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
        """Longest time for an answer, including transmission times."""
        return self._silence_s + 2 * self.window_bytes / self._bytes_per_s

    @property
    def limit_s(self) -> float:
        """Time after which a request is answered or given up; longer if `expire` is called late."""
        return self._attempts * self.reply_s

    @property
    def deadline_s(self) -> float:
        """When `expire` must be called, unless an answer comes before; inf with nothing on the way."""
        return min(map(self._due_s, self._on_the_way.values()), default=math.inf)

    @property
    def can_send(self) -> bool:
        """Whether the window has room for the next queued request."""
        return bool(self._queued) and self._fits(self._queued[0], self._room_bytes)

    def ask(self, requests: Iterable[tuple[FrameType, bytes]]) -> list[Call]:
        """Queue requests, type and payload, whose order does not matter.

        Raises FrameLengthError for a payload that does not fit a frame; nothing is queued then.
        """
        calls = []
        for kind, payload in requests:
            size_bytes = len(encode(Frame(kind, 0, payload)))
            if kind == FrameType.READ:  # whose answer may be longer
                _, count = parse_read(payload)
                size_bytes = max(size_bytes, _EMPTY_DATA_BYTES + 4 * count)
            calls.append(Call(kind, payload, size_bytes))
        self._queued += calls
        return calls

    def to_send(self, now_s: float) -> bytes:
        """Return requests for which the window has room, oldest first; they count as sent at ``now_s``."""
        launched, room_bytes = [], self._room_bytes
        while self._queued and self._fits(self._queued[0], room_bytes):
            call = self._queued.popleft()
            # Every attempt has a new number, so that a late answer to the previous one is not taken for its.
            call.frame = Frame(call.kind, self._sequence, call.payload)
            call.begun_s, call.sent_s = call.begun_s if call.attempts else now_s, now_s
            call.attempts += 1
            self._counts["repeated"] += call.attempts > 1
            self._on_the_way[self._sequence] = call
            # 16 bits, and far fewer requests in a window: no two on the way have the same number.
            self._sequence = self._sequence + 1 & 0xFFFF
            room_bytes -= call.size_bytes
            launched.append(encode(call.frame))
        return b"".join(launched)

    def receive(self, data: bytes, now_s: float) -> list[TagArrival]:
        """Take bytes in any pieces: answers settle their calls, tags are returned, the rest is counted."""
        tags = []
        for frame in self._decoder.feed(data):
            if frame.type == FrameType.TAG and len(frame.payload) == TAG_BYTES:
                tags.append(TagArrival(frame.sequence, unpack_tag(frame.payload)))
                continue
            call = self._on_the_way.get(frame.sequence)
            if call is None or not answers(call.frame, frame):
                self._counts["unexpected"] += 1
                continue
            # The device answers in order: requests sent before without an answer are lost.
            lost = []
            # A dict keeps the order of insertion, here of sending.
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
        return tags

    def expire(self, now_s: float) -> bool:
        """Repeat, or give up, overdue requests; return whether there were any."""
        overdue = [call for call in self._on_the_way.values() if self._due_s(call) <= now_s]
        for call in overdue:
            del self._on_the_way[call.frame.sequence]
        self._counts["timeouts"] += len(overdue)
        self._send_again(overdue)
        return bool(overdue)

    def forget(self, calls: Sequence[Call]) -> None:
        """Drop calls for which nobody waits any more; a late answer is counted as unexpected."""
        forgotten = {call for call in calls if call.is_open}
        if forgotten:
            self._queued = deque(call for call in self._queued if call not in forgotten)
            self._on_the_way = {k: call for k, call in self._on_the_way.items() if call not in forgotten}

    def statistics(self) -> dict[str, float]:
        """Return the counts of frames received and dropped by error, of repeated, lost and timed-out
        requests, and of unexpected answers.
        """
        counts = {"frames": self._decoder.frames, **self._decoder.faults, **self._counts}
        return {**counts, "longest_s": round(self.longest_s, 6)}

    @property
    def _room_bytes(self) -> int:
        return self.window_bytes - sum(call.size_bytes for call in self._on_the_way.values())

    def _fits(self, call: Call, room_bytes: int) -> bool:
        # One request may always be on the way, even if it exceeds the device's stated capacity.
        return call.size_bytes <= room_bytes or not self._on_the_way

    def _due_s(self, call: Call) -> float:
        """Return when the call is overdue.

        While answers come, a missing one is detected by its successor, so the call waits on. The last attempt
        does not wait for others beyond the limit, but always for its own answer: a host that was late itself,
        or stopped for a while, still makes all its attempts.
        """
        others_s = self._progress_s + self.reply_s
        if call.attempts == self._attempts:
            others_s = min(others_s, call.begun_s + self.limit_s)
        return max(call.sent_s + self.reply_s, others_s)

    def _send_again(self, calls: list[Call]) -> None:
        """Queue calls again, oldest first, before all unsent ones; give up those without attempts left."""
        for call in reversed(calls):
            if call.attempts < self._attempts:
                self._queued.appendleft(call)
                continue
            tried = f"{call.attempts} attempts of {self.reply_s:g} s"
            call.failure = TriggerError(
                f"{self._name}: no answer to {call.kind.name} came in {tried}",
                hint="check that it is the trigger's port, and the baud rate",
            )


def are_settled(calls: Sequence[Call]) -> bool:
    """Return whether all are answered, or one is given up, in which case the others are not needed."""
    return not any(call.is_open for call in calls) or any(call.failure for call in calls)


def results(calls: Sequence[Call]) -> list[Frame]:
    """Return the answers to settled calls.

    Raises the error of one that was given up, or the first refusal.
    """
    for call in calls:
        if call.failure is not None:
            raise call.failure
    found = [call.answer for call in calls if call.answer is not None]
    for answer in found:
        if answer.type != FrameType.NAK:
            continue
        error, address = parse_nak(answer.payload)
        if error == ErrorCode.BAD_VERSION:  # the only refusal that does not concern the request itself
            raise TriggerError(
                f"the trigger speaks protocol {answer.version}, but this program speaks {PROTOCOL_VERSION}",
                hint="load the firmware that belongs to this program",
            )
        raise RefusedError(error, address)
    return found
