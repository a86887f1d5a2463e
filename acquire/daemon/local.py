"""The API over the service in this process.

Commands run one by one in the thread that owns the devices; everything else is answered from the latest
status that this thread has published, so that it never waits for a device.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from typing import TYPE_CHECKING

from acquire.daemon.devices import KnownDevices
from acquire.daemon.facts import LogEntry, LogTail
from acquire.daemon.health import health_of
from acquire.daemon.messages import fault_error
from acquire.daemon.setup import rings_of, setup_of, version_of
from acquire.daemon.states import State
from acquire.daemon.stream import Streams
from acquire.daemon.who import WHO
from acquire.errors import UsageError
from acquire.logs import latest_entries

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from acquire.daemon.facts import Health, Reloaded, Rings, Setup, Version
    from acquire.daemon.messages import ArmRequest, CapacityStatus, MarkRequest, StartRequest, Status
    from acquire.daemon.reload import Reloading
    from acquire.daemon.service import Service

POLL_S = 0.02
Run = Callable[[Callable[[], None]], Awaitable[None]]
"""Carries a command out in the thread that owns the devices."""


class Local:
    """See the module; the methods are those of `acquire.daemon.routes.Api`."""

    def __init__(
        self,
        service: Service,
        run: Run,
        reloading: Reloading | None = None,
        devices: KnownDevices | None = None,
    ) -> None:
        self._service = service
        self._run = run
        self._reloading = reloading
        self._devices = devices or KnownDevices()
        self._streams = Streams(service.news, service.status)

    async def status(self) -> Status:
        return self._service.status()

    async def arm(self, request: ArmRequest) -> Status:
        return await self._do("arm", lambda: self._service.arm(request))

    async def start(self, request: StartRequest) -> Status:
        return await self._do("start", lambda: self._service.start(request))

    async def mark(self, request: MarkRequest) -> Status:
        return await self._do("mark", lambda: self._service.mark(request.text))

    async def stop(self) -> Status:
        """Stop, and return once the recording is sealed. Raises a fault that occurs in the meantime."""
        await self._do("stop", self._service.stop)
        # Waiting here, and not in the devices' thread, keeps marks possible while the recording drains.
        while (status := self._service.status()).state is State.DRAINING:
            await asyncio.sleep(POLL_S)
        if status.state is State.FAULTED:
            raise fault_error(status.fault)
        return status

    async def disarm(self) -> Status:
        return await self._do("disarm", self._service.disarm)

    async def measure(self) -> CapacityStatus:
        await self._run(self._service.measure)
        found = self._service.status().capacity
        assert found is not None
        return found

    async def reload(self) -> Reloaded:
        """Reload the rig file, which is read in a separate thread: a slow disk must not stop supervision."""
        if self._reloading is None:
            raise UsageError(
                "this daemon's configuration is not from a file", hint="end it, and start another"
            )
        done: list[Reloaded] = []
        who = WHO.get() or "the control socket"
        # Between the two, another reload may be applied: `apply` compares with what holds by then.
        new, apply = await asyncio.to_thread(self._reloading.read, who), self._reloading.apply
        await self._run(lambda: done.append(apply(new, who)))
        return done[0]

    async def health(self) -> Health:
        status, config = self._service.status(), self._service.config
        return health_of(status, config.passing_hz, time.monotonic() - self._service.armed_s)

    async def version(self) -> Version:
        return version_of(self._service.config)

    async def setup(self) -> Setup:
        return setup_of(self._service.config, self._service.origin, self._devices.facts)

    async def log(self) -> LogTail:
        return LogTail(entries=[LogEntry(**asdict(one)) for one in latest_entries()])

    async def rings(self) -> Rings:
        return rings_of(self._service)

    def events(self, last_id: str | None, status_s: float | None, *, history: bool) -> AsyncIterator[str]:
        return self._streams.open(last_id, status_s, history=history)

    async def _do(self, name: str, command: Callable[[], None]) -> Status:
        # Read here: the devices' thread does not have this request's context.
        who = WHO.get()

        def signed() -> None:
            # Signed afterwards: a refused command leaves no trace, and a start is noted in its own recording.
            command()
            if who:
                self._service.sign(name, who)

        await self._run(signed)
        return self._service.status()
