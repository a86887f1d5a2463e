"""The control API: one route per command, described at /openapi.json.

Commands run one after the other in the service's thread; the status is the latest one that this thread has
published, so that it never waits for a device.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from acquire import __version__
from acquire.daemon.answers import Answers
from acquire.daemon.messages import HTTP_STATUS, RETRY, ErrorMessage, error_body, http_status
from acquire.daemon.routes import routes
from acquire.errors import AcquireError, BusyError, UsageError
from acquire.text import own_words, shortened, shown

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from acquire.daemon.routes import Api

MAX_BODY_BYTES = 2**16
"""Ample, since a request is hardly more than a path and a number."""
MOST_EXPLAINED = 5
"""Number of errors that an answer lists."""
REFUSALS = {
    400: "the body is not JSON",
    404: "there is no such path",
    405: "the path takes another method",
    413: f"the body is longer than {MAX_BODY_BYTES} bytes",
}
"""Refusals before any command sees the request."""


def build_app(api: Api) -> FastAPI:
    """Return the daemon's API, over its own service."""
    app = new_app("Control of the capture service.")
    app.include_router(routes(api, Answers()))
    return app


def new_app(description: str, speaker: str = "the daemon", **options: Any) -> FastAPI:
    """Return an API without routes, with error handlers and a limit for the body.

    ``speaker`` is the process that answers, as its own refusals and defects name it.
    """
    app = FastAPI(
        title="acquire",
        version=__version__,
        description=description,
        responses={
            **{code: {"model": ErrorMessage, "description": why} for code, why in REFUSALS.items()},
            **{code: {"model": ErrorMessage, "description": f"{kind.__doc__}"} for kind, code in HTTP_STATUS},
        },
        docs_url=None,  # the pages would load scripts from elsewhere
        redoc_url=None,
        **options,
    )
    app.add_middleware(BoundedBody)
    app.add_middleware(HeadAsGet)
    _add_errors(app, speaker)
    return app


class BoundedBody:
    """Middleware that reads no more than `MAX_BODY_BYTES` of a request, whatever its header says."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        left = MAX_BODY_BYTES

        async def bounded() -> Message:
            nonlocal left
            message = await receive()
            left -= len(message.get("body", b""))  # the bytes received: Content-Length may be wrong
            if left < 0:
                raise HTTPException(413, f"more than {MAX_BODY_BYTES} bytes")
            return message

        await self._app(scope, bounded, send)


class HeadAsGet:
    """Middleware that answers HEAD as GET without the body, which RFC 9110 wants; FastAPI refuses it."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return
        answered = asyncio.Event()

        async def without_body(message: Message) -> None:
            if message["type"] == "http.response.start":
                await send(message)
            elif not answered.is_set():
                await send({"type": "http.response.body", "body": b"", "more_body": False})
                answered.set()

        answering = asyncio.ensure_future(self._app({**scope, "method": "GET"}, receive, without_body))
        enough = asyncio.ensure_future(answered.wait())
        try:
            await asyncio.wait((answering, enough), return_when=asyncio.FIRST_COMPLETED)
        finally:
            enough.cancel()
            # A stream would go on for ever, and a file would be read to its end.
            if answered.is_set() or not answering.done():
                answering.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await answering


def _add_errors(app: FastAPI, speaker: str) -> None:
    described = str(app.openapi_url)

    @app.exception_handler(AcquireError)
    async def refused(_: Request, error: AcquireError) -> JSONResponse:
        return _answer(error)

    @app.exception_handler(RequestValidationError)
    async def malformed(_: Request, error: RequestValidationError) -> JSONResponse:
        found = error.errors()
        explained = []
        for item in found[:MOST_EXPLAINED]:
            # Everything here comes from the client, so it is shortened.
            key = ".".join(str(part) for part in item["loc"] if part != "body") or "request"
            why = shortened(own_words(item["msg"]), 400)
            explained.append(f"{shortened(key)} = {shown(item.get('input'))}: {why}")
        more = [f"and {len(found) - MOST_EXPLAINED} more"] if len(found) > MOST_EXPLAINED else []
        return _answer(UsageError("; ".join(explained + more), possible=described))

    @app.exception_handler(HTTPException)
    async def unknown(request: Request, error: HTTPException) -> JSONResponse:
        asked = shortened(f"{request.method} {request.url.path}")
        # In our own form, so that a client shows every refusal alike.
        refusal = UsageError(
            f"{speaker} cannot answer {asked}: {shortened(error.detail)}", possible=described
        )
        return JSONResponse(error_body(refusal), error.status_code, error.headers)

    @app.exception_handler(Exception)
    async def defect(_: Request, error: Exception) -> JSONResponse:
        # The server logs the traceback; the user gets one line that refers to it.
        text = f"defect in {speaker}: {shortened(repr(error), 400)}"
        return _answer(AcquireError(text, hint="see its log"))


def _answer(error: AcquireError) -> JSONResponse:
    headers = RETRY if isinstance(error, BusyError) else None
    return JSONResponse(error_body(error), http_status(error), headers)
