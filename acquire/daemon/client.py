"""The daemon seen from a script or the command line. Errors of the daemon arrive as their own classes.

::

    with Client(Path("/run/user/1000/acquire.sock")) as daemon:
        daemon.arm()
        daemon.start(lines=100_000)
        daemon.wait({State.IDLE}, timeout_s=60)
"""

from __future__ import annotations

import socket
import time
from typing import TYPE_CHECKING, Any, Self

import httpx
from pydantic import ValidationError

from acquire.daemon.messages import ArmRequest, ErrorMessage, StartRequest, Status
from acquire.daemon.states import State
from acquire.errors import AcquireError, NoDaemonError, StateError, UsageError

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

CONNECT_TIMEOUT_S = 2.0
STATUS_TIMEOUT_S = 5.0
COMMAND_TIMEOUT_S = 120.0
"""Above the sum of what the daemon allows itself for the slowest command and one before it in the queue."""
POLL_S = 0.1


class Client:
    """One daemon, by its socket. Every call is bounded in time.

    Raises NoDaemonError where nobody answers, and whatever the daemon refuses with.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._http = httpx.Client(
            transport=httpx.HTTPTransport(uds=str(path)), base_url="http://acquire", trust_env=False
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._http.close()

    def status(self) -> Status:
        """What the daemon is doing; answered at once, whatever it is busy with."""
        return self._call("GET", "status", STATUS_TIMEOUT_S)

    def arm(self, *, force: bool = False) -> Status:
        """idle → armed: cameras and trigger run, nothing is written. ``force``: however slow the host."""
        return self._call("POST", "arm", body=ArmRequest(force=force).model_dump())

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
        try:
            request = StartRequest(
                path=None if path is None else path.absolute(),
                lines=lines,
                duration_s=duration_s,
                pre_s=pre_s,
                post_s=post_s,
                resume=resume,
            )
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            raise UsageError(f"start: {where} {first['msg']}".replace("  ", " ")) from error
        return self._call("POST", "start", body=request.model_dump(mode="json"))

    def mark(self, text: str = "") -> Status:
        """An event at the newest line; it starts a recording where the rig's ``[events]`` say so."""
        return self._call("POST", "mark", body={"text": text})

    def stop(self) -> Status:
        """recording → idle: returns once the recording is sealed."""
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
                raise StateError(f"still {status.state} after waiting {timeout_s:g} s for {wanted}")
            time.sleep(POLL_S)
        return status

    def _call(
        self, method: str, command: str, timeout_s: float = COMMAND_TIMEOUT_S, body: Any = None
    ) -> Status:
        timeout = httpx.Timeout(timeout_s, connect=CONNECT_TIMEOUT_S)
        self._knock()
        try:
            response = self._http.request(method, f"/{command}", json=body, timeout=timeout)
        except httpx.TimeoutException as error:
            raise NoDaemonError(
                f"the daemon on {self.path} gave no answer to {command} within {timeout_s:g} s"
            ) from error
        except httpx.TransportError as error:
            raise NoDaemonError(f"the daemon on {self.path} went away during {command}") from error
        return self._read(response, command)

    def _read(self, response: httpx.Response, command: str) -> Status:
        try:
            if response.is_success:
                return Status.model_validate_json(response.content)
            raise ErrorMessage.model_validate_json(response.content).rebuild()
        except ValidationError as error:
            raise AcquireError(
                f"{command}: the daemon on {self.path} speaks another version of this program"
                f" (HTTP {response.status_code})"
            ) from error

    def _knock(self) -> None:
        """Raise NoDaemonError with the system's reason where nobody listens (httpx leaks the socket then)."""
        with socket.socket(socket.AF_UNIX) as knock:
            knock.settimeout(CONNECT_TIMEOUT_S)
            try:
                knock.connect(str(self.path))
            except OSError as error:
                raise NoDaemonError(
                    f"no daemon listens on {self.path} ({error.strerror or error})",
                    hint=f"acquire serve --config rig-demo --socket {self.path}",
                ) from error
