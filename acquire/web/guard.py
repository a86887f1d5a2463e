"""Checks that every request must pass: host name, origin, token, role and rate.

::

    Host        one of the page's names: another site that resolves to this host is refused (DNS rebinding)
    Origin      of requests that change something: the page itself, or none (a script)
    token       Authorization: Bearer …, or the cookie that it was exchanged for; the page's files need none
    role        a viewer cannot change anything
    rate        wrong tokens and requests per address, each limited by a token bucket

Refusals are answered in JSON; wrong tokens are logged, without the token itself.
"""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING

from starlette.requests import Request
from starlette.responses import JSONResponse

from acquire.daemon.messages import RETRY, error_body
from acquire.daemon.who import LONGEST, WHO
from acquire.errors import UsageError
from acquire.text import shortened
from acquire.web.tokens import COOKIE, Role, TokenFile, Tokens

if TYPE_CHECKING:
    from collections.abc import Callable

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

API = "/api/"
OPEN = ("/api/session", "/api/healthz")
"""Paths that need no token: one receives it, the other only tells a supervisor that all is well."""
SAFE = ("GET", "HEAD", "OPTIONS")
REQUESTS = (240.0, 30.0)
"""Burst and rate per second of requests from one address without a token. A new tab loads twenty files."""
ADMITTED = (600.0, 60.0)
"""The same with a token, in a separate bucket: strangers behind the same address cannot exhaust it."""
WRONG_TOKENS = (5.0, 0.2)
"""Burst and rate per second of wrong tokens from one address."""
# With IPv6 one host has as many addresses as it likes, which must not fill the memory.
MOST_ADDRESSES = 1024

HEADERS = (
    # Should foreign text, such as a mark's or a recording's name, become part of the page after all, it can
    # neither run a script nor send anything to another host.
    (
        b"content-security-policy",
        b"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
        b"connect-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'",
    ),
    # A recording's bytes are not taken for a script, whatever they look like.
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
    """Token buckets by key, with a burst and a rate; the key that was idle for longest is dropped first."""

    def __init__(self, most: float, per_s: float, now_s: Callable[[], float] = time.monotonic) -> None:
        self._most, self._per_s, self._now_s = most, per_s, now_s
        self._buckets: OrderedDict[str, _Bucket] = OrderedDict()

    def has_room(self, key: str) -> bool:
        """Return whether `take` would succeed now."""
        return self._filled(key).left >= 1

    def take(self, key: str) -> bool:
        """Take one token; return False if there is none."""
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
        self._buckets[key] = bucket  # as the last one, so that the first has been idle for longest
        while len(self._buckets) > MOST_ADDRESSES:
            self._buckets.popitem(last=False)
        return bucket


class Guard:
    """ASGI middleware; see the module."""

    def __init__(self, app: ASGIApp, tokens: Tokens | TokenFile, names: frozenset[str]) -> None:
        """``names`` are the page's host names, in lower case and without a port."""
        self._app = app
        self._tokens = tokens
        self._names = names
        self._requests = Buckets(*REQUESTS)
        self._admitted = Buckets(*ADMITTED)
        self._wrong = Buckets(*WRONG_TOKENS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":  # start-up and shutdown
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
        host = request.headers.get("host", "").strip().lower()
        # Without the port, and without the brackets of an IPv6 address: ::1 for [::1]:8300.
        name = host.rpartition(":")[0] if host.count(":") == 1 else host
        if host.startswith("["):
            name = host[1:].partition("]")[0]
        if name not in self._names:
            shown = shortened(request.headers.get("host", ""))
            return _refuse(421, f"the page is not served under the name {shown}", "web.names")
        # Requests with a token have their own bucket: strangers behind the same proxy cannot lock them out.
        bucket = self._requests if self.role_of(request) is None else self._admitted
        if not bucket.take(address):
            return _refuse(429, "too many requests came from this address", "again in a second")
        if not request.url.path.startswith(API):
            return None
        # Browsers state where a request comes from; scripts do not, and pass. In two headers, because
        # browsers that do not send the first send the second with all unsafe requests.
        site = request.headers.get("sec-fetch-site", "same-origin")
        origin = request.headers.get("origin")
        same = origin is None or origin.partition("://")[2].lower() == request.headers.get("host", "").lower()
        if request.method not in SAFE and not (same and site in ("same-origin", "none")):
            return _refuse(403, "the request comes from a page of another site", "acquire web --link")
        if request.url.path in OPEN:
            return None
        return self._refusal_of_role(request, address)

    def _refusal_of_role(self, request: Request, address: str) -> JSONResponse | None:
        role = self.role_of(request)
        if role is None:
            # The right token is let in nevertheless. It is too long to be guessed, and others of its address,
            # such as all users of this host or of one proxy, could lock the operator out.
            if not self._wrong.has_room(address):
                return _refuse(429, "too many wrong tokens came from this address", "again in a few seconds")
            # Only an explicit token counts as a guess: a page whose cookie has expired repeats its requests.
            if "authorization" in request.headers:
                self.note_wrong(address)
            return _refuse(401, "the token is missing or wrong", "acquire web --link")
        if role != "operator" and request.method not in SAFE:
            return _refuse(
                403, "a viewer's token cannot change anything", "the operator's token: acquire web --link"
            )
        # The client passes it to the daemon, which logs it and notes it in the recording.
        WHO.set(f"{role} at {address}"[:LONGEST])
        return None

    def role_of(self, request: Request) -> Role | None:
        """Return the role of a request's token, or else of its cookie; None for neither."""
        scheme, _, token = request.headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            return self._tokens.role_of_token(token.strip())
        return self._tokens.role_of_cookie(request.cookies.get(COOKIE, ""))

    def role_of_token(self, token: str, address: str) -> Role | None:
        """Return the role of a token; None for a wrong one."""
        role = self._tokens.role_of_token(token)
        if role is None:
            self.note_wrong(address)
        return role

    def note_wrong(self, address: str) -> None:
        """Log a wrong token, but not each one of an address that tries many."""
        if self._wrong.take(address):  # others are not worth an entry each
            log.warning("a wrong token from %s", address)


def _refuse(status: int, text: str, hint: str = "") -> JSONResponse:
    return JSONResponse(error_body(UsageError(text, hint=hint)), status, RETRY if status == 429 else None)
