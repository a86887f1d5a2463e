"""``acquire arm | start | mark | stop | disarm | status | reload``: each sends one command to the daemon."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Unpack

import typer

from acquire.cli.completion import states
from acquire.cli.durations import seconds
from acquire.cli.output import JsonFlag, print_json, print_warning, say
from acquire.cli.spelled import spelled
from acquire.cli.status_page import show, show_document, without_code
from acquire.daemon.glance import NO_ANSWER, status_document
from acquire.daemon.options import ArmOptions, StartOptions
from acquire.errors import DataError, UsageError
from acquire.text import did_you_mean, shown

if TYPE_CHECKING:
    from acquire.client import Client

SocketOption = Annotated[
    Path | None, typer.Option("--socket", envvar="ACQUIRE_SOCKET", help="Control socket of the daemon.")
]
SEALED_WORD = "sealed"
"""Argument of ``status --wait``: any state in which no recording is in progress."""
# None: it was not sealed.
DAMAGED = ("INCOMPLETE", "ABORTED", None)
"""Conditions of a recording that lost lines."""


def register(app: typer.Typer) -> None:
    for command in (arm, start, mark, stop, disarm, status, reload):
        app.command(rich_help_panel="Capture")(command)


@spelled
def arm(
    *,
    without_calibration: Annotated[
        bool,
        typer.Option(
            "--without-calibration",
            help="Do not copy the calibration named in the rig file into the recordings.",
        ),
    ] = False,
    socket: SocketOption = None,
    json: JsonFlag = False,
    **options: Unpack[ArmOptions],
) -> None:
    """Start the trigger and the cameras without recording.

    The daemon first measures the line rate that the ring, the codec and the disk sustain on this host. The
    measurement takes half a second and is valid for ten minutes. If the best of three measurements is below
    the configured rate, arm is refused with exit code 2; with simulated cameras, which wait for a busy host,
    there is only a warning. Arm is also refused if recordings are to be uploaded and the store denies access;
    if the store cannot be reached, there is only a warning.

    Example: [bold]acquire arm[/]
    """
    if without_calibration:
        options["calibration"] = "none"
    with _daemon(socket) as daemon:
        status = daemon.arm(**options)
    show(status, json)
    if status.calibration is not None and not status.calibration.carried:
        print_warning(f"recordings carry no calibration: {status.calibration.text}")


@spelled
def start(
    path: Annotated[
        Path | None,
        typer.Argument(
            metavar="RECORDING", help="New recording NAME.zarr. Default: a name made of the rig and the time."
        ),
    ] = None,
    *,
    socket: SocketOption = None,
    json: JsonFlag = False,
    **options: Unpack[StartOptions],
) -> None:
    """Start recording, from the next line or from a few seconds ago.

    The recording ends at `acquire stop`, or after the given number of lines or time.

    Example: [bold]acquire start run.zarr --lines 100000[/], or [bold]acquire start --pre 2s --post 1s[/]
    """
    _check(path, options)
    with _daemon(socket) as daemon:
        status = daemon.start(path, **options)
    show(status, json)
    if status.light in ("dark", "steady"):
        print_warning(without_code(status.light))


def _check(path: Path | None, options: StartOptions) -> None:
    """Raise UsageError for options that exclude each other: the message of the API names no options."""
    if (lines := options.get("lines")) is not None and lines < 1:
        raise UsageError(f"--lines {lines} is out of range", possible="1 or more")
    given = {"--lines": "lines", "--duration": "duration_s", "--post": "post_s"}
    budgets = [option for option, name in given.items() if name in options]
    if len(budgets) > 1:
        raise UsageError(f"{' and '.join(budgets)} exclude each other", possible="one of them")
    pre, whole = options.get("pre_s", 0.0), options.get("duration_s")
    if whole is not None and pre >= whole:
        raise UsageError(
            f"--pre {pre:g}s cannot be as long as --duration {whole:g}s, which includes it",
            possible="a longer --duration, or --post, which does not include it",
        )
    if options.get("resume") and path is None:
        raise UsageError(
            "--resume needs the recording to continue",
            possible="acquire start --resume NAME.zarr",
            hint="acquire ls DIR lists those of a directory",
        )


def mark(
    text: Annotated[str, typer.Argument(metavar="TEXT", help="Text of the mark, in your own words.")] = "",
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """Mark the current moment in the recording. While armed, a mark can start one, if events.sources
    in the rig file contains "mark".

    Example: [bold]acquire mark "the valve opens"[/]
    """
    with _daemon(socket) as daemon:
        show(daemon.mark(text), json)


def stop(socket: SocketOption = None, json: JsonFlag = False) -> None:
    """End the recording and wait until it is sealed. The exit code is 6 if lines were lost.

    The instrument stays armed for the next recording, unless the rig file has recording.after = "idle".

    Example: [bold]acquire stop[/]
    """
    with _daemon(socket) as daemon:
        status = daemon.stop()
    # Shown before the error: the other lines are recorded all the same.
    show(status, json)
    last = status.last
    if last is not None and last.condition in DAMAGED:
        became = f"{last.condition or 'not sealed'}: {last.end_reason or 'no end reason'}"
        raise DataError(f"recording {last.path} is {became}", hint=f"acquire info {last.path}")


def disarm(socket: SocketOption = None, json: JsonFlag = False) -> None:
    """Stop the trigger and the cameras, or clear a fault.

    Example: [bold]acquire disarm[/]
    """
    with _daemon(socket) as daemon:
        show(daemon.disarm(), json)


def reload(socket: SocketOption = None, json: JsonFlag = False) -> None:
    """Make the daemon read its rig file again and apply the changes, even while it records.

    These settings can change: the log level, hooks, the operator's page, the disk reserve and the retention
    of endless recordings. If the file changes anything else, such as cameras, geometry or code, it is refused
    as a whole with exit code 2 and a list of the keys; restart the daemon while it is idle to apply those.

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
        say(f"{done.file} has not changed")


