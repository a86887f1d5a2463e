"""``acquire serve``: run the daemon in the foreground."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.completion import rigs

if TYPE_CHECKING:
    from acquire.config import RigConfig


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Capture")(serve)


def serve(
    config: Annotated[
        str,
        typer.Option(
            "--config",
            "-c",
            metavar="RIG",
            autocompletion=rigs,
            help="Rig file, or the name of a built-in rig.",
        ),
    ],
    socket: Annotated[
        Path | None,
        typer.Option(
            envvar="ACQUIRE_SOCKET", help="Control socket to listen on. Default: the one in the rig file."
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Override one value of the rig file, such as code.seed=7. Repeatable.",
        ),
    ] = None,
    owned: Annotated[
        bool, typer.Option("--owned", hidden=True, help="End as on SIGTERM when standard input is closed.")
    ] = False,
) -> None:
    """Run the daemon that controls the rig's devices and takes commands, until SIGTERM or Ctrl-C.

    A recording in progress is drained and sealed first; a second Ctrl-C seals the lines received so far at
    once. Unless the daemon runs in a terminal, SIGHUP makes it read the rig file again, as `acquire reload`
    does.

    Example: [bold]acquire serve --config rig-demo[/]
    """
    import logging
    import threading

    from acquire.cli.interrupts import leave_signals_to_the_server
    from acquire.config import find, find_again, load_rig, parse_settings
    from acquire.daemon.host import check_host
    from acquire.daemon.server import serve as run_daemon
    from acquire.daemon.uploads import check_upload
    from acquire.logs import write_log

    leave_signals_to_the_server()
    overrides = parse_settings(settings or [])
    if socket is not None:
        overrides.give("control.socket", str(socket.absolute()), "--socket")
    # Found once: a reload reads the same file, whatever the working directory is then.
    path = find(config, kind="rig").absolute()

    def read() -> RigConfig:
        rig = load_rig(path, overrides)
        check_host(rig)
        return rig

    def reread() -> RigConfig:
        find_again(path)
        return read()

    # Before the daemon begins: a rig that cannot be used is an error of the command.
    rig = read()
    check_upload(rig)
    write_log(rig.service.level)
    # uvicorn would log every request.
    logging.getLogger("uvicorn").setLevel(logging.WARNING)
    if owned:
        # A daemon thread, since it is blocked until the owner ends: nothing could join it.
        threading.Thread(target=end_with_owner, name="acquire-owner", daemon=True).start()
    raise typer.Exit(run_daemon(rig, str(path), reread))


def end_with_owner() -> None:
    """End this process when its owner ends, even by a kill: that closes the other end of standard input."""
    import os
    import signal

    # Nothing is expected to come; reading nothing is the end of the input.
    while os.read(0, 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
