"""The news as a stream of server-sent events: what happened, the status, a sign of life each second.

::

    id: 5f3a9c01-17                       id: of the news; given back as Last-Event-ID after a reconnection
    event: news | status
    data: {…}                             `News` | `Status`
    : alive                               nothing more to tell for now

A stream reads on from its place in the log when it is woken. It waits in its socket for a slow reader, and
the connection is ended where one does not read at all (`connections.SEND_S`).
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
ALIVE = ": alive\n\n"
"""Also after the news with which a stream begins: whoever listens knows then that this was all."""
MOST_STREAMS = 16
"""Each holds a connection (`connections.MOST_CONNECTIONS`)."""
LEAST_STATUS_S, MOST_STATUS_S = 0.05, 60.0


class Streams:
    """All streams of one event loop, of which there are only so many."""

    def __init__(self, log: NewsLog, status: Callable[[], Status]) -> None:
        self._log = log
        self._status = status
        self._open = 0

    def open(self, last_id: str | None, status_s: float | None, *, history: bool) -> AsyncIterator[str]:
        """The text of a stream. Raises StateError where there are as many as can be.

        ``last_id``: of the last news that was heard; else all that is known comes first, where ``history`` is
        asked for. ``status_s``: time between two statuses, which also come with every news; None: none.
        """
        if self._open >= MOST_STREAMS:
            raise StateError(
                f"{MOST_STREAMS} clients follow the news already", possible="status", hint="close one of them"
            )
        # As of the request, not of the stream's first step: what happens in between is not missed.
        if last_id is None and not history:
            last_id = self._log.last_id
        return self._stream(last_id, status_s)

    async def _stream(self, last_id: str | None, status_s: float | None) -> AsyncIterator[str]:
        loop, woken = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(woken.set)

        self._open += 1
        self._log.listen(wake)
        due_s, begins = time.monotonic(), True
        try:
            while not self._log.closed:
                told = woken.is_set()
                woken.clear()
                news = self._log.after(last_id)
                for one in news:
                    last_id = one.id
                    yield news_text(one)
                now_s = time.monotonic()
                if status_s is not None and (told or now_s >= due_s):
                    due_s = now_s + status_s
                    yield status_text(self._status())
                elif begins or not news:
                    yield ALIVE
                begins = False
                await wait(woken, ALIVE_S if status_s is None else min(ALIVE_S, max(0.0, due_s - now_s)))
        finally:
            self._open -= 1
            self._log.forget(wake)


async def wait(woken: asyncio.Event, seconds: float) -> None:
    """Until the event is set, at most so long."""
    try:
        async with asyncio.timeout(seconds):
            await woken.wait()
    except TimeoutError:
        return


def news_text(news: News) -> str:
    return f"id: {news.id}\nevent: news\ndata: {news.model_dump_json()}\n\n"


def status_text(status: Status) -> str:
    return f"event: status\ndata: {status.model_dump_json()}\n\n"
