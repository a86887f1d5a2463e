"""What both clients have in common, without a byte of input or output: calls, answers, the stream of news.

::

    Client (blocking)  ─┐                        ┌─ a Unix socket: the daemon
                        ├─ Call ▶ bytes ▶ answer ┤
    AsyncClient        ─┘                        └─ http(s)://host:port, with a token: `acquire web`
"""

from __future__ import annotations

import json
import os
import secrets
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar
from urllib.parse import urlencode, urlsplit

from pydantic import BaseModel, ValidationError

from acquire.daemon.facts import News
from acquire.daemon.messages import (
    ArmRequest,
    ErrorMessage,
    MarkRequest,
    StartRequest,
    Status,
)
from acquire.daemon.who import HEADER, WHO
from acquire.errors import AcquireError, UsageError
from acquire.place import default_socket
from acquire.text import shortened

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

CONNECT_TIMEOUT_S = 5.0
STATUS_TIMEOUT_S = 10.0
COMMAND_TIMEOUT_S = 30.0
"""For the answer to a command when the daemon says that it does nothing; while it works, it is waited for."""
MOST_BYTES = 2**24
"""Of an answer."""
MOST_LINE_BYTES = 2**20
"""Of a line of the stream of news."""
SILENT_S = 5.0
"""A stream of news without a sign of life for so long has broken."""
TOKEN_VARIABLE = "ACQUIRE_TOKEN"  # noqa: S105 - the name of a variable
API = "/api"
"""Where the API lies in what `acquire web` serves; the daemon serves nothing else."""
BAD = 400
"""The first HTTP status that is an error."""

T = TypeVar("T", bound=BaseModel)
R = TypeVar("R", bound=BaseModel)


@dataclass(frozen=True, slots=True)
class Target:
    """Who is asked: a Unix socket, or a server with its token."""

    socket: Path | None = None
    host: str = "acquire"
    port: int = 0
    tls: bool = False
    token: str | None = field(default=None, repr=False)

    @classmethod
    def of(cls, place: Path | str | None, token: str | None = None) -> Target:
        """``place``: a socket's path, a URL, or None for the default socket."""
        text = "" if place is None else str(place)
        if not text.startswith(("http://", "https://")):
            return cls(socket=default_socket() if place is None else Path(place).absolute())
        parts = urlsplit(text)
        try:
            port = parts.port or (443 if parts.scheme == "https" else 80)
        except ValueError:
            port = 0
        if not (parts.hostname and port) or parts.path.strip("/") or parts.query:
            raise UsageError(
                f"{text} is no address of acquire", possible="http://HOST:PORT, or a socket's path"
            )
        tls = parts.scheme == "https"
        token = token or os.environ.get(TOKEN_VARIABLE)
        return cls(None, parts.hostname, port, tls, token)

    def __str__(self) -> str:
        if self.socket is not None:
            return str(self.socket)
        return f"{'https' if self.tls else 'http'}://{self.host}:{self.port}"

    def path(self, below: str) -> str:
        return f"/{below}" if self.socket is not None else f"{API}/{below}"

    def headers(self) -> dict[str, str]:
        """With the name that it is asked for by, which a page insists on."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        named = {"Host": host if self.socket is not None else f"{host}:{self.port}"}
        return named | ({"Authorization": f"Bearer {self.token}"} if self.token else {})


@dataclass(frozen=True, slots=True)
class Call(Generic[T]):
    """One request, and what its answer is."""

    method: str
    name: str
    answer: type[T]
    body: BaseModel | None = None
    timeout_s: float = COMMAND_TIMEOUT_S
    request_id: str | None = None

    @property
    def content(self) -> bytes | None:
        return None if self.body is None else json.dumps(self.body.model_dump(mode="json")).encode()

    def headers(self, target: Target) -> dict[str, str]:
        headers = {"Connection": "close", **target.headers()}
        if who := WHO.get():
            headers[HEADER] = who
        if self.body is not None:
            headers["Content-Type"] = "application/json"
        if self.request_id is not None:
            headers["Request-Id"] = self.request_id
        return headers

    def read(self, status: int, content: bytes, target: Target) -> T:
        """The answer. Raises the error that it is, or AcquireError for what this version does not know."""
        try:
            if status < BAD:
                return self.answer.model_validate_json(content)
            raise ErrorMessage.model_validate_json(content).rebuild()
        except ValidationError as error:
            raise AcquireError(
                f"{self.name}: the daemon on {target} speaks another version of this program (HTTP {status})"
            ) from error


def fact(name: str, answer: type[T]) -> Call[T]:
    """A question that is answered at once."""
    return Call("GET", name, answer, timeout_s=STATUS_TIMEOUT_S)


def command(
    name: str, answer: type[T], body: BaseModel | None = None, request_id: str | None = None
) -> Call[T]:
    """A command; without an id of the caller's it gets one, so that it can be sent again."""
    return Call("POST", name, answer, body, request_id=request_id or secrets.token_hex(16))


def arm(*, request_id: str | None, **how: Any) -> Call[Status]:
    return command("arm", Status, request("arm", ArmRequest, **how), request_id)


def start(path: Path | str | None, request_id: str | None, **budget: Any) -> Call[Status]:
    """A relative ``path`` is meant from the caller's directory."""
    absolute = None if path is None else Path(path).absolute()
    return command("start", Status, request("start", StartRequest, path=absolute, **budget), request_id)


def mark(text: str, request_id: str | None) -> Call[Status]:
    return command("mark", Status, request("mark", MarkRequest, text=text), request_id)


def request(command: str, model: type[R], **fields: Any) -> R:
    """What a command asks for; refused here already where it is impossible as asked."""
    try:
        return model(**fields)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        why = first["msg"].removeprefix("Value error, ")
        raise UsageError(shortened(f"{command}: {where} {why}".replace("  ", " "), 1000)) from error


def events_path(target: Target, *, history: bool, status_s: float | None) -> str:
    query: dict[str, Any] = {"history": "true"} if history else {}
    if status_s is not None:
        query["status_s"] = status_s
    return target.path("events") + (f"?{urlencode(query)}" if query else "")


def events_headers(target: Target, last_id: str | None) -> dict[str, str]:
    headers = {"Accept": "text/event-stream", **target.headers()}
    return headers | ({"Last-Event-ID": last_id} if last_id else {})


class EventReader:
    """Lines of the stream in, `News` and `Status` out; keeps the id to go on with.

    It outlives the connection: `begin` each one, so that what the last broke off in is not read on with.
    """

    def __init__(self, last_id: str | None = None) -> None:
        self.last_id = last_id
        self.begin()

    def begin(self) -> None:
        """A connection begins: half an event that an earlier one ended with is told again, whole."""
        self._event = self._data = ""

    def take(self, line: str) -> Iterator[News | Status | None]:
        """The next line, without its end; what is complete with it. None: nothing more to tell for now."""
        name, _, value = line.partition(":")
        value = value.removeprefix(" ")
        if line.startswith(":"):
            yield None
        elif name == "event":
            self._event = value
        elif name == "data":
            self._data += value
        elif not line and self._data:
            event, data = self._event, self._data
            self.begin()
            yield from self._told(event, data)

    def _told(self, event: str, data: str) -> Iterable[News | Status]:
        try:
            if event == "status":
                return [Status.model_validate_json(data)]
            if event != "news":
                return []  # of a later version
            news = News.model_validate_json(data)
        except ValidationError as error:
            raise AcquireError("the daemon tells news as another version of this program does") from error
        self.last_id = news.id
        return [news]
