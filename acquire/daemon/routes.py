"""The routes of the API, over any implementation: the daemon's service, or a client that forwards to it.

So a page, a script and the command line use the same API, whichever process answers.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated, Any, Protocol

from fastapi import APIRouter, Depends, Header, Query, Response
from fastapi.responses import StreamingResponse

from acquire.daemon.answers import Answers
from acquire.daemon.facts import Health, LogTail, Reloaded, Rings, Setup, Version
from acquire.daemon.messages import (
    LONGEST_ID,
    ArmRequest,
    CapacityStatus,
    MarkRequest,
    StartRequest,
    Status,
    fault_error,
)
from acquire.daemon.metrics import CONTENT_TYPE, metrics_text
from acquire.daemon.stream import LEAST_STATUS_S, MOST_STATUS_S
from acquire.daemon.who import LONGEST, WHO

RequestId = Annotated[
    str | None,
    Header(
        min_length=1,
        max_length=LONGEST_ID,
        pattern="^[!-~]+$",
        description="chosen by the client, new for every command: repeating it gives the same answer, and "
        "the command is carried out once",
    ),
]
STREAM: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "server-sent events: `news` (a News, with its id) and `status` (a Status)",
        "content": {"text/event-stream": {"schema": {"type": "string"}}},
    }
}
TEXT: dict[int | str, dict[str, Any]] = {
    200: {"description": "Prometheus text format", "content": {"text/plain": {"schema": {"type": "string"}}}}
}
# An answer that a proxy has kept would show an old state as the current one.
NO_STORE = {"Cache-Control": "no-store"}


class Api(Protocol):
    """Implementation of the API: the daemon's own service, or a client that forwards (`acquire.web`)."""

    async def status(self) -> Status:
        """Return the state of daemon, devices, rings and recording now."""
        ...

    async def arm(self, request: ArmRequest) -> Status:
        """Start cameras and trigger. Raises StateError unless the daemon is idle."""
        ...

    async def start(self, request: StartRequest) -> Status:
        """Begin a recording. Raises StateError unless the instrument is armed."""
        ...

    async def mark(self, request: MarkRequest) -> Status:
        """List a moment at the newest line; a mark may start a recording (``[events]``)."""
        ...

    async def stop(self) -> Status:
        """End the recording, and return once it is sealed."""
        ...

    async def disarm(self) -> Status:
        """Stop trigger and cameras, or clear a fault."""
        ...

    async def measure(self) -> CapacityStatus:
        """Measure what ring, codec and disk of this host sustain. Raises StateError unless idle."""
        ...

    async def reload(self) -> Reloaded:
        """Read the rig file again, and use what of it can change now."""
        ...

    async def health(self) -> Health:
        """Judge the state: good, or what is wrong and since when."""
        ...

    async def version(self) -> Version:
        """Return the versions of the program and of the rig's configuration."""
        ...

    async def setup(self) -> Setup:
        """Return the rig, its origin and the devices as they were found."""
        ...

    async def rings(self) -> Rings:
        """Return where the rings are, for local processes that look at the latest lines."""
        ...

    async def log(self) -> LogTail:
        """Return the latest entries of the log."""
        ...

    def events(self, last_id: str | None, status_s: float | None, *, history: bool) -> AsyncIterator[str]:
        """Yield server-sent events: news from ``last_id`` on, and the status every ``status_s`` seconds."""
        ...


async def _note_who(
    acquire_by: Annotated[
        str | None,
        Header(max_length=LONGEST, pattern="^[ -~]+$", description="user, for the log and the recording"),
    ] = None,
) -> None:
    # The page has already set it from a token, and a header must not replace that.
    if acquire_by and not WHO.get():
        WHO.set(acquire_by)


def routes(api: Api, answers: Answers) -> APIRouter:
    """Return the routes of ``api``; a command's request ID is looked up in ``answers``."""
    router = APIRouter(dependencies=[Depends(_note_who)])
    _add_commands(router, api, answers)
    _add_facts(router, api)
    _add_judgements(router, api)
    return router


