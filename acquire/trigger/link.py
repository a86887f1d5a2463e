"""Requests and answers over a transport; tags beside them.

::

    callers ──▶ transact ──▶ [ on the way, in order ] ──▶ transport
                   ▲                   │
                   └── answers ◀── reader thread ──▶ tags (bounded, counted)

Answers come in the order of the requests: an answer to a later one means that an earlier one, or its
answer, was lost, and it is sent again at once; a time without any answer does the same for the last. The
protocol lets every request be repeated. So that the device's queue cannot overflow, nor answers pile up, no
more than ``window_bytes`` of either are on the way. When the transport fails, everyone who waits hears it
immediately.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from acquire.errors import TriggerError
from acquire.trigger.frames import (
    MAX_ENCODED,
    Decoder,
    Frame,
    answers,
    encode,
    parse_nak,
    parse_read,
    parse_write,
    read_payload,
    write_payload,
)
from acquire.trigger.registers import (
    MAX_WORDS,
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

    from acquire.trigger.transports.base import Transport

_TAGS_KEPT = 1 << 16
_END_S = 5.0
_UNSENT = Frame(0, 0)
_EMPTY_DATA_BYTES = len(encode(Frame(FrameType.DATA, 0, bytes(2))))


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
class _Call:
    """A request under way; ``frame`` has the sequence of its latest attempt.

    ``size`` is that of the longer one of request and answer, encoded.
    """

    kind: FrameType
    payload: bytes
    frame: Frame = _UNSENT
    size: int = 0
    attempts: int = 0
    begun_s: float = 0.0
    sent_s: float = 0.0
    answer: Frame | None = None


class Link:
    """Owns the transport and the reader thread; `close` ends both.

    Parameters
    ----------
    reply_s : silence after which a request is sent again, the way there and back not counted
    attempts : how often a request is sent before TriggerError
    window_bytes : of unanswered requests, or of their answers; the driver raises it to what the device says
    """

    def __init__(self, transport: Transport, reply_s: float = 0.25, attempts: int = 8) -> None:
        self.transport = transport
        self.window_bytes = MAX_ENCODED + 1
        self._answer_s, self._attempts = reply_s, attempts
        self._longest_s = 0.0
        self._progress_s = 0.0
        self._decoder = Decoder()
        self._counts: Counter[str] = Counter()
        self._news = threading.Condition()
        self._sending = threading.Lock()
        self._on_the_way: dict[int, _Call] = {}
        self._sequence = 0
        self._tags: deque[TagArrival] = deque()
        self._interrupted = False
        self._dead: TriggerError | None = None
        self._ending = threading.Event()
        self._reader = threading.Thread(target=self._live, name="acquire-trigger-link", daemon=True)
        self._reader.start()

    @property
    def dead(self) -> TriggerError | None:
        """What ended the link, None while it lives."""
        return self._dead

    @property
    def limit_s(self) -> float:
        """A request has its answer by then, or TriggerError is raised; a late host may take longer."""
        return self._attempts * self._reply_s

    @property
    def _reply_s(self) -> float:
        return self._answer_s + 2 * self.window_bytes / self.transport.bytes_per_s

    def read(self, address: int, count: int = 1) -> tuple[int, ...]:
        """``count`` words from ``address`` on."""
        return self.read_block(address, count)

    def write(self, address: int, words: Sequence[int]) -> None:
        """Returns when the device has taken the words."""
        self.transact([(FrameType.WRITE, write_payload(address, words))])

    def read_block(self, address: int, count: int) -> tuple[int, ...]:
        """Any number of words, in pipelined requests."""
        parts = [(a, min(MAX_WORDS, address + count - a)) for a in range(address, address + count, MAX_WORDS)]
        replies = self.transact([(FrameType.READ, read_payload(*part)) for part in parts])
        return tuple(word for reply in replies for word in parse_write(reply.payload)[1])

    def write_block(self, address: int, words: Sequence[int]) -> None:
        """Any number of words, in pipelined requests; not necessarily in their order."""
        parts = [(address + at, words[at : at + MAX_WORDS]) for at in range(0, len(words), MAX_WORDS)]
        self.transact([(FrameType.WRITE, write_payload(*part)) for part in parts])

    def transact(self, requests: Iterable[tuple[FrameType, bytes]]) -> list[Frame]:
        """Send requests, type and payload, that do not depend on each other's order; their answers.

        Raises RefusedError for the first that the device refuses, TriggerError when an answer does not
        come or the link is dead.
        """
        calls = [_Call(kind, payload) for kind, payload in requests]
        waiting = deque(calls)
        try:
            while True:
                self._send(waiting)
                with self._news:
                    if all(call.answer is not None for call in calls):
                        return [self._accept(call) for call in calls]
                    waiting.extendleft(reversed(self._await(calls, waiting)))  # the oldest first
        finally:
            self._forget(calls)

    def tags(self, timeout_s: float) -> list[TagArrival]:
        """Tags since the last call; waits at most ``timeout_s`` for the first, or until `interrupt`."""
        with self._news:
            self._interrupted = False
            self._news.wait_for(lambda: self._tags or self._dead or self._interrupted, timeout_s)
            if not self._tags and self._dead:
                raise self._dead
            found = list(self._tags)
            self._tags.clear()
            return found

    def interrupt(self) -> None:
        """End a wait for tags."""
        with self._news:
            self._interrupted = True
            self._news.notify_all()

    def statistics(self) -> dict[str, float]:
        """Frames received, dropped by error, requests repeated, answers too late, tags with no room.

        ``longest_s`` is the longest that a request has waited for its answer, all its attempts together.
        """
        with self._news:
            counts = {"frames": self._decoder.frames, **self._decoder.faults, **self._counts}
            return {**counts, "longest_s": round(self._longest_s, 6)}

    def close(self) -> None:
        """End the reader and the transport; everyone who waits gets TriggerError. Idempotent."""
        self._ending.set()
        self._die(TriggerError(f"{self.transport.name} was closed"))
        self._reader.join(_END_S)
        self.transport.close()

    def _send(self, waiting: deque[_Call]) -> None:
        """As many as the window has room for, oldest first, in the order of their sequences."""
        with self._sending:
            with self._news:
                if self._dead:
                    raise self._dead
                data = b"".join(self._launch(waiting))
            if data:
                try:
                    self.transport.write(data)
                except TriggerError as error:
                    self._die(error)
                    raise

    def _launch(self, waiting: deque[_Call]) -> Iterable[bytes]:
        room = self.window_bytes - sum(call.size for call in self._on_the_way.values())
        while waiting:
            call = waiting[0]
            if call.attempts == self._attempts:
                raise self._given_up(call)
            frame = Frame(call.kind, self._sequence, call.payload)
            data = encode(frame)
            size = max(len(data), _answer_bytes(call))
            if size > room and self._on_the_way:
                return
            call.frame, call.size, call.sent_s = frame, size, time.monotonic()
            call.begun_s = call.begun_s or call.sent_s
            call.attempts += 1
            self._counts["repeated"] += call.attempts > 1
            self._on_the_way[self._sequence] = call
            self._sequence = self._sequence + 1 & 0xFFFF
            room -= size
            waiting.popleft()
            yield data

    def _await(self, calls: list[_Call], waiting: deque[_Call]) -> list[_Call]:
        """Wait for news of these calls; those to send again. The condition is held."""
        sent = [call for call in calls if call.answer is None and call not in waiting]
        if not sent:
            self._news.wait(self._reply_s)  # others fill the window
        elif all(map(self._is_on_the_way, sent)):
            limit_s = max(sent[0].sent_s, self._progress_s) + self._reply_s - time.monotonic()
            self._news.wait_for(lambda: self._dead or not all(map(self._is_on_the_way, sent)), limit_s)
        if self._dead:
            raise self._dead
        self._expire(sent)
        return [call for call in sent if call.answer is None and not self._is_on_the_way(call)]

    def _expire(self, sent: list[_Call]) -> None:
        """While answers come, one that is missing will be found out by its successor's.

        A host that was late itself, or stopped for a while, still makes all its attempts.
        """
        now_s = time.monotonic()
        for call in sent:
            late = now_s > call.begun_s + self.limit_s and call.attempts == self._attempts
            if call.answer is None and late:
                raise self._given_up(call)
            if self._is_on_the_way(call) and max(call.sent_s, self._progress_s) <= now_s - self._reply_s:
                del self._on_the_way[call.frame.sequence]
                self._counts["timeouts"] += 1

    def _given_up(self, call: _Call) -> TriggerError:
        return TriggerError(
            f"{self.transport.name}: no answer to {call.kind.name} in {call.attempts} attempts of "
            f"{self._reply_s:g} s",
            hint="is it the trigger's port, and its baud rate?",
        )

    def _is_on_the_way(self, call: _Call) -> bool:
        return self._on_the_way.get(call.frame.sequence) is call

    def _forget(self, calls: list[_Call]) -> None:
        with self._news:
            for call in calls:
                if self._is_on_the_way(call):
                    del self._on_the_way[call.frame.sequence]
            self._news.notify_all()

    def _accept(self, call: _Call) -> Frame:
        answer = call.answer
        assert answer is not None
        if answer.type != FrameType.NAK:
            return answer
        error, address = parse_nak(answer.payload)
        if error == ErrorCode.BAD_VERSION:
            raise TriggerError(
                f"the trigger speaks protocol {answer.version}, this program {PROTOCOL_VERSION}",
                hint="load the firmware that belongs to this program",
            )
        raise RefusedError(error, address)

    def _live(self) -> None:
        try:
            while not self._ending.is_set():
                for frame in self._decoder.feed(self.transport.read()):
                    self._take(frame)
        except TriggerError as error:
            self._die(error)
        except Exception as error:  # noqa: BLE001 - the outermost boundary of the thread: told to all who wait
            self._die(TriggerError(f"{self.transport.name}: {type(error).__name__}: {error}"))

    def _take(self, frame: Frame) -> None:
        with self._news:
            if frame.type == FrameType.TAG and len(frame.payload) == TAG_BYTES:
                self._take_tag(frame)
            else:
                self._take_answer(frame)
            self._news.notify_all()

    def _take_tag(self, frame: Frame) -> None:
        if len(self._tags) == _TAGS_KEPT:
            self._tags.popleft()
            self._counts["tags_dropped"] += 1
        self._tags.append(TagArrival(frame.sequence, unpack_tag(frame.payload)))

    def _take_answer(self, frame: Frame) -> None:
        """Answer the call it belongs to; those sent before it will not be answered any more."""
        call = self._on_the_way.get(frame.sequence)
        if call is None or not answers(call.frame, frame):
            self._counts["unexpected"] += 1
            return
        for number in list(self._on_the_way):
            del self._on_the_way[number]
            if number == frame.sequence:
                break
            self._counts["lost"] += 1
        call.answer = frame
        self._progress_s = time.monotonic()
        self._longest_s = max(self._longest_s, self._progress_s - call.begun_s)

    def _die(self, error: TriggerError) -> None:
        with self._news:
            self._dead = self._dead or error
            self._news.notify_all()


def _answer_bytes(call: _Call) -> int:
    """Encoded bytes of the answer to expect."""
    if call.kind != FrameType.READ:
        return 0
    _, count = parse_read(call.payload)
    return _EMPTY_DATA_BYTES + 4 * count
