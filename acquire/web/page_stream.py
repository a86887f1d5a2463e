"""One stream per page that is seen: state, news and pictures on one connection, of which a browser has six.

Nothing is queued for a page. It is woken, takes what is new from its places in the two logs, and writes it; a
page that reads slowly takes the newest pictures, and one that does not read at all is disconnected.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from acquire.daemon.stream import wait
from acquire.errors import StateError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from acquire.web.hub import Hub

MOST_PAGES = 24
LEAST_S = 0.045
"""Between two writes: twenty a second."""
STATE_S = 0.5
"""Longest time without a word: a page that hears nothing for two seconds says so."""


class Pages:
    """All pages of one event loop."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._open = 0

    def open(self, *, pictures: bool, glimpses: bool) -> AsyncIterator[bytes]:
        """The messages of a page (`acquire.web.frames`). Raises StateError where there are too many pages."""
        if self._open >= MOST_PAGES:
            raise StateError(f"{MOST_PAGES} pages are open already", hint="close one of them")
        return self._stream(pictures=pictures, glimpses=glimpses)

    @property
    def state(self) -> bytes:
        return self._hub.state_message()

    async def _stream(self, *, pictures: bool, glimpses: bool) -> AsyncIterator[bytes]:
        hub = self._hub
        self._open += 1
        woken = hub.listen()
        place = hub.live.watch() if pictures else 0
        # From the first news that is kept: a page that is opened later shows what has happened before.
        heard, version, told_s, seen = 0, -1, 0.0, hub.glimpser.number
        if glimpses:
            hub.glimpser.watch()
        try:
            while True:
                woken.clear()
                parts: list[bytes] = []
                heard, news = hub.news_after(heard)
                now_s = time.monotonic()
                if hub.version != version or news or now_s - told_s >= STATE_S:
                    version, told_s = hub.version, now_s
                    parts.append(hub.state_message())
                parts += news
                if pictures:
                    place, rows = hub.live.after(place)
                    parts += rows
                if glimpses and hub.glimpser.number != seen:
                    seen = hub.glimpser.number
                    parts.append(hub.glimpser.latest)
                if parts:
                    yield b"".join(parts)
                await asyncio.sleep(LEAST_S)
                await wait(woken, STATE_S - LEAST_S)
        finally:
            self._open -= 1
            hub.forget(woken)
            if pictures:
                hub.live.leave()
            if glimpses:
                hub.glimpser.leave()
