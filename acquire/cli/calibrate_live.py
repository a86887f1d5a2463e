"""Recordings that a calibration asks for, made by the running daemon; the instrument is left as it was."""

from __future__ import annotations

import os
import sys
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from acquire.cli.output import note, print_facts, print_warning
from acquire.daemon.who import LONGEST, WHO
from acquire.errors import DataError, StateError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from acquire.calibrate.calibration import Calibration, Finding
    from acquire.calibrate.exposure import Exposure
    from acquire.client import Client
    from acquire.daemon.messages import LightCode, Status, TriggerDelays, TriggerWindow

SEALED_S = 120.0
"""Longest wait for a recording to be sealed, beside the time that its lines take."""
POLL_S = 0.1
CALM_S = 1.0
"""Without a command under way: time for one to begin that was sent just before this was interrupted."""
TRIES = 3
BY = "ACQUIRE_BY"
"""Environment variable: who asked for this, where it is the page that carries it out for them."""
MOST_LOST = 0.1
"""Of a recording's lines: a calibration does without some."""


@contextmanager
def instrument(socket: Path | None, directory: Path) -> Iterator[Client]:
    """The daemon, idle or armed; in the end it is as it was. ``directory`` is made."""
    from acquire.cli.progress import teller
    from acquire.client import Client

    WHO.set(os.environ.get(BY, "")[:LONGEST])
    with Client(socket, teller()) as daemon:
        status = daemon.status()
        if status.state not in ("idle", "armed"):
            raise StateError(
                f"the daemon is {status.state}", possible="idle or armed", hint="acquire stop, or disarm"
            )
        directory.mkdir(parents=True, exist_ok=True)
        calm_s = CALM_S
        try:
            yield daemon
            calm_s = 0.0  # every command has been answered
        finally:
            if _settled(daemon, calm_s).run_id != status.run_id:
                _leave(daemon, directory, armed=status.state == "armed")


def record(
    daemon: Client,
    name: str,
    directory: Path,
    lines: int,
    *,
    code: LightCode = "rig",
    delays: TriggerDelays | None = None,
    window: TriggerWindow | None = None,
) -> Exposure:
    """Arm with the light and the timing that are wanted, record ``NAME-1.zarr`` or the next free, disarm.

    Again where lines were lost, which a busy host may do; DataError where they are each time.
    """
    from acquire.calibrate.exposure import open_exposure
    from acquire.store import open_recording

    for _ in range(TRIES):
        if daemon.status().state == "armed":
            daemon.disarm()
        daemon.arm(code=code, calibration="none", delays=delays, window=window)
        path = _recorded(daemon, free(directory, name), lines)
        made = open_recording(path)
        missing = max(0, lines - made.lines) + sum(gap.count for gap in made.gaps)
        if missing <= MOST_LOST * lines:
            return open_exposure(path)
        ended = f"{made.attrs['run_condition']}: {made.attrs['end_reason']}"
        print_warning(f"{path} lacks {missing} lines of {lines} per arm ({ended})")
    raise DataError(
        f"{TRIES} recordings lacked lines, the last one {missing} of {lines} per arm ({ended})",
        possible=f"up to {int(MOST_LOST * lines)}, of both arms together",
        hint="acquire bench (does this host keep up?); a longer stream.stall_s, where it only begins late",
    )


def _recorded(daemon: Client, path: Path, lines: int) -> Path:
    from acquire.client import SEALED

    status = daemon.start(path, lines=lines)
    rates = [arm.rate_hz for arm in status.arms.values() if arm.rate_hz > 0]
    daemon.wait(SEALED, timeout_s=SEALED_S + lines / min(rates, default=1000.0))
    daemon.disarm()
    return path


def free(directory: Path, name: str) -> Path:
    """A name that nothing has yet: what was recorded before stays."""
    number = 1
    while (path := directory.absolute() / f"{name}-{number}.zarr").exists():
        number += 1
    return path


def kept(out: str, exposure: Exposure, look: Callable[[Calibration], Finding]) -> Finding:
    """Look, and add what was found to the calibration at a place. UsageError where nothing can be told."""
    from acquire.calibrate import Calibration, open_calibration, save_calibration
    from acquire.store.source import source_of

    known = open_calibration(out) if source_of(out).exists() else Calibration(exposure.instrument)
    found = look(known)
    if found.step == "orientation" and found.orientation is None:
        raise UsageError(f"orientation: {found.warnings[0]}")
    save_calibration(out, known.with_step(found))
    return found


def tell_finding(found: Finding, more: Mapping[str, Any] | None = None) -> None:
    """Print what was found, ``more`` facts after it, and its warnings."""
    from acquire.calibrate.words import found_facts

    print_facts(found_facts(found) | dict(more or {}))
    for text in found.warnings:
        print_warning(text)


def wait_for_enter() -> None:
    """StateError where nobody can press it."""
    note("Enter goes on, Ctrl-C ends; what was found so far is kept")
    if not sys.stdin.readline():
        raise StateError("nobody is there to press Enter", hint="--yes, where everything is in place")


def _settled(daemon: Client, calm_s: float) -> Status:
    """The status once no command has been under way for so long.

    An interrupt does not call back an arm that has been sent.
    """
    begun = busy_at = time.monotonic()
    while True:
        status, now = daemon.status(), time.monotonic()
        if status.busy is not None:
            busy_at = now
        elif now - busy_at >= calm_s:
            return status
        if now - begun >= SEALED_S:
            return status
        time.sleep(POLL_S)


def _leave(daemon: Client, directory: Path, *, armed: bool) -> None:
    """The instrument as it was before; but what somebody else records meanwhile is theirs."""
    from acquire.client import SEALED

    status = daemon.status()
    if status.recording is not None and status.recording.path.parent != directory.absolute():
        print_warning(f"{status.recording.path} is somebody else's: the instrument is left to them")
        return
    if status.state == "recording":
        daemon.stop()
        status = daemon.wait(SEALED, timeout_s=SEALED_S)
    if status.state == "armed":
        daemon.disarm()
    if armed:
        daemon.arm()
