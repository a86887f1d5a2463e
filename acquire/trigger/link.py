"""A trigger's link: a thread that reads, callers that send and wait; `dialogue` has the protocol.

::

    callers ──▶ transact ──▶ Dialogue ──▶ transport
                   ▲            │ ▲
                   └────────────┘ └── reader thread ──▶ tags (bounded, counted)

When the transport fails, all waiting callers get the error immediately.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import TYPE_CHECKING

from acquire.errors import TriggerError
from acquire.trigger.dialogue import Dialogue, TagArrival, are_settled, results
from acquire.trigger.frames import Frame, parse_write, read_payload, write_payload
from acquire.trigger.registers import MAX_WORDS, FrameType

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from acquire.trigger.transports.base import Transport

# Half a minute at 600 000 lines/s and a tag every 256 lines: longer than any tolerable pause of the host.
_TAGS_KEPT = 1 << 16
_END_S = 5.0


class Link:
    """Owns the transport and the reader thread; `close` ends both.

    Parameters
    ----------
    reply_s : silence after which a request is repeated, without transmission times
    attempts : how often a request is sent before TriggerError
    """

    def __init__(self, transport: Transport, reply_s: float = 0.25, attempts: int = 8) -> None:
        self.transport = transport
        self._dialogue = Dialogue(transport.name, transport.bytes_per_s, reply_s, attempts)
        self._news = threading.Condition()  # guards the dialogue, the tags and the link's error
        # Taken before `_news`, so that bytes are written in the order of their sequences.
        self._sending = threading.Lock()
        self._tags: deque[TagArrival] = deque()
        self._tags_dropped = 0
        self._interrupted = False
        self._dead: TriggerError | None = None
        self._ending = threading.Event()
        self._reader = threading.Thread(target=self._read, name="acquire-trigger-link", daemon=True)
        self._reader.start()

    @property
    def dead(self) -> TriggerError | None:
        """The error that ended the link; None while it is alive."""
        return self._dead

    @property
    def window_bytes(self) -> int:
        """Limit of unanswered requests, or of their answers; the driver sets it to the device's capacity."""
        return self._dialogue.window_bytes

    @window_bytes.setter
    def window_bytes(self, size_bytes: int) -> None:
        self._dialogue.window_bytes = size_bytes

    @property
    def limit_s(self) -> float:
        """Time within which a request is answered, or TriggerError raised; a late host may take longer."""
        return self._dialogue.limit_s

    def read(self, address: int, count: int = 1) -> tuple[int, ...]:
        """Read ``count`` words from ``address`` on."""
        return self.read_block(address, count)

    def write(self, address: int, words: Sequence[int]) -> None:
        """Write words; return when the device has taken them."""
        self.transact([(FrameType.WRITE, write_payload(address, words))])

    def read_block(self, address: int, count: int) -> tuple[int, ...]:
        """Read any number of words, in pipelined requests."""
        parts = [(a, min(MAX_WORDS, address + count - a)) for a in range(address, address + count, MAX_WORDS)]
        replies = self.transact([(FrameType.READ, read_payload(*part)) for part in parts])
        return tuple(word for reply in replies for word in parse_write(reply.payload)[1])

    def write_block(self, address: int, words: Sequence[int]) -> None:
        """Write any number of words, in pipelined requests; not necessarily in order."""
        parts = [(address + at, words[at : at + MAX_WORDS]) for at in range(0, len(words), MAX_WORDS)]
        self.transact([(FrameType.WRITE, write_payload(*part)) for part in parts])

    def transact(self, requests: Iterable[tuple[FrameType, bytes]]) -> list[Frame]:
        """Send requests, type and payload, whose order does not matter; return their answers.

        Raises RefusedError for the first that the device refuses, TriggerError if an answer does not come or
        the link is dead.
        """
        dialogue = self._dialogue
        # Waiting callers also send and repeat the requests of others: there is no thread for that, and the
        # caller concerned may be waiting for the lock.
        with self._news:
            calls = dialogue.ask(requests)
        try:
            while True:
                self._send()
                with self._news:
                    self._news.wait_for(
                        lambda: self._dead or dialogue.can_send or are_settled(calls),
                        dialogue.deadline_s - time.monotonic(),
                    )
                    if self._dead:
                        raise self._dead
                    if dialogue.expire(time.monotonic()):
                        self._news.notify_all()  # it may have given up the calls of others, too
                    if are_settled(calls):
                        return results(calls)
        finally:
            with self._news:
                dialogue.forget(calls)
                self._news.notify_all()  # calls that are forgotten leave room for those of others

    def tags(self, timeout_s: float) -> list[TagArrival]:
        """Return the tags since the last call; wait up to ``timeout_s`` for the first, or for `interrupt`."""
        with self._news:
            self._interrupted = False  # an earlier one was meant for an earlier wait
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
        """Return the counts of `Dialogue.statistics`, and of tags for which there was no room."""
        with self._news:
            return {**self._dialogue.statistics(), "tags_dropped": self._tags_dropped}

    def close(self) -> None:
        """End the reader and the transport; waiting callers get TriggerError. Idempotent."""
        # The reader ends before its transport: the number of a closed descriptor may be reused for another
        # file.
        self._ending.set()
        self._die(TriggerError(f"{self.transport.name} was closed", hint="open it again"))
        # A read returns after `READ_WAIT_S`: this takes longer only if the port's driver hangs.
        self._reader.join(_END_S)
        self.transport.close()

    def _send(self) -> None:
        """Send all queued requests, of any caller, for which the window has room."""
        # The write itself holds no lock that the reader needs: a device whose answers are not read may stop
        # taking requests, and each side would wait for the other.
        with self._sending:
            with self._news:
                if self._dead:
                    raise self._dead
                data = self._dialogue.to_send(time.monotonic())
            if data:
                try:
                    self.transport.write(data)
                except TriggerError as error:
                    self._die(error)
                    raise

    def _read(self) -> None:
        try:
            while not self._ending.is_set():
                if data := self.transport.read():
                    with self._news:
                        self._tags += self._dialogue.receive(data, time.monotonic())
                        # Drop the oldest: a tag confirms every line up to its own.
                        while len(self._tags) > _TAGS_KEPT:
                            self._tags.popleft()
                            self._tags_dropped += 1
                        self._news.notify_all()
        except TriggerError as error:
            self._die(error)
        except Exception as error:  # noqa: BLE001 - the outermost boundary of the thread: raised in callers
            self._die(
                TriggerError(
                    f"{self.transport.name}: {type(error).__name__}: {error}",
                    hint="check cable and power, then arm again",
                )
            )

    def _die(self, error: TriggerError) -> None:
        with self._news:
            self._dead = self._dead or error  # the first: what fails after it is a consequence
            self._news.notify_all()
