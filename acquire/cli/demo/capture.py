"""The demo's recording: a daemon of its own, controlled through its socket like by any client."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.cli.demo.plan import trigger_settings
from acquire.cli.places import SOCKET, private_directory
from acquire.cli.progress import stage_progress
from acquire.client import Client
from acquire.daemon.states import SEALED, State
from acquire.errors import AcquireError, DataError, NoDaemonError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from acquire.cli.demo.plan import DemoPlan
    from acquire.cli.journal import StepJournal
    from acquire.config import RigConfig
    from acquire.daemon.messages import Status

LOG = "daemon.log"
START_TIMEOUT_S = 60.0
END_TIMEOUT_S = 30.0
STALL_TIMEOUT_S = 30.0
"""The recording is abandoned if no line was added for this time."""
POLL_S = 0.05


@dataclass(frozen=True, slots=True)
class Captured:
    """The recording, the daemon's last status and the duration of the capture."""

    path: Path
    status: Status
    seconds: float


def record(plan: DemoPlan, journal: StepJournal) -> Captured:
    """Start a daemon, arm, record, and end the daemon again; its log goes to daemon.log."""
    log, path = plan.out / LOG, plan.out / "recording.zarr"
    with private_directory() as directory:
        socket = directory / SOCKET
        with daemon(plan, socket) as process, Client(socket) as client:
            with journal.stage("Start the daemon") as note:
                await_daemon(client, process, log)
                note["detail"] = f"process {process.pid}"
            with journal.stage("Arm trigger and cameras"):
                client.arm(force=True)  # even on a slow host: simulated cameras wait for it
            with journal.stage("Record") as note:
                started = time.perf_counter()
                client.start(path, lines=plan.lines)
                with stage_progress("recording") as advance:
                    status = follow(client, plan.lines, advance)
                # The report compares with the truth: lines that are missing would be blamed on the solvers.
                if status.last is None or status.last.condition != "GOOD":
                    reason = status.fault or (
                        status.last and f"{status.last.condition}: {status.last.end_reason}"
                    )
                    raise DataError(
                        f"the recording {path} is not complete: {reason}", hint=f"acquire info {path}"
                    )
                captured = Captured(path, status, time.perf_counter() - started)
                note["detail"] = f"{plan.lines} lines of both arms"
            with journal.stage("End the daemon"):
                if not end(process):
                    raise AcquireError(f"the daemon was killed after {END_TIMEOUT_S:g} s", hint=str(log))
    return captured


@contextmanager
def removed_if_interrupted(directory: Path) -> Iterator[None]:
    """If Ctrl-C comes before a recording was begun, remove the directory, with the daemon's log and lock.

    After an error the directory stays, since the error refers to the log.
    """
    try:
        yield
    except KeyboardInterrupt:
        names = {each.name for each in directory.iterdir()}
        if all(name == LOG or name.endswith(".lock") for name in names):
            shutil.rmtree(directory)
        raise


def compile_gateware(rig: RigConfig, journal: StepJournal) -> None:
    """Compile the gateware before arming, which would otherwise wait for it, and report the clock rate."""
    from acquire.sim import rtl

    timing = rig.trigger
    with journal.stage("Compile the trigger's gateware") as note:
        rtl.build(timing.clock_hz)
        substep_us = 1e6 * timing.substep_ticks / timing.clock_hz
        note["detail"] = (
            f"{timing.substep_ticks} clocks per sub-step of {substep_us:g} us; "
            "recording runs as fast as the simulation computes them"
        )


@contextmanager
def daemon(plan: DemoPlan, socket: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run ``acquire serve`` for the demo."""
    # The daemon measures the disk of its directory, and keeps a lock there that is not removed.
    settings = {"code.seed": plan.seed, "recording.directory": str(plan.out), **trigger_settings(plan)}
    options = [f"--config={plan.config}", f"--socket={socket}"]
    # --set takes TOML, in which numbers and texts look as in JSON.
    options += [f"--set={key}={json.dumps(value, ensure_ascii=False)}" for key, value in settings.items()]
    with daemon_process(options, plan.out / LOG) as process:
        yield process


@contextmanager
def daemon_process(options: list[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run ``acquire serve`` in a process of its own, which is ended with the block in any case."""
    # Even if this process is killed, the daemon ends: its standard input is then closed (--owned).
    command = [sys.executable, "-m", "acquire", "serve", "--owned", *options]
    with (
        log.open("wb") as file,
        subprocess.Popen(  # noqa: S603  # the command is our own program
            command, stdin=subprocess.PIPE, stderr=file, stdout=file
        ) as process,
    ):
        try:
            yield process
        finally:
            end(process)


def end(process: subprocess.Popen[bytes], timeout_s: float = END_TIMEOUT_S) -> bool:
    """Ask the daemon to seal its recording and end. Return False if it took too long and was killed."""
    process.terminate()
    try:
        process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        # A daemon that hangs would otherwise keep its devices, and its recording unsealed.
        process.kill()
        process.wait()
        return False
    return True


def await_daemon(client: Client, process: subprocess.Popen[bytes], log: Path) -> None:
    """Wait until the daemon answers. Raises AcquireError with the end of its log if it ended instead."""
    deadline = time.monotonic() + START_TIMEOUT_S
    while True:
        try:
            client.status()
        except NoDaemonError:
            if process.poll() is not None:
                # The error is at the end; the hint names the whole log.
                last = log.read_text(errors="replace").strip().splitlines()[-3:]
                why = " ".join(last) or "its log is empty, as on a disk that is full"
                raise AcquireError(f"the daemon ended at once: {why}", hint=str(log)) from None
            if time.monotonic() > deadline:
                raise
            time.sleep(POLL_S)
        else:
            return


def follow(client: Client, lines: int, advance: Callable[[int, int], None]) -> Status:
    """Poll until the recording is sealed. Raises DataError if no line is added for `STALL_TIMEOUT_S`."""
    latest, grew_s = -1, time.monotonic()
    while (status := client.status()).state not in SEALED | {State.FAULTED}:
        now = status.recording.recorded_lines if status.recording else lines
        advance(now, lines)
        if now != latest:
            latest, grew_s = now, time.monotonic()
        elif time.monotonic() - grew_s > STALL_TIMEOUT_S:
            raise DataError(f"no line was recorded for {STALL_TIMEOUT_S:g} s", hint="acquire status")
        time.sleep(POLL_S)
    return status
