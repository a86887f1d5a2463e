"""The daemon seen from a script or the command line. Errors of the daemon arrive as their own classes.

::

    with Client(Path("/run/user/1000/acquire.sock")) as daemon:
        daemon.arm()
        daemon.start(lines=100_000)
        daemon.wait(SEALED, timeout_s=60)
"""

from __future__ import annotations

import http.client
import json
import select
import time
from typing import TYPE_CHECKING, Any, Self, TypeVar

from pydantic import BaseModel, ValidationError

from acquire.daemon.messages import ArmRequest, ErrorMessage, MarkRequest, StartRequest, Status
from acquire.daemon.peer import connect
from acquire.daemon.starting import is_one_starting
from acquire.daemon.states import State
from acquire.errors import AcquireError, NoDaemonError, StateError, UsageError
from acquire.text import shortened

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Collection
    from pathlib import Path

CONNECT_TIMEOUT_S = 5.0
STATUS_TIMEOUT_S = 10.0
COMMAND_TIMEOUT_S = 30.0
"""For the answer to a command when the daemon says that it does nothing; while it works, it is waited for."""
STARTING_TIMEOUT_S = 60.0
"""For the socket of a daemon that is starting."""
PROGRESS_S = 0.5
POLL_S = 0.1
MOST_BYTES = 2**24
"""Of an answer."""

R = TypeVar("R", bound=BaseModel)


class Client:
    """One daemon, by its socket. Every call is bounded in time.

    Raises NoDaemonError where nobody answers, and whatever the daemon refuses with.
    """

    def __init__(self, path: Path, tell: Callable[[str], object] = lambda _: None) -> None:
        """``tell`` is called now and then with what is being waited for."""
        self.path = path
        self._tell = tell

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """A call has its own connection: nothing is left to be closed."""

    def status(self) -> Status:
        """What the daemon is doing; answered at once, whatever it is busy with."""
        return self._call("GET", "status", STATUS_TIMEOUT_S)

    def arm(self, *, force: bool = False) -> Status:
        """idle → armed: cameras and trigger run, nothing is written. ``force``: however slow the host."""
        return self._call("POST", "arm", body=ArmRequest(force=force))

    def start(
        self,
        path: Path | None = None,
        *,
        lines: int | None = None,
        duration_s: float | None = None,
        pre_s: float = 0.0,
        post_s: float | None = None,
        resume: bool = False,
    ) -> Status:
        """armed → recording. A relative ``path`` is meant from the caller's directory.

        ``pre_s`` of the recording are from before the request, as far as the ring holds them; ``post_s`` is
        another way to say how long it is to go on. With ``resume``, ``path`` is a sealed recording that goes
        on in a segment beside it.
        """
        request = _request(
            "start",
            StartRequest,
            path=None if path is None else path.absolute(),
            lines=lines,
            duration_s=duration_s,
            pre_s=pre_s,
            post_s=post_s,
            resume=resume,
        )
        return self._call("POST", "start", body=request)

    def mark(self, text: str = "") -> Status:
        """An event at the newest line; it starts a recording where the rig's ``[events]`` say so."""
        return self._call("POST", "mark", body=_request("mark", MarkRequest, text=text))

    def stop(self) -> Status:
        """recording → armed: returns once the recording is sealed."""
        return self._call("POST", "stop")

    def disarm(self) -> Status:
        """armed → idle, or clears a fault."""
        return self._call("POST", "disarm")

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
                    f"still {status.state} after waiting {timeout_s:g} s for {wanted}",
                    hint="acquire disarm, or wait for sealed: a recording's end leaves the instrument armed"
                    if staying
                    else "",
                )
            time.sleep(POLL_S)
        return status

    def _call(
        self, method: str, command: str, timeout_s: float = COMMAND_TIMEOUT_S, body: BaseModel | None = None
    ) -> Status:
        with self._connect() as connection:
            connection.settimeout(timeout_s)
            http_connection = http.client.HTTPConnection("acquire")
            http_connection.sock = connection
            headers = {"Connection": "close"} | ({"Content-Type": "application/json"} if body else {})
            text = None if body is None else json.dumps(body.model_dump(mode="json"))
            try:
                http_connection.request(method, f"/{command}", text, headers)
                if method == "POST":
                    self._await_answer(connection, timeout_s)
                response = http_connection.getresponse()
                return self._read(response.status, response.read(MOST_BYTES), command)
            except TimeoutError as error:
                raise NoDaemonError(
                    f"the daemon on {self.path} gave no answer to {command} within {timeout_s:g} s"
                ) from error
            except (OSError, http.client.HTTPException) as error:
                raise NoDaemonError(f"the daemon on {self.path} went away during {command}") from error
            finally:
                http_connection.close()

    def _connect(self) -> socket.socket:
        """To the daemon, or to one that is only starting, once it listens."""
        deadline = time.monotonic() + STARTING_TIMEOUT_S
        while True:
            try:
                return connect(self.path, CONNECT_TIMEOUT_S)
            except NoDaemonError:
                if time.monotonic() > deadline or not is_one_starting(self.path):
                    raise
            self._tell(f"waiting for a daemon on {self.path}: one is starting")
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

    def _read(self, status: int, content: bytes, command: str) -> Status:
        try:
            if status < http.client.BAD_REQUEST:
                return Status.model_validate_json(content)
            raise ErrorMessage.model_validate_json(content).rebuild()
        except ValidationError as error:
            raise AcquireError(
                f"{command}: the daemon on {self.path} speaks another version of this program (HTTP {status})"
            ) from error


def _request(command: str, model: type[R], **fields: Any) -> R:
    """What a command asks for; refused here already where it is impossible as asked."""
    try:
        return model(**fields)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        why = first["msg"].removeprefix("Value error, ")
        raise UsageError(shortened(f"{command}: {where} {why}".replace("  ", " "), 1000)) from error
