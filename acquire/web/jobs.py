"""Long-running work as `acquire` commands, one at a time and niced, each with its latest progress.

::

    waiting ──▶ running ──▶ done | failed | stopped

A calibration step bypasses the queue, because the operator is waiting at the instrument with the target in
place. It occupies the instrument, so only one runs at a time, and it is always asked to end before it is
killed, so that it leaves the instrument as it was.
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
from acquire.web.job_words import calibration_words, free_name, progress_facts, recording_words
from acquire.web.messages import CalibrationRequest, JobFacts, JobRequest
from acquire.web.worker import OWNER

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.web.archive import Archive

MOST_WAITING = 16
MOST_LISTED = 50
END_S = 15.0
"""Time for a stopped job to save its best result so far."""
CALIBRATION_END_S = 180.0
"""Time for a stopped step to seal its recording, evaluate it and leave the instrument as it was."""
LEAVE_S = 3.0
"""Time for a step when the page ends, for which the daemon does not wait much longer."""
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

    def update(self, **facts: object) -> None:
        self.facts = self.facts.model_copy(update=facts)


class Jobs:
    """Belongs to one event loop, in which `run` must run."""

    def __init__(self, directory: Path, archive: Archive, socket: Path) -> None:
        self._directory, self._socket = directory, socket
        self._archive = archive
        self._jobs: dict[int, _Job] = {}
        self._count = 0
        self._added = asyncio.Event()
        self._step: asyncio.Task[None] | None = None

    def list(self) -> list[JobFacts]:
        """Return the jobs, newest first."""
        return [job.facts for job in reversed(self._jobs.values())]

    def add(self, request: JobRequest) -> JobFacts:
        """Queue a job. Raises PlaceError if there is no such recording, StateError if the queue is full."""
        # The name comes from a browser: this refuses one that leads out of the directory.
        name = self._archive.path_of(request.recording).name
        request = request.model_copy(update={"recording": name})
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
        """Carry out a step at once, for the calibration at ``out``.

        Raises UsageError if there is no such step, StateError while another step is running.
        """
        step = step_of(request)
        self.refuse_while_calibrating()
        facts = JobFacts(
            id=self._next(), kind="calibrate", step=step.name, lines=request.lines, state="running"
        )
        job = _Job(facts, request, calibration_words(request, out), WHO.get(), CALIBRATION_END_S)
        self._keep(job)
        self._step = asyncio.create_task(self._try(job))
        return facts

    def refuse_while_calibrating(self) -> None:
        """Raise StateError while a calibration step is running."""
        if any(job.facts.state == "running" for job in self._jobs.values() if job.facts.kind == "calibrate"):
            raise StateError(
                "a calibration step is already running", hint="wait until it is done, or stop it"
            )

    def _next(self) -> int:
        self._count += 1
        return self._count

    def _keep(self, job: _Job) -> None:
        self._jobs[job.facts.id] = job
        ended = [
            number for number, job in self._jobs.items() if job.facts.state not in ("waiting", "running")
        ]
        for number in ended[: max(0, len(self._jobs) - MOST_LISTED)]:
            del self._jobs[number]

    async def stop(self, number: int) -> JobFacts:
        """Stop a job; a running one saves its best result so far. Raises PlaceError."""
        job = self._jobs.get(number)
        if job is None:
            raise PlaceError(f"there is no job {number}", possible="/api/jobs")
        if job.facts.state == "waiting":
            job.update(state="stopped")
        elif job.facts.state == "running" and job.ending is None:
            job.update(text="ending with the result so far")
            job.ending = asyncio.create_task(_stop_process(job))
        return job.facts

    async def run(self) -> None:
        """Carry out jobs until cancelled; a running job is then ended."""
        try:
            while True:
                job = next((each for each in self._jobs.values() if each.facts.state == "waiting"), None)
                if job is None:
                    self._added.clear()
                    await self._added.wait()
                    continue
                await self._try(job)
        finally:
            # A step runs beside the queue, and must be given time to leave the instrument as it was.
            if self._step is not None:
                self._step.cancel()
                await asyncio.gather(self._step, return_exceptions=True)

    async def _try(self, job: _Job) -> None:
        try:
            await self._carry_out(job)
        except (OSError, AcquireError) as error:
            job.update(state="failed", text=str(error))
        except Exception as error:  # a defect, or no thread for its process: the others still have their turn
            log.exception("job %d", job.facts.id)
            job.update(state="failed", text=f"it could not be carried out: {error!r}")

    async def _carry_out(self, job: _Job) -> None:
        name, words = "", job.words
        if isinstance(job.request, JobRequest):
            name = free_name(self._directory, job.request)
            words = recording_words(job.request, name)
        job.update(state="running", text="starting")
        job.process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "acquire.web.worker",
            *words,
            cwd=self._directory,
            env=os.environ
            | {"ACQUIRE_SOCKET": str(self._socket), "ACQUIRE_BY": job.by, OWNER: str(os.getpid())},
            stdin=asyncio.subprocess.DEVNULL,
            # The result is a file. A pipe that nobody reads would fill, and the command wait for ever.
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            limit=MOST_LINE_BYTES,
            # Workers are ended with their job, and a Ctrl-C on the page's terminal does not reach them.
            process_group=0,
        )
        try:
            await _follow_progress(job)
            code = await job.process.wait()
        except asyncio.CancelledError:
            # The page ends. A calibration step may have changed the instrument, so it is interrupted first.
            if job.facts.kind == "calibrate":
                await _end(job.process, LEAVE_S, interrupted=job.ending is not None)
            _signal(job.process, signal.SIGKILL)
            await job.process.wait()
            raise
        result = name if name and os.path.lexists(self._directory / name) else None
        state = "stopped" if job.ending is not None else "failed" if code else "done"
        text = job.facts.text if state == "failed" else ""
        if state == "stopped":
            kept = result if name else not code
            text = "the result so far was kept" if kept else "nothing was kept"
        job.update(state=state, text=text, result=result)
        job.process = None  # the job is listed for long, and its process holds a pipe with its buffers
        subject = job.facts.step or job.facts.recording
        log.info("job %d, %s of %s: %s", job.facts.id, job.facts.kind, subject, state)


async def _follow_progress(job: _Job) -> None:
    """Copy a job's progress reports into its facts, until it closes its standard error."""
    assert job.process is not None
    assert job.process.stderr is not None
    while True:
        try:
            line = await job.process.stderr.readline()
        except ValueError:
            # A part of a line that is too long is dropped. Reading goes on: a process whose pipe is full
            # waits for ever, and so would its job and all that are queued behind it.
            continue
        if not line:
            return
        # Once it is being stopped, the text that says so stays.
        if job.ending is None:
            job.update(**progress_facts(line.decode(errors="replace")))


async def _stop_process(job: _Job) -> None:
    # It was stopped while its process was being started: wait until there is one to signal.
    while job.process is None and job.facts.state == "running":
        await asyncio.sleep(STARTING_S)
    if job.process is not None:
        await _end(job.process, job.end_s)


async def _end(process: asyncio.subprocess.Process, end_s: float, *, interrupted: bool = False) -> None:
    """Interrupt a process, unless it already was, and kill it if it does not end in time."""
    if not interrupted:  # a second interrupt would make it end at once, without cleaning up
        _signal(process, signal.SIGINT)
    try:
        async with asyncio.timeout(end_s):
            await process.wait()
    except TimeoutError:
        _signal(process, signal.SIGKILL)


def _signal(process: asyncio.subprocess.Process, number: signal.Signals) -> None:
    """Send a signal to a process and its workers."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)
