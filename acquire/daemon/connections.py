"""Connections to the control socket, limited in number, time and size, so that status can always be answered.

::

    accept ── a spare descriptor is reserved for the moment when none is left
       ▼
    Connection ── at most MOST_CONNECTIONS: the one idle for longest is closed for the next
       │          a request must arrive completely within REQUEST_S; an answer be read within SEND_S
       ▼
    the API ── a body of at most `control.MAX_BODY_BYTES`

A client that opens two hundred connections, or stops in the middle of a request, is disconnected; the capture
path, in separate processes, is not affected.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import functools
import logging
import os
import resource
import socket
from typing import TYPE_CHECKING, Any, cast

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from starlette.types import ASGIApp

# More than streams (`stream.MOST_STREAMS`) and commands (`server.MOST_WAITING`) can occupy together, which
# leaves some for the status.
MOST_CONNECTIONS = 32
# asyncio takes the `backlog` that it is given for this number as well: with uvicorn's 2048, a flood would be
# accepted in one turn, and the requests of others would wait for all of it.
AT_ONCE = 16
"""Connections accepted in one turn of the event loop."""
WAITING = 1024
"""Connections that may wait in the kernel until they are accepted."""
REQUEST_S = 10.0
"""Time from a connection, or the first byte of a further request on it, to the last byte of the request."""
SEND_S = 10.0
"""Time for a client that does not read."""
IDLE_S = 5
"""Time between two requests on one connection."""
GRACE_S = 2
"""Time for current requests when the daemon ends, in whole seconds."""
LAST_S = 0.7
"""Time for open connections when the server ends: a stream has no end of its own, and half a request may stay
incomplete. If uvicorn cancelled them after `GRACE_S`, they would be answered with 500."""
MOST_DESCRIPTORS = 65536
"""Number of descriptors that is asked for, where the host permits more or sets no limit."""

log = logging.getLogger("acquire.daemon")


def raise_descriptor_limit() -> int:
    """Raise the limit of descriptors as far as permitted and reasonable; return the new limit."""
    # The usual 1024 protects programs that use select(2), which cannot take more. Nothing here does.
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, MOST_DESCRIPTORS)
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return soft
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        return wanted
    return soft


class Listener(socket.socket):
    """A listening socket that can still accept one connection when the process has no descriptor left."""

    _spare = -1
    _paused = False

    def keep_spare(self) -> None:
        """Reserve a spare descriptor, unless there is one."""
        if self._spare < 0:
            with contextlib.suppress(OSError):
                self._spare = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)

    def listen(self, backlog: int = WAITING, /) -> None:
        """Listen with a queue of `WAITING`: the event loop passes only the number accepted in one turn."""
        super().listen(max(backlog, WAITING))

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection; at the limit with the spare descriptor, then the event loop waits a second."""
        if self._paused:  # the error was raised once in this turn of the loop, which calls again at once
            self._paused = False
            raise BlockingIOError(errno.EAGAIN, "no descriptor is left")
        self.keep_spare()
        try:
            return super().accept()
        except OSError as error:
            if error.errno not in (errno.EMFILE, errno.ENFILE):
                raise
        if self._give_spare():
            with contextlib.suppress(OSError):
                return super().accept()
        self._paused = True
        raise OSError(errno.EMFILE, "no descriptor is left for a connection")

    def close(self) -> None:
        self._give_spare()
        super().close()

    def _give_spare(self) -> bool:
        spare, self._spare = self._spare, -1
        if spare >= 0:
            os.close(spare)
        return spare >= 0


class Connection(H11Protocol):
    """One client's connection. uvicorn closes it if idle after an answer; other limits are applied here."""

    most_connections = MOST_CONNECTIONS

    def __init__(self, *args: Any, on_lost: Callable[[], None] = lambda: None, **options: Any) -> None:
        super().__init__(*args, **options)
        self._on_lost = on_lost
        self._timer: asyncio.TimerHandle | None = None
        self._waiting_since: float | None = None

    @property
    def is_working(self) -> bool:
        """Whether a complete request is being answered."""
        cycle: RequestResponseCycle | None = self.cycle  # none before the first request
        return cycle is not None and not cycle.more_body and not cycle.response_complete

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Limit the wait for the first request; if there are too many connections, close an idle one."""
        super().connection_made(transport)
        # From the first moment: a client that connects and sends nothing occupies a descriptor.
        self._wait(REQUEST_S)
        if len(self.connections) > self.most_connections:
            # Close the connection that has waited for longest, or this one if all others are at work.
            others = [cast("Connection", one) for one in self.connections if one is not self]
            idle = [one for one in others if not one.is_working] or [self]
            longest = min(idle, key=lambda one: one._waiting_since or 0.0)
            # Now: `connection_lost` comes in a later turn of the loop, and until then it would be counted.
            self.connections.discard(longest)
            longest.transport.abort()
            log.warning("more than %d connections: the longest idle one is closed", self.most_connections)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self.is_working:
            self._cancel()
        elif self._timer is None:  # a running timer is not prolonged by single bytes
            self._wait(REQUEST_S)

    def on_response_complete(self) -> None:
        super().on_response_complete()
        # An answer may precede the end of its request, such as 413: the rest stays limited in time.
        if not self.cycle.more_body:
            self._cancel()
            self._waiting_since = self.loop.time()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._wait(SEND_S)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._cancel()

    def shutdown(self) -> None:
        super().shutdown()
        self.loop.call_later(LAST_S, self.transport.abort)  # no effect if it has closed by then

    def connection_lost(self, exc: Exception | None) -> None:
        self._cancel()
        super().connection_lost(exc)
        self.loop.call_soon(self._on_lost)  # the descriptor is free after this call

    def _wait(self, seconds: float) -> None:
        self._cancel()
        self._waiting_since = self.loop.time()
        self._timer = self.loop.call_later(seconds, self.transport.abort)

    def _cancel(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._waiting_since = None


class ApiServer(uvicorn.Server):
    """Serves an API on a listener, within the limits of this module. The owner handles signals.

    Attributes
    ----------
    answering : set once requests are answered, and so all necessary modules are loaded
    """

    def __init__(self, app: ASGIApp, listener: Listener) -> None:
        config = uvicorn.Config(
            app,
            log_config=None,
            access_log=False,
            lifespan="off",
            http=functools.partial(Connection, on_lost=self._keep_spare),  # type: ignore[arg-type]
            ws="none",
            backlog=AT_ONCE,
            timeout_keep_alive=IDLE_S,
            timeout_graceful_shutdown=GRACE_S,
        )
        super().__init__(config)
        self._listeners: list[socket.socket] = [listener]
        self._listener = listener
        self.answering = asyncio.Event()

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals to the daemon, which must drain the recording before the API goes away."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self.answering.set()

    async def answer(self) -> None:
        """Serve until `should_exit`."""
        self._keep_spare()
        # The same list in `move`: what is in it when the server ends is closed.
        await self.serve(sockets=self._listeners)

    async def move(self, listener: Listener) -> None:
        """Accept connections on another listener from now on; those that exist continue."""
        before, old = self.servers, self._listener
        await super().startup([listener])
        self._listeners[:], self._listener = [listener], listener
        self._keep_spare()
        for server in before:
            server.close()
        old.close()

    def _keep_spare(self) -> None:
        self._listener.keep_spare()
