"""The same client for asyncio: see `acquire.client`."""

from __future__ import annotations

import asyncio
import contextlib
import ssl
import time
from typing import TYPE_CHECKING, Self, TypeVar, Unpack

import h11
from pydantic import BaseModel

from acquire.client import core
from acquire.client.core import ApiCall, EventReader, Target
from acquire.daemon.facts import Health, LogTail, News, Reloaded, Rings, Setup, Version
from acquire.daemon.messages import ArmRequest, CapacityStatus, StartRequest, Status
from acquire.daemon.options import ArmOptions, StartOptions
from acquire.daemon.peer import connect
from acquire.errors import NoDaemonError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator
    from pathlib import Path

PATIENCE_S = 30.0
RETRY_S = 0.1
COMMAND_S = 600.0
"""Longest wait for the answer to a command; cancel the call to wait for less."""
_LEAVE_S = 1.0
_READ_BYTES = 65536

T = TypeVar("T", bound=BaseModel)


class AsyncClient:
    """`Client` with `await`, for one event loop; concurrent calls each have their own connection."""

    def __init__(self, place: Path | str | None = None, *, token: str | None = None) -> None:
        """Take the same arguments as `Client`."""
        self._target = Target.of(place, token)

    def __repr__(self) -> str:
        return f"AsyncClient({str(self._target)!r})"

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        """Do nothing: each call closes its own connection."""

    @core.shows(ArmOptions, ArmRequest)
    async def arm(self, *, request_id: str | None = None, **options: Unpack[ArmOptions]) -> Status:
        """Go from idle to armed; the light follows ``code``."""
        return await self.call(core.arm(request_id, **options))

    @core.shows(StartOptions, StartRequest)
    async def start(
        self,
        path: Path | str | None = None,
        *,
        request_id: str | None = None,
        **options: Unpack[StartOptions],
    ) -> Status:
        """Go from armed to recording."""
        return await self.call(core.start(path, request_id, **options))

    async def mark(self, text: str = "", *, request_id: str | None = None) -> Status:
        """Mark the newest line with an event."""
        return await self.call(core.mark(text, request_id))

    async def stop(self, *, request_id: str | None = None) -> Status:
        """Go from recording to armed; return once the recording is sealed."""
        return await self.call(core.command("stop", Status, request_id=request_id))

    async def disarm(self, *, request_id: str | None = None) -> Status:
        """Go from armed to idle, or clear a fault."""
        return await self.call(core.command("disarm", Status, request_id=request_id))

    async def measure(self) -> CapacityStatus:
        """Measure what ring, codec and disk sustain on the daemon's host; only while idle."""
        return await self.call(core.command("capacity", CapacityStatus))

    async def reload(self) -> Reloaded:
        """Let the daemon reload its rig file; all is refused if a changed key cannot take effect now."""
        return await self.call(core.command("reload", Reloaded))

    async def status(self) -> Status:
        return await self.call(core.fact("status", Status))

    async def health(self) -> Health:
        return await self.call(core.fact("health", Health))

    async def version(self) -> Version:
        return await self.call(core.fact("version", Version))

    async def setup(self) -> Setup:
        return await self.call(core.fact("setup", Setup))

    async def rings(self) -> Rings:
        return await self.call(core.fact("rings", Rings))

    async def log(self) -> LogTail:
        return await self.call(core.fact("log", LogTail))

    async def events(self, last_id: str | None = None, *, history: bool = False) -> AsyncIterator[News]:
        """Yield news as it happens. A broken connection is made again, and no news is missed.

        Raises NoDaemonError if the daemon is gone for longer than `PATIENCE_S`.
        """
        reader = EventReader(last_id)
        lost_s: float | None = None
        while True:
            try:
                async for item in self.follow(reader, history=history):
                    lost_s = None
                    if isinstance(item, News):
                        yield item
            except NoDaemonError:
                # The time counts from the first failure; any sign of life since then has reset it.
                lost_s = lost_s or time.monotonic()
                if time.monotonic() - lost_s > PATIENCE_S:
                    raise
                await asyncio.sleep(RETRY_S)

    async def follow(
        self, reader: EventReader, *, history: bool = False, status_s: float | None = None
    ) -> AsyncIterator[News | Status | None]:
        """Yield the news of one connection, with a status every ``status_s``; None: no more for now.

        Raises NoDaemonError if the connection breaks, or is silent for `core.SILENT_S`.
        """
        reader.begin()
        path = core.events_path(self._target, history=history, status_s=status_s)
        async with contextlib.aclosing(
            self._exchange(
                "GET", path, core.events_headers(self._target, reader.last_id), None, core.SILENT_S
            )
        ) as parts:
            status, rest = 0, b""
            async for part in parts:
                if isinstance(part, int):
                    status = part
                    continue
                rest += part
                lines: list[bytes] = []
                if status < core.BAD:  # an error may come in several parts, and is read below
                    *lines, rest = rest.split(b"\n")
                if len(rest) > core.MOST_LINE_BYTES:
                    raise NoDaemonError(
                        f"the daemon on {self._target} sends a line of news that is too long",
                        hint=core.IF_FOREIGN,
                    )
                for line in lines:
                    for item in reader.take(line.decode(errors="replace").rstrip("\r")):
                        yield item
            if status >= core.BAD:
                core.fact("events", Status).read(status, rest, self._target)
        raise NoDaemonError(f"the daemon on {self._target} has ended", hint=core.IF_ENDED)

    async def call(self, call: ApiCall[T]) -> T:
        """Make a call; a command whose connection breaks is sent once more, with the same id."""
        try:
            return await self._once(call)
        # Once: if the first request arrived, the second gets its answer, and nothing is done twice.
        except NoDaemonError:
            if call.request_id is None:
                raise
        return await self._once(call)

    async def _once(self, call: ApiCall[T]) -> T:
        limit_s = COMMAND_S if call.method == "POST" else call.timeout_s
        status, content = 0, b""
        path, headers = self._target.path(call.name), call.headers(self._target)
        async with contextlib.aclosing(
            self._exchange(call.method, path, headers, call.content, limit_s)
        ) as parts:
            async for part in parts:
                if isinstance(part, int):
                    status = part
                else:
                    content += part
                if len(content) > core.MOST_BYTES:
                    raise NoDaemonError(
                        f"the daemon on {self._target} sends an answer that is too long", hint=core.IF_FOREIGN
                    )
        return call.read(status, content, self._target)

    async def _exchange(
        self, method: str, path: str, headers: dict[str, str], body: bytes | None, limit_s: float
    ) -> AsyncGenerator[int | bytes, None]:
        """Yield the answer's status, then its content as it arrives. ``limit_s`` bounds each wait."""
        reader, writer = await self._connect()
        http = h11.Connection(h11.CLIENT)
        sent = headers | ({"Content-Length": str(len(body))} if body else {})
        try:
            writer.write(
                http.send(h11.Request(method=method, target=path, headers=list(sent.items()))) or b""
            )
            if body:
                writer.write(http.send(h11.Data(data=body)) or b"")
            writer.write(http.send(h11.EndOfMessage()) or b"")
            while True:
                event = http.next_event()
                if event is h11.NEED_DATA:
                    async with asyncio.timeout(limit_s):
                        # Nothing, at the end of the connection, makes h11 refuse an answer cut short.
                        http.receive_data(await reader.read(_READ_BYTES))
                elif isinstance(event, h11.Response):
                    yield event.status_code
                elif isinstance(event, h11.Data):
                    yield bytes(event.data)
                else:
                    return
        except TimeoutError as error:
            raise NoDaemonError(
                f"the daemon on {self._target} did not answer within {limit_s:g} s", hint=core.IF_SILENT
            ) from error
        except (OSError, h11.RemoteProtocolError) as error:
            raise NoDaemonError(
                f"the daemon on {self._target} has closed the connection", hint=core.IF_ENDED
            ) from error
        finally:
            await _close(writer)

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        target = self._target
        if target.socket is not None:
            # `connect` also checks who listens, and waits for a busy daemon: it must not block the loop.
            connection = await asyncio.to_thread(connect, target.socket, core.CONNECT_TIMEOUT_S)
            # asyncio takes no blocking socket, and `connect` has given this one a timeout.
            connection.setblocking(False)
            return await asyncio.open_unix_connection(sock=connection)
        try:
            async with asyncio.timeout(core.CONNECT_TIMEOUT_S):
                context = ssl.create_default_context() if target.tls else None
                return await asyncio.open_connection(target.host, target.port, ssl=context)
        except OSError as error:
            raise NoDaemonError(f"no page answers at {target} ({error})", hint="acquire web") from error


async def _close(writer: asyncio.StreamWriter) -> None:
    """Close a connection. TLS sends a notice first, whose answer is awaited only for a short time."""
    writer.close()
    try:
        async with asyncio.timeout(_LEAVE_S):
            await writer.wait_closed()
    except (OSError, TimeoutError):
        writer.transport.abort()
