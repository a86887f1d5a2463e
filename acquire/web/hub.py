"""The page's single subscription to the daemon: its latest status, its news, and whether it answers.

All pages read from here, so that their number costs the daemon nothing. Pages are informed within `LOST_S` of
a daemon that does not answer, and the connection is retried until it is back.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections import deque
from typing import TYPE_CHECKING

from acquire.client import AsyncClient, EventReader
from acquire.daemon.facts import Health, News, Setup
from acquire.daemon.health import health_of
from acquire.daemon.messages import Status
from acquire.daemon.states import State
from acquire.errors import AcquireError, NoDaemonError
from acquire.text import visible
from acquire.web.frames import json_message, message
from acquire.web.glimpser import Glimpser
from acquire.web.live import RECORDING_TURN_S, TURN_S

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from acquire.web.live import Live

STATUS_S = 0.5
LOST_S = 1.5
"""Silence after which the daemon counts as lost; it sends a status every `STATUS_S`."""
RETRY_S = 0.25
KEPT_S = 0.1
"""Age up to which all pages get the same state message: to make one takes longer than to send it."""
MOST_NEWS = 500
"""Number of news items kept for pages that are opened later."""

log = logging.getLogger("acquire.web")


class Listeners:
    """The streams of one event loop that wait for something new. None is told what: each looks for itself."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._waiting: set[asyncio.Event] = set()

    def listen(self) -> asyncio.Event:
        """Return an event that is set whenever there is something new, until `forget`."""
        event = asyncio.Event()
        self._waiting.add(event)
        return event

    def forget(self, event: asyncio.Event) -> None:
        """Do not set the event any more, as its stream has ended."""
        self._waiting.discard(event)

    def wake(self) -> None:
        """Set all events; to be called in the loop."""
        for event in self._waiting:
            event.set()

    def wake_from_thread(self) -> None:
        """Set all events soon; to be called in any thread."""
        if not self._loop.is_closed():  # the live thread may outlive the loop for a moment
            self._loop.call_soon_threadsafe(self.wake)


class KeptNews:
    """The latest `MOST_NEWS` messages about news, numbered from 0 on, for pages that are opened later."""

    def __init__(self) -> None:
        self._kept: deque[tuple[int, bytes]] = deque(maxlen=MOST_NEWS)
        self._count = 0

    def add(self, news: News) -> None:
        """Keep another one, and drop the oldest if there are too many."""
        self._kept.append((self._count, json_message("news", news.model_dump_json())))
        self._count += 1

    def after(self, number: int) -> tuple[int, list[bytes]]:
        """Return the next number, and the messages from ``number`` on that are still kept."""
        if number >= self._count:  # usually: pages ask twenty times a second, and hundreds of news are kept
            return self._count, []
        return self._count, [news for k, news in self._kept if k >= number]


class Hub:
    """Belongs to one event loop, in which `run` must run."""

    def __init__(self, socket: Path, make_live: Callable[[Callable[[], None]], Live]) -> None:
        self.client = AsyncClient(socket)
        self.listeners, self.news = Listeners(), KeptNews()
        self.live = make_live(self.listeners.wake_from_thread)
        self.glimpser = Glimpser(socket, self.listeners.wake)
        self.status: Status | None = None
        self.setup: Setup | None = None
        self.connected = False
        self.why = "the daemon has not answered yet"
        self._heard_s = time.monotonic()
        self._armed_s = self._status_s = time.monotonic()
        self._version = 0
        self._run_id: str | None = None
        self._made: tuple[int, float, bytes] = -1, 0.0, b""
        """The latest state message, with its version and when it was made."""

    async def run(self) -> None:
        """Follow the daemon until cancelled."""
        self.live.begin()
        reader = EventReader()
        watch = asyncio.create_task(self._watch())
        try:
            while True:
                try:
                    await self._follow(reader)
                except (AcquireError, OSError) as error:
                    self._lose(error)
                # For example, no thread is free for a connection; the last state must not be shown for ever.
                except Exception as error:
                    if str(error) != self.why:  # once, and not at every try
                        log.exception("following the daemon")
                    self._lose(error)
                await asyncio.sleep(RETRY_S)
        finally:
            watch.cancel()
            self.live.close()

    # ---- for pages

    @property
    def version(self) -> int:
        """Number that rises with every change of `state_message`."""
        return self._version

    def state_message(self) -> bytes:
        """Return the latest status with its health, or a message that the daemon does not answer."""
        if not self.connected or self.status is None:
            return message({"type": "link", "connected": False, "why": self.why})
        version, made_s, made = self._made
        if version == self._version and time.monotonic() - made_s < KEPT_S:
            return made
        status, health = self.status.model_dump_json(), self.health().model_dump_json()
        # No clock's time: the browser's may be wrong, and the host's may be set at any moment.
        for_s = self.status.state_s + time.monotonic() - self._status_s
        live = json.dumps(visible(self.live.error))
        facts = f'{{"for_s":{for_s:.3f},"status":{status},"health":{health},"live_error":{live}}}'
        made = json_message("state", facts)
        self._made = self._version, time.monotonic(), made
        return made

    def health(self) -> Health:
        """Return the health of the latest status. Raises NoDaemonError if the daemon does not answer."""
        if not self.connected or self.status is None or self.setup is None:
            raise NoDaemonError(self.why, hint="acquire serve")
        return health_of(self.status, self.setup.line_rate_hz, time.monotonic() - self._armed_s)

    # ---- the daemon

    async def _follow(self, reader: EventReader) -> None:
        # On every connection, since a daemon that was started anew may have another rig.
        self.setup = await self.client.setup()
        async for item in self.client.follow(reader, history=True, status_s=STATUS_S):
            # Any message counts, not only a status: see `_watch`.
            self._heard_s = time.monotonic()
            if isinstance(item, News):
                self.news.add(item)
            elif item is not None:
                if not self.connected:
                    log.info("connected to the daemon (process %d)", item.pid)
                self.connected, self.status, self._status_s = True, item, self._heard_s
                self.live.turn_s = RECORDING_TURN_S if self.is_recording else TURN_S
                self._version += 1
                if item.run_id != self._run_id:  # each run has its own rings
                    self._run_id = item.run_id
                    self._armed_s = time.monotonic()
                    self.live.show(None if item.run_id is None else await self.client.rings(), self.setup)
            self.listeners.wake()

    async def _watch(self) -> None:
        """Detect a daemon that hangs: it sends nothing, but its connection stays open."""
        while True:
            await asyncio.sleep(RETRY_S)
            if self.connected and time.monotonic() - self._heard_s > LOST_S:
                self._lose(
                    NoDaemonError(
                        f"the daemon has not sent anything for {LOST_S:g} s",
                        hint="acquire status; if it gets no answer either, start the daemon anew",
                    )
                )

    def _lose(self, error: Exception) -> None:
        if self.connected:
            log.warning("%s", error)
        self.connected, self._run_id = False, None  # so that even the same run's rings are shown again
        self.why = error.message if isinstance(error, AcquireError) else str(error)
        self._version += 1
        self.live.show(None, None)
        self.listeners.wake()

    @property
    def is_recording(self) -> bool:
        """True while a recording is being written, which takes precedence on disk and processors."""
        return self.status is not None and self.status.state in (State.RECORDING, State.DRAINING)
