"""The parts shared by both clients, without input or output: calls, answers and the stream of news.

::

    Client (blocking)  ─┐                           ┌─ a Unix socket: the daemon
                        ├─ ApiCall ▶ bytes ▶ answer ┤
    AsyncClient        ─┘                           └─ http(s)://host:port, with a token: `acquire web`
"""

from __future__ import annotations

import json
import os
import re
import secrets
import sys
from dataclasses import dataclass, field
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, ParamSpec, TypeVar, Unpack, get_type_hints
from urllib.parse import urlencode, urlsplit

from pydantic import BaseModel, ValidationError

from acquire.daemon.facts import News
from acquire.daemon.messages import (
    LONGEST_ID,
    ArmRequest,
    ErrorMessage,
    MarkRequest,
    StartRequest,
    Status,
)
from acquire.daemon.options import ArmOptions, StartOptions, one_by_one
from acquire.daemon.states import State
from acquire.daemon.who import HEADER, WHO
from acquire.errors import AcquireError, UsageError
from acquire.place import default_socket
from acquire.text import did_you_mean, own_words, shortened, shown

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator

CONNECT_TIMEOUT_S = 5.0
STATUS_TIMEOUT_S = 10.0
COMMAND_TIMEOUT_S = 30.0
"""Longest wait for the answer to a command while the daemon is not busy; while it is, the wait continues."""
MOST_BYTES = 2**24
"""Longest answer."""
MOST_LINE_BYTES = 2**20
"""Longest line of the stream of news."""
SILENT_S = 5.0
"""Silence after which a stream of news counts as broken."""
TOKEN_VARIABLE = "ACQUIRE_TOKEN"  # noqa: S105 - the name of a variable
API = "/api"
"""Prefix of the API in what `acquire web` serves; the daemon serves it without a prefix."""
BAD = 400
"""Lowest HTTP status that is an error."""

IF_ENDED = "acquire status, and acquire serve if the daemon has ended"
IF_SILENT = "acquire status, again in a moment; a host that is less busy, or the daemon started anew"
IF_FOREIGN = "acquire serve or acquire web of this version, if another program listens there"
"""What to try if the connection is lost, if no answer comes, and if the answer is none of the daemon's."""

# A line break in either of them would begin a header of its own.
_ID = re.compile(rf"[!-~]{{1,{LONGEST_ID}}}")
_TOKEN = re.compile(r"[ -~]+")

T = TypeVar("T", bound=BaseModel)
R = TypeVar("R", bound=BaseModel)
P = ParamSpec("P")
Answer = TypeVar("Answer")


def _fits(pattern: re.Pattern[str], value: object) -> bool:
    """Return whether a value is a text that a header can hold."""
    return isinstance(value, str) and pattern.fullmatch(value) is not None


@dataclass(frozen=True, slots=True)
class Target:
    """The peer of a call: a Unix socket, or a server with its token."""

    socket: Path | None = None
    host: str = "acquire"
    port: int = 0
    tls: bool = False
    token: str | None = field(default=None, repr=False)

    @classmethod
    def of(cls, place: Path | str | None, token: str | None = None) -> Target:
        """Return the target for a socket's path, a URL, or None for the default socket."""
        if not (place is None or isinstance(place, str | Path)):
            raise _no_address(shown(place))
        text = "" if place is None else str(place)
        if not text.startswith(("http://", "https://")):
            # Path would make "ftp:/..." of it: a file that nobody meant.
            if "://" in text:
                raise _no_address(text)
            return cls(socket=default_socket() if place is None else Path(place).absolute())
        try:
            parts = urlsplit(text)
            # As a connection will do, which passes on the UnicodeError of a name like "a..b".
            name = (parts.hostname or "").encode("idna")
            port = parts.port or (443 if parts.scheme == "https" else 80)
        except ValueError:
            raise _no_address(text) from None
        # A zero byte would end the name where C reads it.
        if not name or b"\0" in name or parts.path.strip("/") or parts.query:
            raise _no_address(text)
        tls = parts.scheme == "https"
        token = token or os.environ.get(TOKEN_VARIABLE)
        if token is not None and not _fits(_TOKEN, token):
            # It is a secret, and not shown.
            raise UsageError("the token is not text that a header can hold", hint="acquire web --link")
        return cls(None, str(parts.hostname), port, tls, token)

    def __str__(self) -> str:
        if self.socket is not None:
            return str(self.socket)
        return f"{'https' if self.tls else 'http'}://{self.host}:{self.port}"

    def path(self, below: str) -> str:
        """Return the path of a request: the page has the API below a prefix, the daemon's socket has not."""
        return f"/{below}" if self.socket is not None else f"{API}/{below}"

    def headers(self) -> dict[str, str]:
        """Return the headers of every request: the host name, which a page checks, and the token."""
        # The colons of an IPv6 address are kept apart from that of the port (RFC 3986).
        host = f"[{self.host}]" if ":" in self.host else self.host
        headers = {"Host": host if self.socket is not None else f"{host}:{self.port}"}
        return headers | ({"Authorization": f"Bearer {self.token}"} if self.token else {})


