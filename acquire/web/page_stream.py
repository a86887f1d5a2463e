"""One stream per visible page: state, news and pictures on one connection, of which a browser has six.

Nothing is queued for a page. It is woken, reads what is new from its positions in the two logs, and writes
it. A page that reads slowly gets the newest pictures, and one that does not read at all is disconnected.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from acquire.daemon.stream import Places, wait
from acquire.errors import StateError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from acquire.daemon.stream import StreamPlace
    from acquire.web.hub import Hub

MOST_PAGES = 24
LEAST_S = 0.045
"""Shortest time between two writes, which are then about twenty per second."""
STATE_S = 0.8
"""Longest time between two states: a page that receives nothing for two seconds shows a warning. Longer than
the time between two statuses (`hub.STATUS_S`), so that no state is sent twice."""


class OpenPages:
    """All pages of one event loop."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._places = Places()

    def open(self, *, pictures: bool, glimpses: bool) -> AsyncIterator[bytes]:
        """Return a page's messages (`acquire.web.frames`). Raises StateError if there are too many pages."""
        if len(self._places) >= MOST_PAGES:
            raise StateError(f"{MOST_PAGES} pages are open already", hint="close one of them")
        return self._stream(self._places.take(), pictures=pictures, glimpses=glimpses)

    @property
    def state(self) -> bytes:
        return self._hub.state_message()

    async def _stream(self, place: StreamPlace, *, pictures: bool, glimpses: bool) -> AsyncIterator[bytes]:
        hub = self._hub
        # Not in `open`: a stream that is never begun would never reach `finally`.
        woken = hub.listeners.listen()
        next_row = hub.live.watch() if pictures else 0
        # News start with the oldest that is kept: a page that is opened later shows earlier events, too.
        next_news, version, state_s, glimpse = 0, -1, 0.0, hub.glimpser.number
        if glimpses:
            hub.glimpser.watch()
        try:
            while True:
                # Cleared before reading, so that news that come meanwhile wake the page again.
                woken.clear()
                parts: list[bytes] = []
                next_news, news = hub.news.after(next_news)
                now_s = time.monotonic()
                if hub.version != version or news or now_s - state_s >= STATE_S:
                    version, state_s = hub.version, now_s
                    parts.append(hub.state_message())
                parts += news
                if pictures:
                    next_row, rows = hub.live.after(next_row)
                    parts += rows
                if glimpses and hub.glimpser.number != glimpse:
                    glimpse = hub.glimpser.number
                    parts.append(hub.glimpser.latest)
                if parts:
                    yield b"".join(parts)
                # Whatever comes meanwhile is sent in one piece.
                await asyncio.sleep(LEAST_S)
                await wait(woken, STATE_S - LEAST_S)
        finally:
            place.give_back()
            hub.listeners.forget(woken)
            if pictures:
                hub.live.leave()
            if glimpses:
                hub.glimpser.leave()