def status(
    wait: Annotated[
        str | None,
        typer.Option(
            metavar="STATE",
            help="First wait for this state of the daemon: idle, armed, recording, draining or faulted, or "
            "for sealed (no recording in progress).",
            autocompletion=states,
        ),
    ] = None,
    timeout: Annotated[
        float,
        typer.Option(
            parser=seconds,
            metavar="TIME",
            help="With --wait: time after which the command gives up, with exit code 4. Default: 60s.",
            show_default=False,
        ),
    ] = 60.0,
    watch: Annotated[
        bool, typer.Option("--watch", "-w", help="Keep showing the status until Ctrl-C.")
    ] = False,
    every: Annotated[
        float,
        typer.Option(
            parser=seconds,
            metavar="TIME",
            help="With --watch: time between two updates. Default: 1s.",
            show_default=False,
        ),
    ] = 1.0,
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """Show what the daemon is doing, and how well.

    On a terminal, --watch redraws the status in place. Elsewhere it prints one line per update, or one JSON
    object per line with --json.

    Example: [bold]acquire status --wait sealed --timeout 30s[/], or [bold]acquire status --watch[/]
    """
    if wait is not None:
        # Not for every status: one without options must appear at once.
        from acquire.daemon.states import SEALED, State

        waits = {SEALED_WORD: SEALED, **{str(state): frozenset({state}) for state in State}}
        if wait not in waits:
            near = did_you_mean(wait, waits)
            raise UsageError(f"the daemon has no state {wait!r}{near}", possible=", ".join(waits))
        with _daemon(socket) as daemon:
            reached = daemon.wait(waits[wait], timeout)
        # `--watch` begins with a status of its own.
        if not watch:
            show(reached, json)
    if watch:
        from acquire.cli.watch import watch_status

        watch_status(socket, every, as_json=json)
    elif wait is None:
        # A daemon of this version answers at once. The client, which is slower to import, handles the rest:
        # it waits for a daemon that is starting, and explains failures.
        try:
            show_document(status_document(socket), json)
        except NO_ANSWER:
            with _daemon(socket) as daemon:
                show(daemon.status(), json)


def _daemon(socket: Path | None) -> Client:
    from acquire.cli.progress import waiting_printer
    from acquire.client import Client

    return Client(socket, waiting_printer())
