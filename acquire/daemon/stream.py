"""The news as a stream of server-sent events: news, the status, and a sign of life each second.

::

    id: 5f3a9c01-17                       id of the news; sent as Last-Event-ID after a reconnection
    event: news | status
    data: {…}                             `News` | `Status`
    : alive                               nothing more for now

When a stream is woken it continues from its position in the log. A slow reader is waited for in the socket,
and one that does not read at all is disconnected (`connections.SEND_S`).
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from acquire.errors import StateError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from acquire.daemon.facts import News
    from acquire.daemon.messages import Status
    from acquire.daemon.news import NewsLog

ALIVE_S = 1.0
"""Longest silence of a stream: clients take a longer one for the daemon's death."""
ALIVE = ": alive\n\n"
"""Also sent after the news with which a stream begins: the client then knows that these were all."""
MOST_STREAMS = 16
"""Each holds a connection (`connections.MOST_CONNECTIONS`)."""
LEAST_STATUS_S, MOST_STATUS_S = 0.05, 60.0


class Places:
    """The places of the streams that are open, or will be in a moment: their number is exact at any time."""

    def __init__(self) -> None:
        # By number: a place may be given back by the garbage collector, in any thread.
        self._taken: set[int] = set()

    def __len__(self) -> int:
        return len(self._taken)

    def take(self) -> StreamPlace:
        return StreamPlace(self._taken)


class StreamPlace:
    """A place, also given back when its stream is dropped before its first step."""

    def __init__(self, taken: set[int]) -> None:
        self._taken = taken
        taken.add(id(self))

    def give_back(self) -> None:
        """Idempotent."""
        self._taken.discard(id(self))

    # A generator that was never begun reaches no `finally`, but its arguments are dropped with it.
    __del__ = give_back


class Streams:
    """All streams of one event loop, `MOST_STREAMS` at most."""

    def __init__(self, log: NewsLog, status: Callable[[], Status]) -> None:
        self._log = log
        self._status = status
        self._places = Places()

    def open(self, last_id: str | None, status_s: float | None, *, history: bool) -> AsyncIterator[str]:
        """Return the text of a stream. Raises StateError if there are too many already.

        ``last_id``: ID of the latest news that the client has; without one, all news that are kept come first
        if ``history``. ``status_s``: time between two statuses, which also come with every news; None: none.
        """
        if len(self._places) >= MOST_STREAMS:
            raise StateError(
                f"{MOST_STREAMS} clients follow the news already", possible="status", hint="close one of them"
            )
        # As of the request, not of the stream's first step: news in between must not be missed.
        if last_id is None and not history:
            last_id = self._log.last_id
        return self._stream(self._places.take(), last_id, status_s)

    async def _stream(
        self, place: StreamPlace, last_id: str | None, status_s: float | None
    ) -> AsyncIterator[str]:
        loop, woken = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            if not loop.is_closed():  # the devices' thread may still report how a run was closed
                loop.call_soon_threadsafe(woken.set)

        # Not in `open`: a stream that is never begun would never reach `finally`.
        self._log.listen(wake)
        due_s, begins = time.monotonic(), True
        try:
            while not self._log.closed:
                # Cleared before reading, so that news that come meanwhile wake the stream again.
                was_woken = woken.is_set()
                woken.clear()
                news = self._log.after(last_id)
                for one in news:
                    last_id = one.id
                    yield news_text(one)
                now_s = time.monotonic()
                if status_s is not None and (was_woken or now_s >= due_s):
                    due_s = now_s + status_s
                    yield status_text(self._status())
                elif begins or not news:
                    yield ALIVE
                begins = False
                await wait(woken, ALIVE_S if status_s is None else min(ALIVE_S, max(0.0, due_s - now_s)))
        finally:
            place.give_back()
            self._log.forget(wake)


async def wait(woken: asyncio.Event, seconds: float) -> None:
    """Wait until the event is set, for ``seconds`` at most."""
    try:
        async with asyncio.timeout(seconds):
            await woken.wait()
    except TimeoutError:
        return


def news_text(news: News) -> str:
    """Return news as an event of the stream, with the id from which a client can continue."""
    return f"id: {news.id}\nevent: news\ndata: {news.model_dump_json()}\n\n"


def status_text(status: Status) -> str:
    """Return a status as an event of the stream. It has no id: it is never sent again."""
    return f"event: status\ndata: {status.model_dump_json()}\n\n"
