"""The blocking client of the instrument; see `acquire.client`."""

from __future__ import annotations

import contextlib
import http.client
import select
import socket
import ssl
import time
from typing import TYPE_CHECKING, Self, TypeVar, Unpack

from pydantic import BaseModel

from acquire.client import core
from acquire.client.core import ApiCall, EventReader, Target
from acquire.daemon.facts import Health, LogTail, News, Reloaded, Rings, Setup, Version
from acquire.daemon.messages import ArmRequest, CapacityStatus, StartRequest, Status
from acquire.daemon.options import ArmOptions, StartOptions
from acquire.daemon.peer import connect
from acquire.daemon.starting import is_one_starting
from acquire.daemon.states import State
from acquire.errors import NoDaemonError, StateError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator
    from pathlib import Path

    from acquire.store import Recording

STARTING_TIMEOUT_S = 60.0
"""Longest wait for the socket of a daemon that is starting."""
PROGRESS_S = 0.5
POLL_S = 0.1
PATIENCE_S = 30.0
"""Longest time for which a broken stream of news is retried before it is an error."""

T = TypeVar("T", bound=BaseModel)


class Client:
    """One daemon, reached by its socket or by the address of its page. Every call is bounded in time.

    Each call has its own connection, and any thread may make one. A command whose connection breaks is sent
    once more with the same request id, so that it is carried out only once. Raises NoDaemonError if no daemon
    answers, and otherwise the daemon's own errors, as instances of the same classes.
    """

    def __init__(
        self,
        place: Path | str | None = None,
        tell: Callable[[str], object] = lambda _: None,
        *,
        token: str | None = None,
    ) -> None:
        """Connect to nothing yet: each call makes its own connection.

        ``place`` is the socket's path, None for the default one, or http://HOST:PORT with its ``token`` (or
        ACQUIRE_TOKEN). ``tell`` is called with the reason of a wait, as long as it lasts.
        """
        self._target = Target.of(place, token)
        self._tell = tell

    @property
    def path(self) -> Path | None:
        """Path of the socket; None if the daemon is reached by its page."""
        return self._target.socket

    def __repr__(self) -> str:
        return f"Client({str(self._target)!r})"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing: each call closes its own connection."""

    # ---- commands

    @core.shows(ArmOptions, ArmRequest)
    def arm(self, *, request_id: str | None = None, **options: Unpack[ArmOptions]) -> Status:
        """Go from idle to armed: cameras and trigger run, and nothing is written.

        ``force`` arms even if the host is too slow. ``code`` is what the light follows: the rig's code,
        ``"dark"`` for off or ``"steady"`` for on, as calibration needs it. With ``calibration="none"``,
        recordings get no copy of the rig's calibration. ``delays`` of light and cameras and the ``window`` of
        the light in each lit sub-step replace those of the rig.
        """
        return self._do(core.arm(request_id, **options))

    @core.shows(StartOptions, StartRequest)
    def start(
        self,
        path: Path | str | None = None,
        *,
        request_id: str | None = None,
        **options: Unpack[StartOptions],
    ) -> Status:
        """Go from armed to recording. A relative ``path`` is relative to the caller's directory.

        ``pre_s`` seconds of the recording are from before the request, as far as the ring holds them;
        ``post_s`` is the time from the request to its end. With ``resume``, ``path`` is a sealed recording
        that continues in a segment next to it.
        """
        return self._do(core.start(path, request_id, **options))

    def mark(self, text: str = "", *, request_id: str | None = None) -> Status:
        """Mark the newest line with an event, which starts a recording if the rig's ``[events]`` allow it."""
        return self._do(core.mark(text, request_id))

    def stop(self, *, request_id: str | None = None) -> Status:
        """Go from recording to armed; return once the recording is sealed."""
        return self._do(core.command("stop", Status, request_id=request_id))

    def disarm(self, *, request_id: str | None = None) -> Status:
        """Go from armed to idle, or clear a fault."""
        return self._do(core.command("disarm", Status, request_id=request_id))

    def measure(self) -> CapacityStatus:
        """Measure what ring, codec and disk sustain on the daemon's host; only while idle."""
        return self._do(core.command("capacity", CapacityStatus))

    def reload(self) -> Reloaded:
        """Let the daemon reload its rig file; all is refused if a changed key cannot take effect now."""
        return self._do(core.command("reload", Reloaded))

    # ---- facts

    def status(self) -> Status:
        """Return what the daemon is doing; it answers at once, even if it is busy."""
        return self._do(core.fact("status", Status))

    def health(self) -> Health:
        """Return whether all is well: a level, a sentence, and the checks behind them."""
        return self._do(core.fact("health", Health))

    def version(self) -> Version:
        """Return the version and the process of the daemon."""
        return self._do(core.fact("version", Version))

    def setup(self) -> Setup:
        """Return the complete configuration, and where it differs from the defaults."""
        return self._do(core.fact("setup", Setup))

    def rings(self) -> Rings:
        """Return the shared memory of the rings, for `acquire.stream.peek` on the same host."""
        return self._do(core.fact("rings", Rings))

    def log(self) -> LogTail:
        """Return the latest entries of the daemon's log, newest last."""
        return self._do(core.fact("log", LogTail))

    def open(self, path: Path | str | None = None) -> Recording:
        """Open a recording on this host: the one at ``path``, the one being written, or the latest.

        Raises StateError if there is none.
        """
        from acquire.store import open_recording

        if path is None:
            status = self.status()
            latest = status.recording or status.last
            if latest is None:
                raise StateError("nothing has been recorded since the daemon started", hint="client.start()")
            path = latest.path
        return open_recording(path)

    def wait(self, states: Collection[State], timeout_s: float) -> Status:
        """Wait until the daemon is in one of ``states``, and return its status.

        Raises StateError when the time is up, and at once if a fault keeps the daemon from getting there;
        UsageError for what is not a state, which would be waited for in vain.
        """
        states = core.states_of(states)
        deadline = time.monotonic() + timeout_s
        while (status := self.status()).state not in states:
            wanted = " or ".join(states)
            if status.state is State.FAULTED:
                raise StateError(
                    f"the daemon cannot become {wanted}, because it is faulted: {status.fault}",
                    hint="acquire disarm",
                )
            if time.monotonic() >= deadline:
                staying = status.state is State.ARMED and State.IDLE in states
                why = f": {status.waiting}" if status.waiting else ""
                raise StateError(
                    f"the daemon is still {status.state} after {timeout_s:g} s of waiting for {wanted}{why}",
                    hint="acquire disarm, or wait for sealed: a recording's end leaves the instrument armed"
                    if staying
                    else "acquire status, or more time",
                )
            time.sleep(POLL_S)
        return status

    # ---- news

    def events(
        self, last_id: str | None = None, *, history: bool = False, timeout_s: float | None = None
    ) -> Iterator[News]:
        """Yield news as it happens, until ``timeout_s`` after the known news, or forever.

        It starts after the news ``last_id``, with all news that the daemon still has (``history``), or with
        the next. The known news are always complete, however slow the host, and the time ends with the next
        sign of life, which comes every second. A broken connection is made again, and the news from in
        between come first. Raises NoDaemonError if the daemon is gone for longer than `PATIENCE_S`.
        """
        reader = EventReader(last_id)
        end_s: float | None = None
        lost_s: float | None = None
        while end_s is None or time.monotonic() < end_s:
            try:
                for item in self._follow(reader, history=history):
                    lost_s = None
                    if isinstance(item, News):
                        yield item
                    # The first sign of life comes after the known news, which are never cut short.
                    elif end_s is None and timeout_s is not None:
                        end_s = time.monotonic() + timeout_s
                    if end_s is not None and time.monotonic() >= end_s:
                        return
            except NoDaemonError:
                # The time counts from the first failure; any sign of life since then has reset it.
                lost_s = lost_s or time.monotonic()
                if time.monotonic() - lost_s > PATIENCE_S:
                    raise
                time.sleep(POLL_S)

    def _follow(self, reader: EventReader, *, history: bool) -> Iterator[News | Status | None]:
        """Yield the news of one connection. Raises NoDaemonError when it breaks."""
        reader.begin()
        with self._connection(core.SILENT_S) as connection:
            path = core.events_path(self._target, history=history, status_s=None)
            headers = core.events_headers(self._target, reader.last_id)
            try:
                connection.request("GET", path, headers=headers)
                response = connection.getresponse()
                if response.status >= core.BAD:
                    content = _content(response)
                    core.fact("events", Status).read(response.status, content, self._target)
                # A longer line comes in pieces, none of which is whole JSON: it cannot fill the memory.
                while line := response.readline(core.MOST_LINE_BYTES):
                    # What is not UTF-8 is no news of ours either, and refused like other JSON.
                    yield from reader.take(line.decode(errors="replace").rstrip("\r\n"))
            except (OSError, http.client.HTTPException) as error:
                raise NoDaemonError(
                    f"the daemon on {self._target} has closed the connection while it was sending news",
                    hint=core.IF_ENDED,
                ) from error
        raise NoDaemonError(f"the daemon on {self._target} has ended", hint=core.IF_ENDED)

    # ---- the connection

    def _do(self, call: ApiCall[T]) -> T:
        try:
            return self._once(call)
        except _DisconnectedError:
            if call.request_id is None:
                raise
        # Once more, with the same id: if the first request arrived, this one gets its answer, and nothing is
        # done twice. A third attempt would only delay the error if the daemon is gone.
        return self._once(call)

    def _once(self, call: ApiCall[T]) -> T:
        with self._connection(call.timeout_s) as connection:
            try:
                path = self._target.path(call.name)
                connection.request(call.method, path, call.content, call.headers(self._target))
                # No fixed time suits a command, since arming may take a minute: the daemon's status decides.
                if call.method == "POST" and connection.sock is not None:
                    self._await_answer(connection.sock, call.timeout_s)
                response = connection.getresponse()
                return call.read(response.status, _content(response), self._target)
            except TimeoutError as error:
                raise NoDaemonError(
                    f"the daemon on {self._target} did not answer {call.name} within {call.timeout_s:g} s",
                    hint=core.IF_SILENT,
                ) from error
            except (OSError, http.client.HTTPException) as error:
                raise _DisconnectedError(
                    f"the daemon on {self._target} has closed the connection during {call.name}",
                    hint=core.IF_ENDED,
                ) from error

    @contextlib.contextmanager
    def _connection(self, timeout_s: float) -> Iterator[http.client.HTTPConnection]:
        # The library would connect by TCP: it gets a socket that is connected already.
        connection = http.client.HTTPConnection("acquire")
        # With a socket, it does not connect again either if the request breaks.
        connection.sock = self._connect()
        connection.sock.settimeout(timeout_s)
        try:
            yield connection
        finally:
            connection.close()

    def _connect(self) -> socket.socket:
        """Connect to the daemon, after waiting for it if it is starting."""
        path = self._target.socket
        if path is None:
            return connect_to_page(self._target)
        deadline = time.monotonic() + STARTING_TIMEOUT_S
        while True:
            try:
                return connect(path, core.CONNECT_TIMEOUT_S)
            except NoDaemonError:
                if time.monotonic() > deadline:
                    raise
                if not is_one_starting(path):  # there is none, or it has begun to listen in the meantime
                    return connect(path, core.CONNECT_TIMEOUT_S)
            self._tell(f"waiting for the daemon on {path}, which is starting")
            time.sleep(POLL_S)

    def _await_answer(self, connection: socket.socket, timeout_s: float) -> None:
        """Wait for an answer while the daemon is busy; TimeoutError if it is not busy for ``timeout_s``."""
        answered = select.poll()
        answered.register(connection, select.POLLIN)
        deadline = time.monotonic() + timeout_s
        while not answered.poll(PROGRESS_S * 1000):
            try:
                status = self.status()
            except NoDaemonError:
                return  # it is gone or hangs, which the connection will show
            # `stop` is answered once the recording is sealed, and the daemon is not busy meanwhile.
            if status.busy is not None or status.state is State.DRAINING:
                self._tell(status.busy or str(status.state))
                deadline = time.monotonic() + timeout_s
            elif time.monotonic() > deadline:
                raise TimeoutError


class _DisconnectedError(NoDaemonError):
    """The connection broke after the request was sent, so that it may or may not have been carried out."""


def _content(response: http.client.HTTPResponse) -> bytes:
    """Return the whole content. Raises IncompleteRead if it is truncated, which a bounded read would hide."""
    content = response.read(core.MOST_BYTES)
    if response.length:
        raise http.client.IncompleteRead(content, response.length)
    return content


def connect_to_page(target: Target) -> socket.socket:
    """Connect to a page. Raises NoDaemonError if none is served there, or its certificate is not trusted."""
    try:
        plain = socket.create_connection((target.host, target.port), core.CONNECT_TIMEOUT_S)
        if not target.tls:
            return plain
        return ssl.create_default_context().wrap_socket(plain, server_hostname=target.host)
    except OSError as error:
        raise NoDaemonError(f"no page answers at {target} ({error})", hint="acquire web") from error
