"""Every request passes here first: asked by the right name, by our own page, by somebody who has the token.

::

    Host        a name that is ours: a page elsewhere that points its own name at us is refused (rebinding)
    Origin      of what changes something: our own, or none (a script)
    token       Authorization: Bearer …, or the cookie that it was exchanged for; the page's files need none
    role        a viewer changes nothing
    rate        wrong tokens and requests per address, each in a bucket of tokens

What is refused is told as JSON, and logged without the token.
"""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING

from starlette.requests import Request
from starlette.responses import JSONResponse

from acquire.daemon.messages import error_body
from acquire.daemon.who import LONGEST, WHO
from acquire.errors import UsageError
from acquire.text import shortened
from acquire.web.tokens import COOKIE, Role, Tokens

if TYPE_CHECKING:
    from collections.abc import Callable

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

API = "/api/"
OPEN = ("/api/session", "/api/healthz")
"""Answered without a token: one takes it, the other tells a supervisor no more than that all is well."""
SAFE = ("GET", "HEAD", "OPTIONS")
REQUESTS = (240.0, 30.0)
"""At once, and per second, of one address without a token: ten new tabs ask for twenty files each."""
ADMITTED = (600.0, 60.0)
"""The same with one: strangers behind the same address cannot use it up."""
WRONG_TOKENS = (5.0, 0.2)
"""Wrong tokens of one address at once, and per second."""
MOST_ADDRESSES = 1024

HEADERS = (
    (
        b"content-security-policy",
        b"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
        b"connect-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'",
    ),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
)

log = logging.getLogger("acquire.web")


@dataclass(slots=True)
class _Bucket:
    left: float
    filled_s: float


class Buckets:
    """So many at once and per second for each key; the key that was quiet for longest is forgotten first."""

    def __init__(self, most: float, per_s: float, now_s: Callable[[], float] = time.monotonic) -> None:
        self._most, self._per_s, self._now_s = most, per_s, now_s
        self._buckets: OrderedDict[str, _Bucket] = OrderedDict()

    def has_room(self, key: str) -> bool:
        return self._filled(key).left >= 1

    def take(self, key: str) -> bool:
        """One more; False where it is one too many."""
        bucket = self._filled(key)
        if bucket.left < 1:
            return False
        bucket.left -= 1
        return True

    def _filled(self, key: str) -> _Bucket:
        now_s = self._now_s()
        bucket = self._buckets.pop(key, None) or _Bucket(self._most, now_s)
        bucket.left = min(self._most, bucket.left + self._per_s * (now_s - bucket.filled_s))
        bucket.filled_s = now_s
        self._buckets[key] = bucket
        while len(self._buckets) > MOST_ADDRESSES:
            self._buckets.popitem(last=False)
        return bucket


class Guard:
    """Middleware. See the module."""

    def __init__(self, app: ASGIApp, tokens: Tokens, names: frozenset[str]) -> None:
        """``names``: hosts by which we may be asked for, lower case, without a port."""
        self._app = app
        self._tokens = tokens
        self._names = names
        self._requests = Buckets(*REQUESTS)
        self._admitted = Buckets(*ADMITTED)
        self._wrong = Buckets(*WRONG_TOKENS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":  # the beginning and end of its life
            await self._app(scope, receive, send)
            return

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *HEADERS]
            await send(message)

        request = Request(scope)
        refusal = self._refusal(request)
        await (refusal or self._app)(scope, receive, answer)

    def _refusal(self, request: Request) -> JSONResponse | None:
        address = request.client.host if request.client else ""
        if _host_of(request.headers.get("host", "")) not in self._names:
            return _refuse(421, f"this is not {shortened(request.headers.get('host', ''))}", "web.names")
        # A bucket of its own for those with a token: strangers behind the same proxy cannot lock them out.
        asked = self._requests if self.role_of(request) is None else self._admitted
        if not asked.take(address):
            return _refuse(429, "too many requests", "a second")
        if not request.url.path.startswith(API):
            return None
        if request.method not in SAFE and not _is_ours(request):
            return _refuse(403, "this request comes from a page that is not ours")
        if request.url.path in OPEN:
            return None
        return self._refusal_of_role(request, address)

    def _refusal_of_role(self, request: Request, address: str) -> JSONResponse | None:
        if not self._wrong.has_room(address):
            return _refuse(429, "too many wrong tokens", "some seconds")
        role = self.role_of(request)
        if role is None:
            # Only what was tried counts as a guess: a page whose cookie has expired asks on its own.
            if "authorization" in request.headers:
                self.note_wrong(address)
            return _refuse(401, "the token is missing or wrong", "acquire web --link")
        if role != "operator" and request.method not in SAFE:
            return _refuse(403, "this token is for looking only", "the operator's: acquire web --link")
        WHO.set(f"{role} at {address}"[:LONGEST])
        return None

    def role_of(self, request: Request) -> Role | None:
        """By the token, else by the cookie."""
        scheme, _, token = request.headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            return self._tokens.role_of_token(token.strip())
        return self._tokens.role_of_cookie(request.cookies.get(COOKIE, ""))

    def role_of_token(self, token: str, address: str) -> Role | None:
        """For the exchange. None as well where the address has tried too many."""
        if not self._wrong.has_room(address):
            return None
        role = self._tokens.role_of_token(token)
        if role is None:
            self.note_wrong(address)
        return role

    def note_wrong(self, address: str) -> None:
        self._wrong.take(address)
        log.warning("a wrong token from %s", address)


def _host_of(header: str) -> str:
    """Of a Host header: without port, lower case; of [::1]:8300 the address."""
    text = header.strip().lower()
    if text.startswith("["):
        return text[1:].partition("]")[0]
    return text.rpartition(":")[0] if text.count(":") == 1 else text


def _is_ours(request: Request) -> bool:
    """What a browser says of the page that sends this; a script says nothing."""
    # Two witnesses: browsers that do not send the first yet send the second with all that changes something.
    site = request.headers.get("sec-fetch-site", "same-origin")
    origin = request.headers.get("origin")
    same = origin is None or origin.partition("://")[2].lower() == request.headers.get("host", "").lower()
    return same and site in ("same-origin", "none")


def _refuse(status: int, text: str, hint: str = "") -> JSONResponse:
    return JSONResponse(error_body(UsageError(text, hint=hint)), status)
