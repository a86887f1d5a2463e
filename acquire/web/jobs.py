"""Work that takes its time, as commands of ours: one at a time, niced, each with what it said last.

::

    waiting ──▶ running ──▶ done | failed | stopped

A step of a calibration does not stand in the queue: whoever has put a target in waits in front of it. It has
the instrument, so there is one at most, and it is always asked to end, so that it leaves that as it was.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.daemon.who import WHO
from acquire.errors import AcquireError, PlaceError, StateError
from acquire.web.calibrations import step_of
from acquire.web.job_words import calibration_words, free_name, recording_words, told
from acquire.web.messages import CalibrationRequest, JobFacts, JobRequest

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.web.archive import Archive

MOST_WAITING = 16
MOST_LISTED = 50
END_S = 15.0
"""For a job that is to stop: it keeps the best it has."""
CALIBRATION_END_S = 180.0
"""A step seals what it records, looks at what it has, and leaves the instrument as it was."""
LEAVE_S = 3.0
"""For a step when the page ends: the daemon does not wait much longer for that."""
STARTING_S = 0.02
MOST_LINE_BYTES = 2**16

log = logging.getLogger("acquire.web")


@dataclass(slots=True)
class _Job:
    facts: JobFacts
    request: JobRequest | CalibrationRequest
    words: list[str]
    by: str
    end_s: float
    process: asyncio.subprocess.Process | None = None
    ending: asyncio.Task[None] | None = None

    def become(self, **facts: object) -> None:
        self.facts = self.facts.model_copy(update=facts)


class Jobs:
    """For one event loop; `run` is its life."""

    def __init__(self, directory: Path, archive: Archive, socket: Path) -> None:
        self._directory, self._socket = directory, socket
        self._archive = archive
        self._jobs: dict[int, _Job] = {}
        self._count = 0
        self._added = asyncio.Event()
        self._step: asyncio.Task[None] | None = None

    def list(self) -> list[JobFacts]:
        """The newest first."""
        return [job.facts for job in reversed(self._jobs.values())]

    def add(self, request: JobRequest) -> JobFacts:
        """Raises PlaceError where there is no such recording, StateError where too much waits already."""
        self._archive.path_of(request.recording)
        if sum(job.facts.state == "waiting" for job in self._jobs.values()) >= MOST_WAITING:
            raise StateError(f"{MOST_WAITING} jobs are waiting already", hint="stop one of them")
        facts = JobFacts(
            id=self._next(),
            kind=request.kind,
            recording=request.recording,
            first_line=request.first_line,
            lines=request.lines,
            state="waiting",
        )
        self._keep(_Job(facts, request, [], WHO.get(), END_S))
        self._added.set()
        return facts

    def calibrate(self, request: CalibrationRequest, out: Path) -> JobFacts:
        """Carry a step out at once, for the calibration at ``out``.

        Raises UsageError for a step that there is not, StateError while another one is under way.
        """
        step = step_of(request)
        if any(job.facts.state == "running" for job in self._jobs.values() if job.facts.kind == "calibrate"):
            raise StateError("a step of the calibration is under way", hint="when it is done; or cancel it")
        facts = JobFacts(
            id=self._next(), kind="calibrate", step=step.name, lines=request.lines, state="running"
        )
        job = _Job(facts, request, calibration_words(request, out), WHO.get(), CALIBRATION_END_S)
        self._keep(job)
        self._step = asyncio.create_task(self._try(job))
        return facts

    def _next(self) -> int:
        self._count += 1
        return self._count

    def _keep(self, job: _Job) -> None:
        self._jobs[job.facts.id] = job
        over = [number for number, job in self._jobs.items() if job.facts.state not in ("waiting", "running")]
        for number in over[: max(0, len(self._jobs) - MOST_LISTED)]:
            del self._jobs[number]

    async def stop(self, number: int) -> JobFacts:
        """End a job; one under way keeps the best that it has. Raises PlaceError."""
        job = self._jobs.get(number)
        if job is None:
            raise PlaceError(f"there is no job {number}", possible="/api/jobs")
        if job.facts.state == "waiting":
            job.become(state="stopped")
        elif job.facts.state == "running" and job.ending is None:
            job.become(text="ending with what there is")
            job.ending = asyncio.create_task(_end_of(job))
        return job.facts

    async def run(self) -> None:
        """Work until cancelled; what is under way then is ended."""
        try:
            while True:
                job = next((one for one in self._jobs.values() if one.facts.state == "waiting"), None)
                if job is None:
                    self._added.clear()
                    await self._added.wait()
                    continue
                await self._try(job)
        finally:
            if self._step is not None:
                self._step.cancel()
                await asyncio.gather(self._step, return_exceptions=True)

    async def _try(self, job: _Job) -> None:
        try:
            await self._do(job)
        except (OSError, AcquireError) as error:
            job.become(state="failed", text=str(error))

    async def _do(self, job: _Job) -> None:
        name, words = "", job.words
        if isinstance(job.request, JobRequest):
            name = free_name(self._directory, job.request)
            words = recording_words(job.request, name)
        job.become(state="running", text="starting")
        job.process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "acquire.web.worker",
            *words,
            cwd=self._directory,
            env=os.environ | {"ACQUIRE_SOCKET": str(self._socket), "ACQUIRE_BY": job.by},
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            limit=MOST_LINE_BYTES,
            process_group=0,  # its workers are ended with it, and a Ctrl-C on our terminal is not theirs
        )
        try:
            await _listen(job)
            code = await job.process.wait()
        except asyncio.CancelledError:
            # The page ends. A step of a calibration may have changed the instrument, and is asked first.
            if job.facts.kind == "calibrate":
                await _end(job.process, LEAVE_S, asked=job.ending is not None)
            _signal(job.process, signal.SIGKILL)
            await job.process.wait()
            raise
        made = name if name and os.path.lexists(self._directory / name) else None
        state = "stopped" if job.ending is not None else "failed" if code else "done"
        text = job.facts.text if state == "failed" else ""
        if state == "stopped":
            kept = made if name else not code
            text = "what it had is kept" if kept else "nothing was kept"
        job.become(state=state, text=text, result=made)
        about = job.facts.step or job.facts.recording
        log.info("job %d, %s of %s: %s", job.facts.id, job.facts.kind, about, state)


async def _listen(job: _Job) -> None:
    """Until it says no more; its latest words are the job's."""
    assert job.process is not None
    assert job.process.stderr is not None
    with contextlib.suppress(ValueError):  # a line without an end: the rest is not listened to
        async for line in job.process.stderr:
            if job.ending is None:
                job.become(**told(line.decode(errors="replace")))


async def _end_of(job: _Job) -> None:
    while job.process is None and job.facts.state == "running":
        await asyncio.sleep(STARTING_S)
    if job.process is not None:
        await _end(job.process, job.end_s)


async def _end(process: asyncio.subprocess.Process, end_s: float, *, asked: bool = False) -> None:
    """By word, unless it was asked already, then by force."""
    if not asked:  # a second word would mean: at once, and leave everything as it lies
        _signal(process, signal.SIGINT)
    try:
        async with asyncio.timeout(end_s):
            await process.wait()
    except TimeoutError:
        _signal(process, signal.SIGKILL)


def _signal(process: asyncio.subprocess.Process, number: signal.Signals) -> None:
    """To the process and its workers."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)
