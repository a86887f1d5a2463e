"""The daemon's API as offered by the page's process: calls are forwarded, and logged with their caller."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from acquire.client import core
from acquire.daemon.facts import LogTail
from acquire.daemon.messages import Status
from acquire.daemon.stream import ALIVE, news_text, status_text

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from acquire.daemon.facts import Health, Reloaded, Rings, Setup, Version
    from acquire.daemon.messages import ArmRequest, CapacityStatus, MarkRequest, StartRequest
    from acquire.web.hub import Hub
    from acquire.web.tokens import TokenFile, Tokens

KEPT_S = 1.0
"""Age up to which all pages get the same end of the daemon's log."""


class Passing:
    """See the module; the methods are those of `acquire.daemon.routes.Api`."""

    def __init__(self, hub: Hub, tokens: Tokens | TokenFile) -> None:
        self._hub = hub
        self._tokens = tokens
        self._log, self._log_s = LogTail(entries=[]), -KEPT_S
        self._client = hub.client

    async def status(self) -> Status:
        return await self._client.status()

    async def arm(self, request: ArmRequest) -> Status:
        return await self._client.call(core.command("arm", Status, request))

    async def start(self, request: StartRequest) -> Status:
        return await self._client.call(core.command("start", Status, request))

    async def mark(self, request: MarkRequest) -> Status:
        return await self._client.call(core.command("mark", Status, request))

    async def stop(self) -> Status:
        return await self._client.stop()

    async def disarm(self) -> Status:
        return await self._client.disarm()

    async def measure(self) -> CapacityStatus:
        return await self._client.measure()

    async def reload(self) -> Reloaded:
        return await self._client.reload()

    async def health(self) -> Health:
        # Of the status that the hub has anyway, so that pages that ask often cost the daemon nothing.
        return self._hub.health()

    async def version(self) -> Version:
        return await self._client.version()

    async def setup(self) -> Setup:
        return await self._client.setup()

    async def rings(self) -> Rings:
        return await self._client.rings()

    async def log(self) -> LogTail:
        # Once a second, however many pages show it.
        now_s = time.monotonic()
        if now_s - self._log_s >= KEPT_S:
            self._log = await self._client.log()
            self._log_s = now_s  # only now: an old one is not shown in place of an error
        hide = self._tokens.taken_out_of
        return LogTail(entries=[one.model_copy(update={"text": hide(one.text)}) for one in self._log.entries])

    async def events(
        self, last_id: str | None, status_s: float | None, *, history: bool
    ) -> AsyncIterator[str]:
        reader = core.EventReader(last_id)
        async for item in self._client.follow(reader, history=history, status_s=status_s):
            if item is None:
                yield ALIVE
            else:
                yield status_text(item) if isinstance(item, Status) else news_text(item)
