"""The page's jobs and glimpses, whatever their processes do."""

from __future__ import annotations

import asyncio
import contextlib
import sys
from pathlib import Path
from typing import Any

import pytest

from acquire.web import glimpser, jobs
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


def test_glimpses_come_once_a_process_can_be_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(glimpser, "AGAIN_S", 0.01)
    really, refusals = asyncio.create_subprocess_exec, [BlockingIOError(11, "no process")]

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
