"""Recordings for a calibration, made by the running daemon, which is left armed or idle as it was before."""

from __future__ import annotations

import os
import shlex
import sys
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from acquire.cli.interrupts import stop_on_interrupt
from acquire.cli.output import note, print_facts, print_warning
from acquire.daemon.states import State, refusal
from acquire.daemon.who import LONGEST, WHO
from acquire.errors import AcquireError, DataError, StateError, StoreError, UsageError
from acquire.text import counted

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from acquire.calibrate.calibration import Calibration, Finding
    from acquire.calibrate.exposure import Exposure
    from acquire.client import Client
    from acquire.daemon.messages import Status, TriggerDelays, TriggerWindow
    from acquire.daemon.options import LightCode

SEALED_S = 120.0
"""Longest wait for a recording to be sealed, in addition to the duration of its lines."""
POLL_S = 0.1
CALM_S = 1.0
"""Time without a running command after an interrupt: a command sent just before it may still begin."""
TRIES = 3
BY = "ACQUIRE_BY"
"""Environment variable with the name of the user on whose behalf the operator's page runs the command."""
MOST_LOST = 0.1
"""Share of a recording's lines that may be lost without harm to the calibration."""


@contextmanager
def instrument(socket: Path | None, directory: Path, out: str) -> Iterator[Client]:
    """Connect to an idle or armed daemon, create ``directory``, and restore the daemon's state at the end.

    Raises UsageError if the calibration at ``out`` is of another instrument.
    """
    from acquire.cli.progress import waiting_printer
    from acquire.client import Client
    from acquire.store.refusals import refused

    # The page runs this command: the recording's events must name who pressed the button.
    WHO.set(os.environ.get(BY, "")[:LONGEST])
    with Client(socket, waiting_printer()) as daemon:
        status = daemon.status()
        if status.state is State.FAULTED:
            raise refusal("calibrating is impossible while the daemon is faulted", status.state, status.fault)
        if status.state not in ("idle", "armed"):
            now = f"{status.state} {status.recording.path if status.recording else ''}".strip()
            raise StateError(f"the daemon is {now}", possible="idle or armed", hint="acquire stop, or disarm")
        _refuse_other_rig(daemon, out, armed=False)
        # Only now, so that a daemon in another state leaves no empty directory.
        with refused(directory, "created"):
            directory.mkdir(parents=True, exist_ok=True)
        calm_s = CALM_S
        try:
            yield daemon
            calm_s = 0.0  # every command has been answered
        finally:
            # The same run: the command ended before it armed anything, and there is nothing to restore.
            if _settled(daemon, calm_s).run_id != status.run_id:
                _leave(daemon, directory, armed=status.state is State.ARMED)


@contextmanager
def series(
    socket: Path | None, directory: Path, out: str, prepare: str, *, ask: bool
) -> Iterator[tuple[Client, threading.Event]]:
    """Connect as `instrument` does for a series of recordings, and return what Ctrl-C sets to end it early.

    ``prepare`` says what to put in front of the lens; with ``ask``, Enter confirms that it is there.
    """
    # Before the scene is put in, and Enter pressed: this may refuse the rig.
    with instrument(socket, directory, out) as daemon:
        note(prepare)
        if ask:
            wait_for_enter()
        with stop_on_interrupt("ending with the recordings made so far") as stop_requested:
            yield daemon, stop_requested


def record(
    daemon: Client,
    name: str,
    directory: Path,
    lines: int,
    out: str,
    *,
    code: LightCode = "rig",
    delays: TriggerDelays | None = None,
    window: TriggerWindow | None = None,
) -> Exposure:
    """Arm with the given light and timing, record ``NAME-1.zarr`` (or the next free number) and disarm.

    A recording that lost lines, as on a busy host, is repeated. Raises DataError if every attempt lost lines,
    and UsageError, before it records, for cameras of which the calibration at ``out`` is not.
    """
    from acquire.calibrate.exposure import open_exposure
    from acquire.client import SEALED
    from acquire.store import open_recording

    for _ in range(TRIES):
        # Light and delays can be given only when arming.
        if daemon.status().state == "armed":
            daemon.disarm()
        # Without a calibration: the rig may name the very one that is being made, and that does not exist
        # yet.
        daemon.arm(code=code, calibration="none", delays=delays, window=window)
        # Gains, directions and the like are known only now.
        _refuse_other_rig(daemon, out, armed=True)
        path = free_path(directory, name)
        status = daemon.start(path, lines=lines)
        # An arm that has just been armed may show no rate yet.
        rates = [arm.rate_hz for arm in status.arms.values() if arm.rate_hz > 0]
        daemon.wait(SEALED, timeout_s=SEALED_S + lines / min(rates, default=1000.0))
        daemon.disarm()
        made = open_recording(path)
        # A recording may also end early, without a gap, as when a camera stalls.
        missing = max(0, lines - made.lines) + sum(gap.count for gap in made.gaps)
        if missing <= MOST_LOST * lines:
            return open_exposure(path)
        ended = f"{made.attrs['run_condition']}: {made.attrs['end_reason']}"
        print_warning(f"{path} lacks {counted(missing, 'line')} of {lines} per arm ({ended})")
    raise DataError(
        f"{TRIES} recordings lacked lines, the last one {missing} of {lines} per arm ({ended})",
        possible=f"up to {int(MOST_LOST * lines)} missing lines of both arms together",
        hint="acquire bench, to check whether this host keeps up; a longer stream.stall_s, if it only starts "
        "late",
    )


