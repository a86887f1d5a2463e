"""The instrument seen from a script, call by call: see `acquire.client`."""

from __future__ import annotations

import contextlib
import http.client
import select
import socket
import ssl
import time
from typing import TYPE_CHECKING, Literal, Self, TypeVar

from pydantic import BaseModel

from acquire.client import core
from acquire.client.core import Call, EventReader, Target
from acquire.daemon.facts import Health, News, Reloaded, Rings, Setup, Version
from acquire.daemon.messages import CapacityStatus, LightCode, Status, TriggerDelays, TriggerWindow
from acquire.daemon.peer import connect
from acquire.daemon.starting import is_one_starting
from acquire.daemon.states import State
from acquire.errors import NoDaemonError, StateError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator
    from pathlib import Path

    from acquire.store import Recording

STARTING_TIMEOUT_S = 60.0
"""For the socket of a daemon that is starting."""
PROGRESS_S = 0.5
POLL_S = 0.1
PATIENCE_S = 30.0
"""For a daemon whose stream of news has broken, before that is an error."""

T = TypeVar("T", bound=BaseModel)


class Client:
    """One daemon, by its socket or by the address of its page. Every call is bounded in time.

    A call has a connection of its own, and any thread may make one. A command whose connection breaks is sent
    once more with the same request id, so that it is carried out once. Raises NoDaemonError where nobody
    answers, and whatever the daemon refuses with, as the same class.
    """

    def __init__(
        self,
        place: Path | str | None = None,
        tell: Callable[[str], object] = lambda _: None,
        *,
        token: str | None = None,
    ) -> None:
        """``place``: the socket's path, the default one, or http://HOST:PORT with its ``token``
        (or ACQUIRE_TOKEN). ``tell`` is called now and then with what is being waited for.
        """
        self._target = Target.of(place, token)
        self._tell = tell

    @property
    def path(self) -> Path | None:
        """Of the socket; None where the daemon is asked by its page."""
        return self._target.socket

    def __repr__(self) -> str:
        return f"Client({str(self._target)!r})"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """A call has its own connection: nothing is left to be closed."""

    # ---- commands

    def arm(
        self,
        *,
        force: bool = False,
        code: LightCode = "rig",
        calibration: Literal["rig", "none"] = "rig",
        delays: TriggerDelays | None = None,
        window: TriggerWindow | None = None,
        request_id: str | None = None,
    ) -> Status:
        """idle → armed: cameras and trigger run, nothing is written. ``force``: however slow the host.

        ``code``: what the light follows; ``"dark"`` is off and ``"steady"`` on, as calibration needs it.
        ``calibration="none"``: recordings get no copy of the one that the rig names. ``delays``: of light and
        cameras, ``window``: of the light in each lit sub-step, both in place of the rig's.
        """
        trigger = {"delays": delays, "window": window}
        how = {"force": force, "code": code, "calibration": calibration, **trigger}
        return self._do(core.arm(request_id=request_id, **how))

    def start(
        self,
        path: Path | str | None = None,
        *,
        lines: int | None = None,
        duration_s: float | None = None,
        pre_s: float = 0.0,
        post_s: float | None = None,
        resume: bool = False,
        request_id: str | None = None,
    ) -> Status:
        """armed → recording. A relative ``path`` is meant from the caller's directory.

        ``pre_s`` of the recording are from before the request, as far as the ring holds them; ``post_s`` is
        another way to say how long it is to go on. With ``resume``, ``path`` is a sealed recording that goes
        on in a segment beside it.
        """
        budget = {
            "lines": lines,
            "duration_s": duration_s,
            "pre_s": pre_s,
            "post_s": post_s,
            "resume": resume,
        }
        return self._do(core.start(path, request_id, **budget))

    def mark(self, text: str = "", *, request_id: str | None = None) -> Status:
        """An event at the newest line; it starts a recording where the rig's ``[events]`` say so."""
        return self._do(core.mark(text, request_id))

    def stop(self, *, request_id: str | None = None) -> Status:
        """recording → armed: returns once the recording is sealed."""
        return self._do(core.command("stop", Status, request_id=request_id))

    def disarm(self, *, request_id: str | None = None) -> Status:
        """armed → idle, or clears a fault."""
        return self._do(core.command("disarm", Status, request_id=request_id))

    def measure(self) -> CapacityStatus:
        """What ring, codec and disk sustain here, measured now; only while idle."""
        return self._do(core.command("capacity", CapacityStatus))

    def reload(self) -> Reloaded:
        """Have the daemon read its rig file anew; refused as a whole where a key cannot change meanwhile."""
        return self._do(core.command("reload", Reloaded))

    # ---- facts

    def status(self) -> Status:
        """What the daemon is doing; answered at once, whatever it is busy with."""
        return self._do(core.fact("status", Status))

    def health(self) -> Health:
        """Is all well? One word, one sentence, and what they follow from."""
        return self._do(core.fact("health", Health))

    def version(self) -> Version:
        """Who answers."""
        return self._do(core.fact("version", Version))

    def setup(self) -> Setup:
        """The resolved configuration, and where it is not the default."""
        return self._do(core.fact("setup", Setup))

    def rings(self) -> Rings:
        """The memory through which the lines pass, for `acquire.stream.peek` on the same host."""
        return self._do(core.fact("rings", Rings))

    def open(self, path: Path | str | None = None) -> Recording:
        """A recording, on this host: the one at ``path``, the one being written, or the latest.

        Raises StateError where there is none.
        """
        from acquire.store import open_recording

        if path is None:
            status = self.status()
            latest = status.recording or status.last
            if latest is None:
                raise StateError("nothing has been recorded since the daemon began", hint="client.start()")
            path = latest.path
        return open_recording(path)

    def wait(self, states: Collection[State], timeout_s: float) -> Status:
        """The status once the daemon is in one of ``states``.

        Raises StateError when the time is up, and at once when a fault keeps the daemon from getting there.
        """
        deadline = time.monotonic() + timeout_s
        while (status := self.status()).state not in states:
            wanted = " or ".join(states)
            if status.state is State.FAULTED:
                raise StateError(
                    f"waiting for {wanted}, but the daemon is faulted: {status.fault}", hint="acquire disarm"
                )
            if time.monotonic() >= deadline:
                staying = status.state is State.ARMED and State.IDLE in states
                raise StateError(
                    f"the daemon is still {status.state} after {timeout_s:g} s of waiting for {wanted}",
                    hint="acquire disarm, or wait for sealed: a recording's end leaves the instrument armed"
                    if staying
                    else "",
                )
            time.sleep(POLL_S)
        return status

    # ---- news

    def events(
        self, last_id: str | None = None, *, history: bool = False, timeout_s: float | None = None
    ) -> Iterator[News]:
        """What happens, as it happens; ends ``timeout_s`` after the daemon has told what it knows, or never.

        Begins after the news ``last_id``, with all that is known (``history``), or with what comes; however
        slow the host, that is told whole. It ends with the next sign of life, which comes each second. A
        connection that breaks is made again, and what happened meanwhile comes first. Raises NoDaemonError
        where the daemon is gone for longer than `PATIENCE_S`.
        """
        reader = EventReader(last_id)
        end_s: float | None = None
        lost_s: float | None = None
        while end_s is None or time.monotonic() < end_s:
            try:
                for one in self._follow(reader, history=history):
                    lost_s = None
                    if isinstance(one, News):
                        yield one
                    elif end_s is None and timeout_s is not None:
                        end_s = time.monotonic() + timeout_s
                    if end_s is not None and time.monotonic() >= end_s:
                        return
            except NoDaemonError:
                lost_s = lost_s or time.monotonic()
                if time.monotonic() - lost_s > PATIENCE_S:
                    raise
                time.sleep(POLL_S)

    def _follow(self, reader: EventReader, *, history: bool) -> Iterator[News | Status | None]:
        """One connection's worth of news. Raises NoDaemonError when it breaks."""
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
                while line := response.readline(core.MOST_LINE_BYTES):
                    yield from reader.take(line.decode().rstrip("\r\n"))
            except (OSError, http.client.HTTPException) as error:
                raise NoDaemonError(f"the daemon on {self._target} went away while it told news") from error
        raise NoDaemonError(f"the daemon on {self._target} has ended")

    # ---- the way there

    def _do(self, call: Call[T]) -> T:
        try:
            return self._once(call)
        except _BrokenError:
            if call.request_id is None:
                raise
        # Once more, under the same id: if the first one arrived, this gets its answer and nothing is done
        # twice. A third would only keep a caller waiting whose daemon is gone.
        return self._once(call)

    def _once(self, call: Call[T]) -> T:
        with self._connection(call.timeout_s) as connection:
            try:
                path = self._target.path(call.name)
                connection.request(call.method, path, call.content, call.headers(self._target))
                # No fixed time is right for a command, since arming may take a minute: the daemon is asked.
                if call.method == "POST" and connection.sock is not None:
                    self._await_answer(connection.sock, call.timeout_s)
                response = connection.getresponse()
                return call.read(response.status, _content(response), self._target)
            except TimeoutError as error:
                raise NoDaemonError(
                    f"the daemon on {self._target} gave no answer to {call.name} within {call.timeout_s:g} s"
                ) from error
            except (OSError, http.client.HTTPException) as error:
                raise _BrokenError(f"the daemon on {self._target} went away during {call.name}") from error

    @contextlib.contextmanager
    def _connection(self, timeout_s: float) -> Iterator[http.client.HTTPConnection]:
        connection = http.client.HTTPConnection("acquire")
        connection.sock = self._connect()
        connection.sock.settimeout(timeout_s)
        try:
            yield connection
        finally:
            connection.close()

    def _connect(self) -> socket.socket:
        """To the daemon, or to one that is only starting, once it listens."""
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
                if not is_one_starting(path):  # or it listens by now, and does not start any more
                    return connect(path, core.CONNECT_TIMEOUT_S)
            self._tell(f"waiting for a daemon on {path}: one is starting")
            time.sleep(POLL_S)

    def _await_answer(self, connection: socket.socket, timeout_s: float) -> None:
        """As long as the daemon is at work; TimeoutError when it has nothing under way for so long."""
        answered = select.poll()
        answered.register(connection, select.POLLIN)
        deadline = time.monotonic() + timeout_s
        while not answered.poll(PROGRESS_S * 1000):
            try:
                status = self.status()
            except NoDaemonError:
                return  # it has gone, or hangs: so says the connection
            if status.busy is not None or status.state is State.DRAINING:
                self._tell(status.busy or str(status.state))
                deadline = time.monotonic() + timeout_s
            elif time.monotonic() > deadline:
                raise TimeoutError


class _BrokenError(NoDaemonError):
    """The connection broke after the request was sent: whether it was carried out is not known."""


def _content(response: http.client.HTTPResponse) -> bytes:
    """All of it. Raises IncompleteRead where it broke off, which a bounded read hides."""
    content = response.read(core.MOST_BYTES)
    if response.length:
        raise http.client.IncompleteRead(content, response.length)
    return content


def connect_to_page(target: Target) -> socket.socket:
    """Raises NoDaemonError where no page is served there, or its certificate is not believed."""
    try:
        plain = socket.create_connection((target.host, target.port), core.CONNECT_TIMEOUT_S)
        if not target.tls:
            return plain
        return ssl.create_default_context().wrap_socket(plain, server_hostname=target.host)
    except OSError as error:
        raise NoDaemonError(f"nobody answers on {target} ({error})", hint="acquire web") from error
