"""The page's web application: the daemon's API below /api, recordings and jobs, and the page's files."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from fastapi import APIRouter, FastAPI, Query, Request, Response
from fastapi.responses import FileResponse, StreamingResponse
from starlette.staticfiles import StaticFiles

from acquire.daemon.answers import Answers
from acquire.daemon.control import new_app
from acquire.daemon.messages import ErrorMessage, on_the_wire
from acquire.daemon.routes import NO_STORE, RequestId, routes
from acquire.daemon.who import WHO
from acquire.errors import AcquireError, BusyError, UsageError
from acquire.web.archive import Archive
from acquire.web.calibrations import calibration_facts, forget, place_of, rows_of
from acquire.web.checkup import Checkup
from acquire.web.guard import Guard
from acquire.web.hub import Hub
from acquire.web.jobs import Jobs
from acquire.web.live import Live
from acquire.web.messages import (
    CalibrationFacts,
    CalibrationRequest,
    CheckupFacts,
    ForgetRequest,
    HoldRequest,
    JobFacts,
    JobRequest,
    RecordingDetail,
    RecordingFacts,
    Session,
    SessionRequest,
    VideoFacts,
)
from acquire.web.page_stream import OpenPages
from acquire.web.passing import Passing
from acquire.web.tokens import COOKIE, TokenFile, Tokens

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

STATIC = Path(__file__).parent / "static"
MOST_READING = 32
"""Largest number of requests that wait for the reading thread."""
WHY_REFUSED: dict[int | str, dict[str, Any]] = {
    401: {"model": ErrorMessage, "description": "the token is missing or wrong"},
    403: {
        "model": ErrorMessage,
        "description": "the token is a viewer's, or the request comes from another site",
    },
    421: {"model": ErrorMessage, "description": "the host name is not one of the page's"},
    429: {"model": ErrorMessage, "description": "too many requests, or too many wrong tokens"},
}
PNG: dict[int | str, dict[str, Any]] = {
    200: {"description": "PNG", "content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}}
}
BYTES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "bytes",
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
    }
}

log = logging.getLogger("acquire.web")
T = TypeVar("T")


class DiskReads:
    """One thread for all work that waits for the disk, with a limited number of waiting requests."""

    def __init__(self) -> None:
        # One, because `Archive` is for one thread at a time.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="reading")
        self._waiting = 0

    async def __call__(self, work: Callable[[], T]) -> T:
        if self._waiting >= MOST_READING:
            raise BusyError(
                f"{MOST_READING} requests are reading recordings already", hint="again in a moment"
            )
        self._waiting += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self._thread, work)
        finally:
            self._waiting -= 1

    def close(self) -> None:
        self._thread.shutdown(wait=False, cancel_futures=True)


async def _prepare(archive: Archive, reading: DiskReads) -> None:
    with contextlib.suppress(AcquireError):  # whoever asks for the lists gets the error
        await reading(archive.recordings)
        await reading(archive.videos)


def build_page(
    socket: Path, directory: Path, tokens: Tokens | TokenFile, names: frozenset[str], *, secure: bool
) -> Guard:
    """Return the page's application for the daemon on ``socket``, whose recordings are in ``directory``.

    Must be called from within the event loop that will serve it. ``secure``: only over https.
    """
    hub = Hub(socket, Live)
    archive, reading = Archive(directory), DiskReads()
    jobs = Jobs(directory, archive, socket)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        # The first lists of hundreds of recordings take seconds: they are made before anybody asks.
        works = (hub.run(), jobs.run(), hub.glimpser.run(), _prepare(archive, reading))
        tasks = [asyncio.create_task(each) for each in works]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            # They must finish: a running job ends its process when it is cancelled.
            await asyncio.gather(*tasks, return_exceptions=True)
            reading.close()

    app = new_app(
        "The instrument's page: the daemon's API, recordings, videos and jobs.",
        "the page's server",
        # Below /api, where the guard demands a token.
        openapi_url="/api/openapi.json",
        lifespan=lifespan,
    )
    api = APIRouter(prefix="/api", responses=WHY_REFUSED)
    answers = Answers()
    api.include_router(routes(Passing(hub, tokens), answers))
    _add_stream(api, OpenPages(hub))
    _add_recordings(api, archive, reading, answers)
    _add_jobs(api, jobs, answers)
    _add_checkup(api, Checkup(socket), answers)
    _add_calibration(api, hub, jobs, directory, reading, answers)
    guard = Guard(app, tokens, names)
    _add_session(api, guard, tokens, secure=secure)
    app.include_router(api)

    @app.get("/", include_in_schema=False)
    async def index() -> FileResponse:
        # The browser asks whether it has changed: after an update an old page would load new scripts.
        return FileResponse(STATIC / "index.html", headers={"Cache-Control": "no-cache"})

    app.mount("/static", StaticFiles(directory=STATIC), name="static")
    return guard


def _add_session(api: APIRouter, guard: Guard, tokens: Tokens | TokenFile, *, secure: bool) -> None:
    @api.post("/session", summary="Exchange a token for a cookie")
    async def enter(request: Request, asked: SessionRequest, response: Response) -> Session:
        address = request.client.host if request.client else ""
        role = guard.role_of_token(asked.token, address)
        if role is None:
            raise UsageError("the token is wrong", hint="acquire web --link")
        # No script can read the cookie, no other site can make a browser send it, and only /api receives it.
        response.set_cookie(
            COOKIE, tokens.cookie(role), httponly=True, samesite="strict", secure=secure, path="/api"
        )
        log.info("%s logged in from %s", role, address)
        return Session(role=role)

    @api.delete("/session", summary="Log out")
    async def leave(response: Response) -> dict[str, bool]:
        response.delete_cookie(COOKIE, path="/api")
        return {"left": True}

    @api.get("/whoami", summary="Role of the caller")
    async def who(request: Request) -> Session:
        role = guard.role_of(request)
        assert role is not None
        return Session(role=role)


def _add_stream(api: APIRouter, pages: OpenPages) -> None:
    @api.get(
        "/live",
        summary="State, news and pictures for a page (acquire.web.frames)",
        responses=BYTES,
        response_class=Response,
    )
    async def live(
        pictures: Annotated[bool, Query()] = True,
        glimpses: Annotated[
            bool, Query(description="coarse videos of the latest lines; uses one core")
        ] = False,
        once: Annotated[bool, Query(description="only the current state, once, for a hidden page")] = False,
    ) -> Response:
        # Not a stream: a browser has six connections to a host, and a hidden page must not hold one.
        if once:
            return Response(pages.state, media_type="application/octet-stream", headers=NO_STORE)
        stream = pages.open(pictures=pictures, glimpses=glimpses)
        return StreamingResponse(stream, media_type="application/octet-stream", headers=NO_STORE)


def _add_recordings(api: APIRouter, archive: Archive, reading: DiskReads, answers: Answers) -> None:
    @api.get("/recordings", summary="Recordings, newest first")
    async def recordings() -> list[RecordingFacts]:
        return await reading(archive.recordings)

    @api.get("/recordings/{name}", summary="A recording, with its events, gaps and holds")
    async def recording(name: str) -> RecordingDetail:
        return await reading(lambda: archive.recording(name))

    @api.get(
        "/recordings/{name}/picture",
        summary="Picture of both arms over the whole recording",
        responses=PNG,
        response_class=Response,
    )
    async def picture(name: str) -> Response:
        content = await reading(lambda: archive.picture(name))
        return Response(content, media_type="image/png", headers=NO_STORE)

    @api.post("/recordings/{name}/hold", summary="Protect lines from retention")
    async def hold(name: str, asked: HoldRequest, request_id: RequestId = None) -> RecordingDetail:
        async def work() -> RecordingDetail:
            await reading(lambda: archive.hold(name, asked))
            return await reading(lambda: archive.recording(name))

        return await answers.once(request_id, f"hold {name} {asked}", work)

    @api.get("/videos", summary="Reconstructed videos, newest first")
    async def videos() -> list[VideoFacts]:
        return await reading(archive.videos)

    @api.get("/videos/{name}", summary="A video, with its display range")
    async def video(name: str) -> VideoFacts:
        return await reading(lambda: archive.video(name))

    @api.get(
        "/videos/{name}/frames",
        summary="Consecutive frames, 8 bits per pixel; X-Unreadable-Frames lists those that are not there",
        responses=BYTES,
        response_class=Response,
    )
    async def frames(
        name: str, first: Annotated[int, Query(ge=0)] = 0, count: Annotated[int, Query(ge=1, le=4096)] = 1
    ) -> Response:
        content, lost = await reading(lambda: archive.frames(name, first, count))
        # Of 8 bits none is left to mark a frame that cannot be read.
        unreadable = ",".join(f"{frames.start}-{frames.stop - 1}" for frames in lost)
        headers = {**NO_STORE, "X-Unreadable-Frames": unreadable}
        return Response(content, media_type="application/octet-stream", headers=headers)

    @api.get("/cuts/{name}", summary="A range that was cut", responses=BYTES, response_class=Response)
    async def cut(name: str) -> FileResponse:
        path = await reading(lambda: archive.path_of(name, ".npz"))
        return FileResponse(path, media_type="application/octet-stream", filename=on_the_wire(name))


def _add_jobs(api: APIRouter, jobs: Jobs, answers: Answers) -> None:
    @api.get("/jobs", summary="Jobs, newest first")
    async def list_jobs() -> list[JobFacts]:
        return jobs.list()

    @api.post("/jobs", summary="Reconstruct, preview or cut a range of a recording")
    async def add(asked: JobRequest, request_id: RequestId = None) -> JobFacts:
        async def work() -> JobFacts:
            return jobs.add(asked)

        return await answers.once(request_id, f"job {asked}", work)

    @api.delete("/jobs/{number}", summary="Stop a job")
    async def stop(number: int) -> JobFacts:
        return await jobs.stop(number)


def _add_checkup(api: APIRouter, checkup: Checkup, answers: Answers) -> None:
    @api.get("/doctor", summary="The latest examination of the host")
    async def latest() -> CheckupFacts:
        return checkup.facts

    @api.post("/doctor", summary="Examine the host, at the lowest priority and without touching a device")
    async def examine(request_id: RequestId = None) -> CheckupFacts:
        return await answers.once(request_id, "doctor", checkup.examine)


def _add_calibration(
    api: APIRouter, hub: Hub, jobs: Jobs, directory: Path, reading: DiskReads, answers: Answers
) -> None:
    async def facts() -> CalibrationFacts:
        place, named = place_of(directory, hub.setup)
        rows = rows_of(hub.setup)
        return await reading(lambda: calibration_facts(place, named=named, rows=rows))

    @api.get("/calibration", summary="The calibration: its steps and their findings")
    async def calibration() -> CalibrationFacts:
        return await facts()

    @api.post("/calibration", summary="Carry out a calibration step, as a job")
    async def calibrate(asked: CalibrationRequest, request_id: RequestId = None) -> JobFacts:
        async def work() -> JobFacts:
            return jobs.calibrate(asked, place_of(directory, hub.setup)[0])

        return await answers.once(request_id, f"calibrate {asked}", work)

    @api.post("/calibration/forget", summary="Take steps out of the calibration")
    async def forget_steps(asked: ForgetRequest, request_id: RequestId = None) -> CalibrationFacts:
        async def work() -> CalibrationFacts:
            # It may just be measured with what would be forgotten.
            jobs.refuse_while_calibrating()
            place = place_of(directory, hub.setup)[0]
            await reading(lambda: forget(place, asked))
            log.info("%s forgotten from %s by %s", ", ".join(asked.steps), place, WHO.get())
            return await facts()

        return await answers.once(request_id, f"forget {asked}", work)