def free_path(directory: Path, name: str) -> Path:
    """Return the first path ``NAME-<number>.zarr`` that does not exist: earlier recordings are kept."""
    number = 1
    # The daemon has a working directory of its own.
    while (path := directory.absolute() / f"{name}-{number}.zarr").exists():
        number += 1
    return path


def refuse_other(out: str, exposures: Iterable[Exposure]) -> None:
    """Raise UsageError for recordings of another instrument than an existing calibration at ``out``."""
    if (known := _known_at(out)) is not None:
        for each in exposures:
            known.check_same(each.instrument, str(each.recording), out)


def _refuse_other_rig(daemon: Client, out: str, *, armed: bool) -> None:
    """Raise UsageError if the calibration at ``out`` is of another instrument than the daemon's."""
    from pydantic import ValidationError

    from acquire.calibrate.choose import check_rig
    from acquire.config import RigConfig

    if (known := _known_at(out)) is None:
        return
    setup = daemon.setup()
    try:
        config = RigConfig.model_validate(setup.config)
    except ValidationError:
        return  # a daemon of another version: its recordings will tell
    # Before, they are what the cameras were when they were armed last.
    devices = setup.devices if armed else []
    reported = {each.device.removeprefix("camera "): each.settings for each in devices}
    check_rig(known, out, config, reported)


def _known_at(out: str) -> Calibration | None:
    from acquire.calibrate import open_calibration
    from acquire.store.source import source_of

    return open_calibration(out) if source_of(out).exists() else None


def save_finding(
    out: str,
    exposures: Sequence[Exposure],
    evaluate: Callable[[Calibration], Finding],
    steps: Iterable[str],
    *,
    first: bool = True,
) -> Finding:
    """Evaluate exposures and add the result to the calibration at ``out``.

    ``steps`` are those that the exposures are to complete, from this one on. ``first``: it may be the
    calibration's first. Raises UsageError if the exposure does not determine the orientation, and what
    `recordings_kept` raises if there is no place for the result any more.
    """
    from acquire.calibrate import Calibration, open_calibration
    from acquire.calibrate.file import change_calibration

    begun = Calibration(exposures[0].instrument)
    with recordings_kept(out, exposures, steps):
        known = _known_at(out) or begun if first else open_calibration(out)
    found = evaluate(known)
    if found.step == "orientation" and found.orientation is None:
        raise UsageError(f"orientation: {found.warnings[0]}")
    with recordings_kept(out, exposures, steps):
        # Of what is there now: another command may have added a step during the evaluation.
        change_calibration(out, lambda now: now.with_step(found), new=begun if first else None)
    return found


@contextmanager
def recordings_kept(out: str, exposures: Sequence[Exposure], steps: Iterable[str]) -> Iterator[None]:
    """If the calibration cannot be read or written any more, say how to evaluate the recordings later.

    A UsageError becomes a StoreError: the place was usable before the recordings were made.
    """
    try:
        yield
    except AcquireError as error:
        places = shlex.join(str(each.recording.path) for each in exposures)
        later = " && ".join(f"acquire calibrate {step} {places} --out {shlex.quote(out)}" for step in steps)
        kept = "the recording is" if len(exposures) == 1 else f"the {len(exposures)} recordings are"
        kind = StoreError if isinstance(error, UsageError) else type(error)
        raise kind(
            f"{error.message}; {kept} kept",
            possible=error.possible,
            hint="; ".join(filter(None, (error.hint, f"then {later}"))),
        ) from error


def print_finding(found: Finding, more: Mapping[str, Any] | None = None) -> None:
    """Print a finding, ``more`` facts after it, and its warnings."""
    from acquire.calibrate.words import found_facts

    print_facts(found_facts(found) | dict(more or {}))
    for text in found.warnings:
        print_warning(text)


def wait_for_enter() -> None:
    """Wait for Enter. Raises StateError if standard input is closed."""
    note("press Enter to continue, or Ctrl-C to end; the results so far are saved")
    if not sys.stdin.readline():
        raise StateError(
            "Enter cannot be pressed: standard input is closed", hint="--yes, if everything is in place"
        )


def _settled(daemon: Client, calm_s: float) -> Status:
    """Return the status once no command has been running for ``calm_s``.

    After an interrupt, a command that was already sent (such as arm) is still carried out.
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
    """Restore the state of the instrument, unless somebody else has started a recording in the meantime."""
    from acquire.client import SEALED

    status = daemon.status()
    # A step that fails must not stop what somebody else has begun to record since.
    if status.recording is not None and status.recording.path.parent != directory.absolute():
        print_warning(
            f"{status.recording.path} is somebody else's recording, so the instrument stays as it is"
        )
        return
    if status.state == "recording":
        daemon.stop()
        status = daemon.wait(SEALED, timeout_s=SEALED_S)
    if status.state == "armed":
        daemon.disarm()
    if armed:
        # With the rig's own light, delays and calibration, which a step replaces.
        daemon.arm()