def _no_address(text: str) -> UsageError:
    return UsageError(
        f"{shortened(text)} is not a valid address", possible="http://HOST:PORT, or a socket's path"
    )


@dataclass(frozen=True, slots=True)
class ApiCall(Generic[T]):
    """One request, and the model of its answer."""

    method: str
    name: str
    answer: type[T]
    body: BaseModel | None = None
    timeout_s: float = COMMAND_TIMEOUT_S
    request_id: str | None = None

    @property
    def content(self) -> bytes | None:
        """Return the body of the request as JSON; None for a request without one."""
        if self.body is None:
            return None
        # Without what is left at its default: a daemon from before an upgrade need not know options that
        # nobody has used.
        return json.dumps(self.body.model_dump(mode="json", exclude_defaults=True)).encode()

    def headers(self, target: Target) -> dict[str, str]:
        # Each call has its own connection, of which the daemon keeps only a few open.
        headers = {"Connection": "close", **target.headers()}
        if who := WHO.get():
            headers[HEADER] = who
        if self.body is not None:
            headers["Content-Type"] = "application/json"
        if self.request_id is not None:
            headers["Request-Id"] = self.request_id
        return headers

    def read(self, status: int, content: bytes, target: Target) -> T:
        """Decode the answer. Raises the daemon's error, or AcquireError for an answer of another version."""
        try:
            if status < BAD:
                return self.answer.model_validate_json(content)
            raise ErrorMessage.model_validate_json(content).rebuild()
        except ValidationError as error:
            raise AcquireError(
                f"{self.name}: the daemon on {target} runs another version of this program (HTTP {status})"
            ) from error


def fact(name: str, answer: type[T]) -> ApiCall[T]:
    """Return a call for information, which the daemon answers at once."""
    return ApiCall("GET", name, answer, timeout_s=STATUS_TIMEOUT_S)


def command(
    name: str, answer: type[T], body: BaseModel | None = None, request_id: str | None = None
) -> ApiCall[T]:
    """Return a command; it gets a request id unless the caller has one, so that it can be sent again.

    Raises UsageError for an id that no header can hold.
    """
    if request_id is not None and not _fits(_ID, request_id):
        raise UsageError(
            f"{name}: request_id = {shown(request_id)} is not a request id",
            possible=f"1 to {LONGEST_ID} printable ASCII characters without spaces",
        )
    return ApiCall("POST", name, answer, body, request_id=request_id or secrets.token_hex(16))


def shows(options: type, model: type[BaseModel]) -> Callable[[Callable[P, Answer]], Callable[P, Answer]]:
    """Return a decorator that shows ``**options`` one by one, with defaults, to help() and completion."""
    kinds = get_type_hints(options, localns=vars(sys.modules[model.__module__]))
    each = [
        Parameter(name, Parameter.KEYWORD_ONLY, default=model.model_fields[name].default, annotation=kind)
        for name, kind in kinds.items()
    ]

    def decorate(method: Callable[P, Answer]) -> Callable[P, Answer]:
        # Type checkers see through `Unpack`; whoever asks a running program sees only ``**options``.
        method.__signature__ = one_by_one(signature(method), each)  # type: ignore[attr-defined]
        return method

    return decorate


def arm(request_id: str | None, **options: Unpack[ArmOptions]) -> ApiCall[Status]:
    """Return the command. Raises UsageError for options that are not valid."""
    return command("arm", Status, request("arm", ArmRequest, **options), request_id)