def _add_commands(router: APIRouter, api: Api, answers: Answers) -> None:
    once = answers.once

    @router.post("/arm", summary="idle → armed")
    async def arm(request: ArmRequest | None = None, request_id: RequestId = None) -> Status:
        asked = request or ArmRequest()
        return await once(request_id, f"arm {asked}", lambda: api.arm(asked))

    @router.post("/start", summary="armed → recording")
    async def start(request: StartRequest, request_id: RequestId = None) -> Status:
        return await once(request_id, f"start {request}", lambda: api.start(request))

    @router.post("/mark", summary="armed, recording or draining: an event at the newest line")
    async def mark(request: MarkRequest, request_id: RequestId = None) -> Status:
        return await once(request_id, f"mark {request}", lambda: api.mark(request))

    @router.post("/stop", summary="recording → draining → armed; returns once the recording is sealed")
    async def stop(request_id: RequestId = None) -> Status:
        return await once(request_id, "stop", api.stop)

    @router.post("/disarm", summary="armed → idle; clears a fault")
    async def disarm(request_id: RequestId = None) -> Status:
        return await once(request_id, "disarm", api.disarm)

    # These two may be repeated without harm: their request ID is optional in practice, too.
    @router.post("/capacity", summary="idle: measure what ring, codec and disk sustain here, now")
    async def measure(request_id: RequestId = None) -> CapacityStatus:
        return await once(request_id, "capacity", api.measure)

    @router.post("/reload", summary="Reload the rig file; refused as a whole if a key cannot change")
    async def reload(request_id: RequestId = None) -> Reloaded:
        return await once(request_id, "reload", api.reload)


def _add_facts(router: APIRouter, api: Api) -> None:
    @router.get("/status", summary="What the daemon is doing, and how well")
    async def status() -> Status:
        return await api.status()

    @router.get("/version", summary="Identity of the daemon")
    async def version() -> Version:
        return await api.version()

    @router.get("/setup", summary="The resolved configuration, and how it differs from the defaults")
    async def setup() -> Setup:
        return await api.setup()

    @router.get("/rings", summary="Memory through which the lines pass, for observers on this host")
    async def rings() -> Rings:
        return await api.rings()

    @router.get("/log", summary="Latest entries of the daemon's log")
    async def log() -> LogTail:
        return await api.log()

    @router.get("/events", summary="What happens, as it happens", responses=STREAM, response_class=Response)
    async def events(
        last_event_id: Annotated[
            str | None,
            Header(max_length=LONGEST_ID, description="id of the latest news received: only later ones"),
        ] = None,
        status_s: Annotated[
            float | None,
            Query(
                ge=LEAST_STATUS_S,
                le=MOST_STATUS_S,
                allow_inf_nan=False,
                description="also the status, at this interval and with every news",
            ),
        ] = None,
        history: Annotated[bool, Query(description="begin with all news that are kept")] = False,
    ) -> StreamingResponse:
        stream = api.events(last_event_id, status_s, history=history)
        return StreamingResponse(stream, media_type="text/event-stream", headers=NO_STORE)


def _add_judgements(router: APIRouter, api: Api) -> None:
    @router.get("/health", summary="Is all well? One word, one sentence, and the checks behind them")
    async def health() -> Health:
        return await api.health()

    @router.get("/metrics", summary="For Prometheus", responses=TEXT, response_class=Response)
    async def metrics() -> Response:
        text = metrics_text(await api.status(), await api.health())
        return Response(text, headers={"Content-Type": CONTENT_TYPE} | NO_STORE)

    @router.get("/healthz", summary="200 while the service works; 503 with the fault if it does not")
    async def healthz() -> Health:
        found = await api.health()
        if found.level == "fault":
            raise fault_error((await api.status()).fault)
        return found
