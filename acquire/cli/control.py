"""``acquire arm | start | stop | disarm | status | reload``: one command to the daemon each."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.completion import states
from acquire.cli.durations import seconds
from acquire.cli.output import JsonFlag, print_json, print_warning, say
from acquire.cli.status_page import show, show_document
from acquire.daemon.glance import NO_ANSWER, status_document
from acquire.errors import DataError, UsageError
from acquire.text import did_you_mean, shown

if TYPE_CHECKING:
    from acquire.client import Client

SocketOption = Annotated[
    Path | None, typer.Option("--socket", envvar="ACQUIRE_SOCKET", help="Control socket of the daemon.")
]
SEALED_WORD = "sealed"
"""For ``status --wait``: any state in which no recording is under way."""
DAMAGED = ("INCOMPLETE", "ABORTED", None)
"""Conditions of a recording that lost something."""


def register(app: typer.Typer) -> None:
    for command in (arm, start, mark, stop, disarm, status, reload):
        app.command(rich_help_panel="Capture")(command)


def arm(
    force: Annotated[
        bool,
        typer.Option("--force", help="Arm even if this host is too slow or the store of uploads refuses."),
    ] = False,
    code: Annotated[
        str,
        typer.Option(
            help="What the light follows: rig (the rig's code), dark (it stays off) or steady (it stays on)."
        ),
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
    show(status, json)
    if status.calibration is not None and not status.calibration.carried:
        print_warning(f"recordings carry no calibration: {status.calibration.text}")


def start(
    path: Annotated[
        Path | None,
        typer.Argument(metavar="RECORDING", help="New recording NAME.zarr; absent: named by rig and time."),
    ] = None,
    lines: Annotated[int | None, typer.Option(help="End after this number of lines.")] = None,
    duration: Annotated[
        float | None,
        typer.Option(parser=seconds, metavar="TIME", help="End after this time: 5, 5s, 500ms, 2min."),
    ] = None,
    pre: Annotated[
        float | None,
        typer.Option(
            parser=seconds,
            metavar="TIME",
            help="Begin this long before the command, with lines that the rings still hold.",
        ),
    ] = None,
    post: Annotated[
        float | None,
        typer.Option(
            parser=seconds,
            metavar="TIME",
            help="End this long after the command, whatever --pre adds before it.",
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue a sealed RECORDING in a new segment beside it.")
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
        show(status, json)


def mark(
    text: Annotated[str, typer.Argument(help="Text of the mark: what happens, in your words.")] = "",
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """Note that something happens now. While armed it starts a recording, where the rig's events say so.

    Example: [bold]acquire mark "the valve opens"[/]
    """
    with _daemon(socket) as daemon:
        show(daemon.mark(text), json)


def stop(socket: SocketOption = None, json: JsonFlag = False) -> None:
    """End the recording; returns once it is sealed. Exit code 6 if lines were lost.

    The instrument stays armed for the next recording, unless the rig says recording.after = "idle".

    Example: [bold]acquire stop[/]
    """
    with _daemon(socket) as daemon:
        status = daemon.stop()
    show(status, json)
    last = status.last
    if last is not None and last.condition in DAMAGED:
        became = f"{last.condition or 'not sealed'}: {last.end_reason or 'no end reason'}"
        raise DataError(f"recording {last.path} is {became}", hint=f"acquire info {last.path}")


def disarm(socket: SocketOption = None, json: JsonFlag = False) -> None:
    """Stop trigger and cameras, or clear a fault.

    Example: [bold]acquire disarm[/]
    """
    with _daemon(socket) as daemon:
        show(daemon.disarm(), json)


def reload(socket: SocketOption = None, json: JsonFlag = False) -> None:
    """Have the service read its rig file anew, and apply what has changed, also while it records.

    The log level, hooks, the page, the disk's reserve and what is kept of endless recordings can change. A
    file that changes anything else, such as cameras, geometry or code, is refused as a whole, exit code 2,
    with the keys: end the service when it is idle and start it anew.

    Example: [bold]acquire reload[/]
    """
    with _daemon(socket) as daemon:
        done = daemon.reload()
    if json:
        print_json(done.model_dump(mode="json"))
        return
    for one in done.changed:
        say(f"{one.key} = {shown(one.new)} {one.holds}; it was {shown(one.old)}")
    if not done.changed:
        say(f"{done.file} says what it said before")


def status(
    wait: Annotated[
        str | None,
        typer.Option(
            metavar="STATE",
            help="First wait for this state of the daemon, or for 'sealed': no recording is under way.",
            autocompletion=states,
        ),
    ] = None,
    timeout: Annotated[
        float,
        typer.Option(
            parser=seconds, metavar="TIME", help="Longest time that --wait waits; then exit code 4."
        ),
    ] = 60.0,
    watch: Annotated[
        bool, typer.Option("--watch", "-w", help="Show the status again and again, until Ctrl-C.")
    ] = False,
    every: Annotated[
        float,
        typer.Option(parser=seconds, metavar="TIME", help="Time from one answer of --watch to the next."),
    ] = 1.0,
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """Show what the daemon is doing, and how well.

    --watch redraws the status on a terminal; elsewhere every answer is one line, with --json one of JSON.

    Example: [bold]acquire status --wait sealed --timeout 30s[/], or [bold]acquire status --watch[/]
    """
    if wait is not None:
        from acquire.daemon.states import SEALED, State

        waits = {SEALED_WORD: SEALED, **{str(state): frozenset({state}) for state in State}}
        if wait not in waits:
            near = did_you_mean(wait, waits)
            raise UsageError(f"the daemon has no state {wait!r}{near}", possible=", ".join(waits))
        with _daemon(socket) as daemon:
            reached = daemon.wait(waits[wait], timeout)
        if not watch:
            show(reached, json)
    if watch:
        from acquire.cli.watch import watch_status

        watch_status(socket, every, as_json=json)
    elif wait is None:
        _show_now(socket, json)


def _show_now(socket: Path | None, json: bool) -> None:
    """At once where a daemon of this version answers; the client has patience and words for the rest."""
    try:
        show_document(status_document(socket), json)
    except NO_ANSWER:
        with _daemon(socket) as daemon:
            show(daemon.status(), json)


def _daemon(socket: Path | None) -> Client:
    from acquire.cli.progress import teller
    from acquire.client import Client

    return Client(socket, teller())
