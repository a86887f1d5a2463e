"""``acquire arm | start | stop | disarm | status``: one command to the daemon each."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.durations import seconds
from acquire.cli.output import JsonFlag, print_facts, print_json, print_table, print_warning, quantity, say
from acquire.errors import DataError, UsageError

if TYPE_CHECKING:
    from acquire.client import Client
    from acquire.daemon.messages import (
        ArmStatus,
        CheckStatus,
        DiskStatus,
        LastRecording,
        Status,
        TriggerStatus,
        UploadStatus,
    )

SocketOption = Annotated[
    Path | None, typer.Option("--socket", envvar="ACQUIRE_SOCKET", help="The daemon's control socket.")
]
SEALED_WORD = "sealed"
"""For ``status --wait``: any state in which no recording is under way."""
DAMAGED = ("INCOMPLETE", "ABORTED", None)
"""Conditions of a recording that lost something."""
RECOVERIES = UPLOADS = TROUBLES = 3
"""Recordings not sealed, or on their way to a store, of which the status tells in words; --json has more."""


def register(app: typer.Typer) -> None:
    for command in (arm, start, mark, stop, disarm, status):
        app.command(rich_help_panel="Capture")(command)


def arm(
    force: Annotated[
        bool,
        typer.Option("--force", help="Even where this host is too slow, or the store of uploads refuses."),
    ] = False,
    code: Annotated[
        str, typer.Option(help="What the light follows: rig, its code; dark, it stays off; steady, on.")
    ] = "rig",
    without_calibration: Annotated[
        bool,
        typer.Option(
            "--without-calibration", help="Recordings get no copy of the calibration in the rig file."
        ),
    ] = False,
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """Start trigger and cameras; nothing is written yet.

    The daemon measures first what ring, codec and disk sustain here (a second; valid for ten minutes), and
    refuses, exit code 2, where the best of three measurements is less than what is configured; simulated
    cameras wait for a busy host, and get a warning. So it does where recordings are to be
    uploaded and the store says no; one that cannot be reached is a warning.

    Example: [bold]acquire arm[/]
    """
    with _daemon(socket) as daemon:
        calibration = "none" if without_calibration else "rig"
        status = daemon.arm(force=force, code=code, calibration=calibration)  # type: ignore[arg-type]  # checked there
    _show(status, json)
    if status.calibration is not None and not status.calibration.carried:
        print_warning(f"recordings carry no calibration: {status.calibration.text}")


def start(
    path: Annotated[
        Path | None, typer.Argument(metavar="[RECORDING]", help="New recording; else named by rig and time.")
    ] = None,
    lines: Annotated[int | None, typer.Option(help="Stop after so many lines.")] = None,
    duration: Annotated[
        float | None, typer.Option(parser=seconds, metavar="TIME", help="Stop after 5s, 500ms, 2min.")
    ] = None,
    pre: Annotated[
        float | None, typer.Option(parser=seconds, metavar="TIME", help="Of that, from before: see the ring.")
    ] = None,
    post: Annotated[
        float | None, typer.Option(parser=seconds, metavar="TIME", help="Stop so long after this command.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a sealed RECORDING, in a segment beside it.")
    ] = False,
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """Record from the next line on, or from before it; until stopped, or for some lines or time.

    Example: [bold]acquire start run.zarr --lines 100000[/], or [bold]acquire start --pre 2s --post 1s[/]
    """
    with _daemon(socket) as daemon:
        status = daemon.start(
            path, lines=lines, duration_s=duration, pre_s=pre or 0.0, post_s=post, resume=resume
        )
        _show(status, json)


def mark(
    text: Annotated[str, typer.Argument(help="What happens, in your words.")] = "",
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """Note that something happens now. While armed it starts a recording, where the rig's events say so.

    Example: [bold]acquire mark "the valve opens"[/]
    """
    with _daemon(socket) as daemon:
        _show(daemon.mark(text), json)


def stop(socket: SocketOption = None, json: JsonFlag = False) -> None:
    """End the recording; returns once it is sealed. Exit code 6 if lines were lost.

    The instrument stays armed for the next recording, unless the rig says recording.after = "idle".

    Example: [bold]acquire stop[/]
    """
    with _daemon(socket) as daemon:
        status = daemon.stop()
    _show(status, json)
    if status.last is not None and status.last.condition in DAMAGED:
        raise DataError(_damage(status.last), hint=f"acquire info {status.last.path}")


def disarm(socket: SocketOption = None, json: JsonFlag = False) -> None:
    """Stop trigger and cameras, or clear a fault.

    Example: [bold]acquire disarm[/]
    """
    with _daemon(socket) as daemon:
        _show(daemon.disarm(), json)


def status(
    wait: Annotated[
        str | None,
        typer.Option(
            metavar="STATE",
            help="First wait for this state, or for 'sealed': no recording is under way any more.",
        ),
    ] = None,
    timeout: Annotated[float, typer.Option(metavar="SECONDS", help="Longest wait; then exit code 4.")] = 60.0,
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """What the daemon is doing, and how well.

    Example: [bold]acquire status --wait sealed --timeout 30[/]
    """
    from acquire.daemon.states import SEALED, State

    waits = {SEALED_WORD: SEALED, **{str(state): frozenset({state}) for state in State}}
    if wait is not None and wait not in waits:
        raise UsageError(f"--wait {wait} is no state", possible=", ".join(waits))
    with _daemon(socket) as daemon:
        _show(daemon.status() if wait is None else daemon.wait(waits[wait], timeout), json)


def _daemon(socket: Path | None) -> Client:
    from acquire.cli.progress import teller
    from acquire.client import Client

    return Client(socket, teller())


def _damage(last: LastRecording) -> str:
    return f"recording {last.path} is {last.condition or 'not sealed'}: {last.end_reason or 'no end reason'}"


def _show(status: Status, json: bool) -> None:
    if json:
        print_json(status.model_dump(mode="json"))
        return
    print_facts(
        {
            "state": f"{status.state} since {status.since:%Y-%m-%d %H:%M:%S} UTC",
            "busy": status.busy,
            "waiting": status.waiting,
            "fault": status.fault,
            "rig": f"{status.name} (process {status.pid}, up {status.uptime_s:.0f} s)",
            "run": status.run_id,
            "recording": _recording(status),
            "last": _last(status.last),
            "not sealed": _recoveries(status),
            "uploads": _uploads(status),
            "disk": _disk(status.disk),
            "trigger": _trigger(status.trigger),
            "sustains": _capacity(status),
            "calibration": status.calibration and status.calibration.text,
            "troubles": _troubles(status),
            "possible": ", ".join(status.possible),
        }
    )
    if status.arms:
        _show_arms(status)


def _recording(status: Status) -> str | None:
    now = status.recording
    if now is None:
        return None
    budget = "" if now.budget_lines is None else f" of {now.budget_lines}"
    return (
        f"{now.path}, {now.recorded_lines}{budget} lines from line {now.first_line} on, "
        f"{now.committed_lines} readable"
    )


def _capacity(status: Status) -> str | None:
    found = status.capacity
    if found is None or found.warning is not None:
        return None if found is None else f"WARNING: {found.warning}"
    sustained, configured = quantity(found.sustained_hz or 0, "Hz"), quantity(found.line_rate_hz, "Hz")
    with_codec = "" if found.codec in (None, "none") else f" with {found.codec}"
    return f"lines at {sustained}{with_codec} (the {found.limit} allows least); configured {configured}"


def _last(last: LastRecording | None) -> str | None:
    if last is None:
        return None
    return f"{last.path}, {last.lines} lines, {last.condition or 'not sealed'} ({last.end_reason})"


def _recoveries(status: Status) -> str | None:
    """Recordings that their recorder did not seal, and what the daemon made of them."""
    shown = [
        f"{one.path.name} {one.state}: {one.text.removeprefix('recovered: ')}"
        for one in status.recoveries[-RECOVERIES:]
    ]
    more = len(status.recoveries) - len(shown)
    return "; ".join([*shown, *([f"and {more} before"] if more else [])]) or None


def _uploads(status: Status) -> str | None:
    """Recordings on their way to the remote store, those that are not there yet last."""
    found = sorted(status.uploads, key=lambda one: one.state != "copied")
    shown = [f"WARNING: {status.upload_warning}"] if status.upload_warning else []
    if status.uploads_left > UPLOADS:
        shown.append(f"{status.uploads_left} recordings are not copied yet")
    return "; ".join([*shown, *map(_upload, found[-UPLOADS:])]) or None


def _troubles(status: Status) -> str | None:
    """Failures in what nobody asked for; the daemon's log has more of them."""
    shown = [f"{one.text} ({one.times} times)" for one in status.troubles[-TROUBLES:]]
    return "; ".join(shown) or None


