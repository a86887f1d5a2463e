"""Work that takes its time, as commands of ours: one at a time, niced, each with what it said last.

waiting ──▶ running ──▶ done | failed | stopped
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import signal
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.errors import PlaceError, StateError, UsageError
from acquire.text import shortened
from acquire.web.messages import JobFacts, JobRequest

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.web.archive import Archive

MOST_WAITING = 16
MOST_LISTED = 50
END_S = 15.0
"""For a job that is to stop: it keeps the best it has."""
MOST_LINE_BYTES = 2**16

log = logging.getLogger("acquire.web")


@dataclass(slots=True)
class _Job:
    facts: JobFacts
    request: JobRequest
    process: asyncio.subprocess.Process | None = None
    stopped: bool = False

    def become(self, **facts: object) -> None:
        self.facts = self.facts.model_copy(update=facts)


class Jobs:
    """For one event loop; `run` is its life."""

    def __init__(self, directory: Path, archive: Archive) -> None:
        self._directory = directory
        self._archive = archive
        self._jobs: dict[int, _Job] = {}
        self._count = 0
        self._added = asyncio.Event()

    def list(self) -> list[JobFacts]:
        """The newest first."""
        return [job.facts for job in reversed(self._jobs.values())]

    def add(self, request: JobRequest) -> JobFacts:
        """Raises PlaceError where there is no such recording, StateError where too much waits already."""
        self._archive.path_of(request.recording)
        if sum(job.facts.state == "waiting" for job in self._jobs.values()) >= MOST_WAITING:
            raise StateError(f"{MOST_WAITING} jobs are waiting already", hint="stop one of them")
        self._count += 1
        facts = JobFacts(
            id=self._count,
            kind=request.kind,
            recording=request.recording,
            first_line=request.first_line,
            lines=request.lines,
            state="waiting",
        )
        self._jobs[self._count] = _Job(facts, request)
        over = [number for number, job in self._jobs.items() if job.facts.state not in ("waiting", "running")]
        for number in over[: max(0, len(self._jobs) - MOST_LISTED)]:
            del self._jobs[number]
        self._added.set()
        return facts

    async def stop(self, number: int) -> JobFacts:
        """End a job; one under way keeps the best that it has. Raises PlaceError."""
        job = self._jobs.get(number)
        if job is None:
            raise PlaceError(f"there is no job {number}", possible="/api/jobs")
        if job.facts.state == "waiting":
            job.become(state="stopped")
        elif job.process is not None and job.process.returncode is None:
            job.stopped = True
            await _end(job.process)
        return job.facts

    async def run(self) -> None:
        """Work until cancelled; what is under way then is ended."""
        while True:
            job = next((one for one in self._jobs.values() if one.facts.state == "waiting"), None)
            if job is None:
                self._added.clear()
                await self._added.wait()
                continue
            try:
                await self._do(job)
            except OSError as error:
                job.become(state="failed", text=str(error))

    async def _do(self, job: _Job) -> None:
        name = self._free_name(job.request)
        job.become(state="running", text="starting")
        job.process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "acquire.web.worker",
            *_words(job.request, name),
            cwd=self._directory,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            limit=MOST_LINE_BYTES,
            process_group=0,
        )
        try:
            await _listen(job)
            code = await job.process.wait()
        except BaseException:
            _signal(job.process, signal.SIGKILL)
            await job.process.wait()
            raise
        made = name if os.path.lexists(self._directory / name) else None
        state = "stopped" if job.stopped else "failed" if code else "done"
        text = job.facts.text if state == "failed" else "" if made or state == "done" else "nothing was kept"
        job.become(state=state, text=text, result=made)
        log.info("job %d, %s of %s: %s", job.facts.id, job.facts.kind, job.facts.recording, state)

    def _free_name(self, request: JobRequest) -> str:
        """Of what is made: after recording, lines and voxels."""
        stem = f"{request.recording.removesuffix('.zarr')}-{request.first_line}-{request.lines}"
        if request.kind == "cut":
            suffix = ".npz"
        else:
            voxels = f"{request.spatial_merge}x{request.temporal_merge}"
            stem += "-preview" if request.kind == "preview" else f"-{voxels}"
            suffix = ".zarr"
        for number in range(1, 1000):
            name = f"{stem}{f'-{number}' if number > 1 else ''}{suffix}"
            if not os.path.lexists(self._directory / name):
                return name
        raise UsageError(f"there are a thousand of {stem} already", hint="remove some")


def _words(request: JobRequest, name: str) -> list[str]:
    """The command."""
    lines = ["--first-line", str(request.first_line), "--lines", str(request.lines), "--out", name, "--json"]
    if request.kind == "cut":
        return ["cut", request.recording, *lines]
    if request.kind == "preview":
        return ["reconstruct", request.recording, *lines, "--preview", "--workers", "1"]
    voxels = ["--nm", str(request.spatial_merge), "--tm", str(request.temporal_merge)]
    return ["reconstruct", request.recording, *lines, *voxels, "--preset", request.preset, "--workers", "1"]


async def _listen(job: _Job) -> None:
    """Until it says no more; its latest words are the job's."""
    assert job.process is not None
    assert job.process.stderr is not None
    with contextlib.suppress(ValueError):  # a line without an end: the rest is not listened to
        async for line in job.process.stderr:
            job.become(text=_told(line.decode(errors="replace")))


def _told(line: str) -> str:
    """Of a line of JSON (`acquire.cli.progress`), or of anything else."""
    try:
        facts = json.loads(line)
    except ValueError:
        return shortened(line.strip(), 300)
    if isinstance(facts, dict) and isinstance(facts.get("error"), dict):
        return shortened(facts["error"].get("message", ""), 300)
    progress = facts.get("progress", facts) if isinstance(facts, dict) else facts
    if isinstance(progress, dict):
        return shortened(", ".join(f"{name} {value}" for name, value in progress.items()), 300)
    return shortened(line.strip(), 300)


async def _end(process: asyncio.subprocess.Process) -> None:
    """By word, then by force."""
    _signal(process, signal.SIGINT)
    try:
        async with asyncio.timeout(END_S):
            await process.wait()
    except TimeoutError:
        _signal(process, signal.SIGKILL)


def _signal(process: asyncio.subprocess.Process, number: signal.Signals) -> None:
    """To the process and its workers."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)