def start(
    path: Path | str | None, request_id: str | None, **options: Unpack[StartOptions]
) -> ApiCall[Status]:
    """Return the command; a relative ``path`` is relative to the caller's directory."""
    # The daemon has another working directory. Anything else than a path is refused by the model.
    absolute = Path(path).absolute() if isinstance(path, str | os.PathLike) else path
    return command("start", Status, request("start", StartRequest, path=absolute, **options), request_id)


def mark(text: str, request_id: str | None) -> ApiCall[Status]:
    """Return the command. Raises UsageError for a text that is not valid."""
    return command("mark", Status, request("mark", MarkRequest, text=text), request_id)


def request(command: str, model: type[R], **fields: Any) -> R:
    """Return the body of a command. Raises UsageError for invalid values, before anything is sent."""
    try:
        return model(**fields)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        if first["type"] == "extra_forbidden":
            known = model.model_fields
            raise UsageError(
                f"{command}: there is no option {where!r}{did_you_mean(where, known)}",
                possible=", ".join(known),
            ) from None
        # Fields that exclude each other have no place, and name themselves; what is missing has no value.
        value = "" if first["type"] == "missing" else f" = {shown(first['input'])}"
        words = own_words(first["msg"])
        # our own words about a field name it, with its value
        what = f"{where}{value}: " if where and not words.startswith(f"{where} ") else ""
        raise UsageError(shortened(f"{command}: {what}{words}", 1000)) from error


def states_of(states: Collection[State] | State) -> tuple[State, ...]:
    """Return the states to wait for. Raises UsageError if there are none, or for one that does not exist."""
    asked = (states,) if isinstance(states, str) else tuple(states)
    known = tuple(State)
    unknown = [state for state in asked if state not in known]
    if unknown or not asked:
        what = f"{shown(unknown[0])} is not a state" if unknown else "there is no state"
        raise UsageError(f"wait: {what} to wait for", possible=", ".join(known))
    return tuple(map(State, asked))


def events_path(target: Target, *, history: bool, status_s: float | None) -> str:
    """Return the path of the stream of news, with a status every ``status_s`` unless that is None."""
    query: dict[str, Any] = {"history": "true"} if history else {}
    if status_s is not None:
        query["status_s"] = status_s
    return target.path("events") + (f"?{urlencode(query)}" if query else "")


def events_headers(target: Target, last_id: str | None) -> dict[str, str]:
    """Return the headers of a request for the stream, continued after the news with the id ``last_id``."""
    headers = {"Accept": "text/event-stream", **target.headers()}
    return headers | ({"Last-Event-ID": last_id} if last_id else {})


class EventReader:
    """Decodes lines of the stream to `News` and `Status`, and keeps the id from which to continue.

    It outlives its connections: call `begin` for each, to discard the incomplete event of a broken one.
    """

    def __init__(self, last_id: str | None = None) -> None:
        """Begin after the news ``last_id``. Raises UsageError for what cannot be the id of news."""
        if last_id is not None and not _fits(_ID, last_id):
            raise UsageError(f"last_id = {shown(last_id)} is not the id of news", possible="`News.id`")
        self.last_id = last_id
        self.begin()

    def begin(self) -> None:
        """Start a connection; an event that was cut off by the end of the last one is sent again."""
        self._event = self._data = ""

    def take(self, line: str) -> Iterator[News | Status | None]:
        """Take the next line, without its end, and yield what it completes; None: no more for now."""
        name, _, value = line.partition(":")
        # By the standard of server-sent events, one space after the colon is no part of the value.
        value = value.removeprefix(" ")
        # By the same standard a comment. The daemon sends one as a sign of life when it has no news.
        if line.startswith(":"):
            yield None
        elif name == "event":
            self._event = value
        elif name == "data":
            # Data of several lines would have to be joined by line breaks; JSON comes in one.
            self._data += value
        elif not line and self._data:
            event, data = self._event, self._data
            self.begin()
            if event not in ("status", "news"):
                return  # an event of a later version
            item: News | Status
            try:
                item = (Status if event == "status" else News).model_validate_json(data)
            except ValidationError as error:
                raise AcquireError(
                    "the daemon runs another version of this program: its news cannot be read"
                ) from error
            # Only now: an event that could not be decoded is not counted as received.
            if isinstance(item, News):
                self.last_id = item.id
            yield item