def _upload(one: UploadStatus) -> str:
    waiting = f", {one.waiting_lines} more here" if one.waiting_lines else ""
    why = f": {one.error}" if one.error else ""
    hint = f" (try: {one.hint})" if one.error and one.hint else ""
    return f"{one.path.name} {one.state}, {one.lines} lines there{waiting}{why}{hint}"


def _show_arms(status: Status) -> None:
    """A column for each arm: as narrow as a terminal can be."""
    columns = [_arm(arm) for arm in status.arms.values()]
    say()
    print_table(("arm", *status.arms), [(name, *(column[name] for column in columns)) for name in columns[0]])


def _arm(arm: ArmStatus) -> dict[str, str]:
    ring, ledger = arm.ring, arm.ledger
    return {
        "rate": quantity(arm.rate_hz, "Hz"),
        "delivered": str(arm.delivered),
        "preroll": str(arm.preroll),
        "recorded": str(arm.recorded),
        "missing": str(arm.missing),
        "lost": ", ".join(f"{cause} {lines}" for cause, lines in arm.lost.items() if lines) or "0",
        "saturated": f"{arm.saturated} ({arm.saturated_part:.1%} now)",
        "ring": f"{ring.fill} of {ring.slots}, peak {ring.peak}",
        "drops": str(ring.drops),
        "code": _check(arm.check),
        "clock": f"{arm.drift_ppb / 1000:+.3f} ppm" if arm.drift_ppb else "-",
        "ledger": "-" if ledger is None else "balances" if ledger.balanced else "DOES NOT BALANCE",
    }


def _trigger(trigger: TriggerStatus | None) -> str | None:
    if trigger is None:
        return None
    answers = "answers" if trigger.answers else f"SILENT for {trigger.silent_s:.0f} s"
    clock = f"clock {quantity(trigger.clock_hz, 'Hz')}, UTC known to {trigger.uncertainty_ns / 1000:.3g} us"
    return f"{answers}, {trigger.pulses} lines, {clock}"


def _disk(disk: DiskStatus | None) -> str | None:
    """How long recordings can go on."""
    if disk is None:
        return None
    rate = quantity(disk.bytes_per_s, "B/s")
    return (
        f"{disk.directory}, {quantity(disk.free_bytes, 'B')} free, "
        f"full in {_long(disk.seconds_to_full)} at {rate}"
    )


def _long(seconds: float) -> str:
    """A time that is looked at, not calculated with."""
    for unit, length_s in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * length_s:
            return f"{seconds / length_s:.3g} {unit}"
    return f"{seconds:.0f} s"


def _check(check: CheckStatus | None) -> str:
    """What the lines say of the light's code."""
    if check is None:
        return "-"
    verdict = check.verdict.replace("_", " ")
    return f"{verdict} {check.shift:+d}" if check.shift else verdict
