"""The page's jobs and glimpses, whatever their processes do."""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx
import pytest
from fake_run import FakeRun, rig_config
from page_server import PageServer
from served import api
from store_helpers import fill, make_spec

from acquire.client import AsyncClient
from acquire.config import load_rig, load_scene
from acquire.daemon.endpoint import Endpoint
from acquire.daemon.facts import Setup
from acquire.daemon.service import Service
from acquire.simulate import simulate
from acquire.store import RecordingWriter, RunCondition
from acquire.web import glimpser, jobs, worker
from acquire.web.archive import Archive
from acquire.web.hub import Hub
from acquire.web.job_words import free_name, recording_words
from acquire.web.live import Live
from acquire.web.messages import JobFacts, JobRequest

LONG = """
import sys
sys.stderr.write("x" * 2**20)
sys.stderr.write("\\nafterwards\\n")
"""


def test_a_job_that_prints_an_endless_line_ends_and_is_followed() -> None:
    async def follow() -> tuple[int, str]:
        request = JobRequest(kind="cut", recording="r.zarr", first_line=0, lines=1)
        facts = JobFacts(id=1, kind="cut", recording="r.zarr", first_line=0, lines=1, state="running")
        job = jobs._Job(facts, request, [], "", 1.0)
        job.process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", LONG, stderr=asyncio.subprocess.PIPE, limit=jobs.MOST_LINE_BYTES
        )
        try:
            async with asyncio.timeout(60):
                await jobs._follow_progress(job)
                return await job.process.wait(), job.facts.text
        finally:
            with contextlib.suppress(ProcessLookupError):
                job.process.kill()
            await job.process.wait()

    assert asyncio.run(follow()) == (0, "afterwards")


def test_a_job_whose_page_died_while_it_was_started_does_not_begin(tmp_path: Path) -> None:
    """The kernel's signal at the page's death is only sent to those who have asked for it by then."""
    words = [sys.executable, "-m", "acquire.web.worker", "plugins", "--json"]
    for owner, begins in ((os.getpid(), True), (1, False)):
        environment = os.environ | {worker.OWNER: str(owner)}
        done = subprocess.run(words, env=environment, capture_output=True, check=True, timeout=300)
        assert bool(done.stdout) is begins


def test_a_job_that_fails_unexpectedly_does_not_end_the_queue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "r.zarr").mkdir()
    really, refusals = asyncio.create_subprocess_exec, [RuntimeError("can't start new thread")]

    async def start(*_: Any, **how: Any) -> asyncio.subprocess.Process:
        if refusals:
            raise refusals.pop()
        return await really(sys.executable, "-c", "", **how)

    monkeypatch.setattr(asyncio, "create_subprocess_exec", start)

    async def two() -> list[str]:
        queue = jobs.Jobs(tmp_path, Archive(tmp_path), tmp_path / "c.sock")
        for _ in range(2):
            queue.add(JobRequest(kind="cut", recording="r.zarr", first_line=0, lines=1))
        running = asyncio.create_task(queue.run())
        try:
            async with asyncio.timeout(60):
                while {job.state for job in queue.list()} & {"waiting", "running"}:
                    await asyncio.sleep(0.01)
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
        return [f"{job.state}: {job.text}" for job in queue.list()]

    last, first = asyncio.run(two())
    assert first == 'failed: it could not be carried out: RuntimeError("can\'t start new thread")'
    assert last == "done: "


def test_a_page_that_could_not_connect_for_want_of_a_thread_connects(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It showed its last state for ever."""
    service, socket = Service(rig_config(tmp_path), lambda _: FakeRun()), tmp_path / "c.sock"
    really, refusals = AsyncClient.setup, [RuntimeError("can't start new thread")]

    async def setup(client: AsyncClient) -> Setup:
        if refusals:
            raise refusals.pop()
        return await really(client)

    monkeypatch.setattr(AsyncClient, "setup", setup)

    async def follow() -> str:
        hub = Hub(socket, Live)
        running = asyncio.create_task(hub.run())
        whys = set()
        try:
            async with asyncio.timeout(60):
                while not hub.connected:
                    whys.add(hub.why)
                    await asyncio.sleep(0.01)
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
        return " ".join(whys)

    with contextlib.closing(Endpoint(socket)) as endpoint, api(service, endpoint):
        assert "can't start new thread" in asyncio.run(follow())


def test_glimpses_come_once_a_process_can_be_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(glimpser, "AGAIN_S", 0.01)
    really, refusals = asyncio.create_subprocess_exec, [BlockingIOError(11, "no process"), RuntimeError("x")]

    async def start(*_: Any, **how: Any) -> asyncio.subprocess.Process:
        if refusals:
            raise refusals.pop()
        program = "import os; os.write(1, bytes(8))"  # an empty glimpse
        return await really(sys.executable, "-c", program, **how)

    monkeypatch.setattr(asyncio, "create_subprocess_exec", start)

    async def watch() -> int:
        came = asyncio.Event()
        owner = glimpser.Glimpser(Path("none.sock"), came.set)
        owner.watch()
        running = asyncio.create_task(owner.run())
        try:
            async with asyncio.timeout(60):
                await came.wait()
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
        return owner.number

    assert asyncio.run(watch()) >= 1


@pytest.mark.parametrize("kind", ["cut", "preview"])
def test_a_recording_whose_name_begins_like_an_option(tmp_path: Path, kind: str) -> None:
    rig, scene = load_rig("rig-demo", {"geometry.stages": 8}), load_scene("scene-leds")
    simulate(rig, scene, tmp_path / "-r.zarr", 60)
    request = JobRequest.model_validate({"kind": kind, "recording": "-r.zarr", "first_line": 0, "lines": 40})
    name = free_name(tmp_path, request)
    words = [sys.executable, "-m", "acquire", *recording_words(request, name)]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, check=False, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / name).exists()


def test_a_request_that_is_repeated_is_carried_out_once(tmp_path: Path) -> None:
    """As a script does whose connection broke before the answer came."""
    service, socket = Service(rig_config(tmp_path), lambda _: FakeRun()), tmp_path / "c.sock"
    with (
        contextlib.closing(Endpoint(socket)) as endpoint,
        api(service, endpoint),
        contextlib.closing(PageServer(socket, tmp_path)) as page,
        RecordingWriter.create(tmp_path / "r.zarr", make_spec()) as writer,
        httpx.Client(
            base_url=f"{page.address}api",
            headers={"Authorization": f"Bearer {page.operator}"},
            timeout=60,  # a job's process may take longer than the usual 5 s to start on a busy host
        ) as ask,
    ):
        fill(writer, 150)
        writer.commit()
        lines = {"first_line": 1000, "lines": 20}
        for path, asked in (
            ("/jobs", {"kind": "cut", "recording": "r.zarr", **lines}),
            ("/recordings/r.zarr/hold", {"why": "x", **lines}),
            ("/calibration", {"step": "dark"}),
        ):
            headers = {"Request-Id": path}
            first = ask.post(path, json=asked, headers=headers)
            assert first.status_code == 200, first.text
            if path.endswith("hold"):  # afterwards it would be refused
                writer.seal(RunCondition.GOOD, "done", {})
            assert ask.post(path, json=asked, headers=headers).json() == first.json()
            other = ask.post(path, json={**asked, "lines": 4000}, headers=headers)
            assert "was given to another request before" in other.json()["message"]
        refused = ask.post("/calibration", json={"step": "flat", "black": True})
        assert "the step 'flat' cannot have black parts" in refused.json()["message"]
        assert sorted(job["kind"] for job in ask.get("/jobs").json()) == ["calibrate", "cut"]
