"""``acquire web``: serve the operator's page in the foreground, or print its address with the token."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.completion import rigs
from acquire.cli.control import SocketOption
from acquire.cli.output import note, say

if TYPE_CHECKING:
    from acquire.config.web import WebConfig


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Capture")(web)


def web(
    config: Annotated[
        str | None,
        typer.Option(
            "--config",
            "-c",
            metavar="RIG",
            autocompletion=rigs,
            help="Rig file with the [web] settings. Default: built-in settings.",
        ),
    ] = None,
    socket: SocketOption = None,
    host: Annotated[
        str | None,
        typer.Option(metavar="HOST", help="Address to listen on. Default: web.host of the rig file."),
    ] = None,
    port: Annotated[
        int | None, typer.Option(help="Port to listen on. Default: web.port of the rig file.")
    ] = None,
    link: Annotated[
        bool, typer.Option("--link", help="Print the page's address with the operator's token, and exit.")
    ] = False,
    viewer: Annotated[
        bool, typer.Option("--viewer", help="With --link: print the address with the read-only viewer token.")
    ] = False,
    given: Annotated[
        str | None,
        typer.Option("--given", hidden=True, help="Settings from the daemon, when it starts the page."),
    ] = None,
    owned: Annotated[
        bool, typer.Option("--owned", hidden=True, help="End as on SIGTERM when standard input is closed.")
    ] = False,
) -> None:
    """Serve the operator's page for the daemon of this host, until SIGTERM or Ctrl-C.

    `acquire serve` does this automatically if the rig file has [web]. The capture never waits for the page
    and continues if the page fails. Opening the page requires a token, which --link prints. Other hosts can
    reach it through `ssh -L 8300:127.0.0.1:8300 HOST`, or with a certificate (web.host, web.certificate,
    web.key).

    Example: [bold]acquire web --link[/]
    """
    import logging
    import threading

    from acquire.cli.interrupts import leave_signals_to_the_server
    from acquire.cli.serve import end_with_owner
    from acquire.logs import write_log
    from acquire.web.server import directory_of, serve_page
    from acquire.web.server import link as link_of

    leave_signals_to_the_server()
    where, directory, settings = _settings(config, socket, given, host, port)
    if link:
        asked = any(given is not None for given in (config, host, port))
        started = None if asked else _of_daemon(where)
        say(link_of(started or settings, where, "viewer" if viewer else "operator"))
        return
    write_log(logging.INFO)
    logging.getLogger("uvicorn").setLevel(logging.WARNING)
    if owned:
        threading.Thread(target=end_with_owner, name="acquire-owner", daemon=True).start()
    serve_page(where, directory or directory_of(where), settings)


def _settings(
    config: str | None, socket: Path | None, given: str | None, host: str | None, port: int | None
) -> tuple[Path, Path | None, WebConfig]:
    """Return the daemon's socket, the directory of the recordings if it is known, and the page's settings."""
    import json

    from pydantic import ValidationError

    from acquire.config import load_rig
    from acquire.config.web import WebConfig
    from acquire.errors import UsageError
    from acquire.place import default_socket
    from acquire.text import own_words, shown

    # The daemon has validated these settings, and knows more than its rig file says (--set).
    if given is not None:
        facts = json.loads(given)
        # As JSON: of Python objects, the strict models would refuse a list for a tuple, or a text for a path.
        settings = WebConfig.model_validate_json(json.dumps(facts["web"]))
        return Path(facts["socket"]), Path(facts["directory"]), settings
    rig = None if config is None else load_rig(config)
    # A rig without [web] only means that the daemon starts no page.
    settings = (rig.web if rig else None) or WebConfig()
    changes = {key: value for key, value in (("host", host), ("port", port)) if value is not None}
    if changes:  # validated again, because another address may need a certificate
        try:
            settings = type(settings).model_validate({**settings.model_dump(), **changes})
        except ValidationError as error:
            first = error.errors()[0]
            # A rule about several settings has no place, and names them in its own words.
            what = "".join(f"--{key} {shown(changes[key])}: " for key in first["loc"] if key in changes)
            raise UsageError(what + own_words(first["msg"])) from error
    where = socket or (rig.control.socket if rig else default_socket())
    return where.absolute(), rig.recording.directory.absolute() if rig else None, settings


def _of_daemon(socket: Path) -> WebConfig | None:
    """Return the settings of the page that the daemon has started; None if it has not, or there is none."""
    import json

    from acquire.client import Client
    from acquire.config.web import WebConfig
    from acquire.errors import NoDaemonError

    try:
        with Client(socket) as daemon:
            settings = daemon.setup().config["web"]
    except NoDaemonError:
        note(f"no daemon listens on {socket}: this link leads nowhere until a page is served at its address")
        return None
    # As JSON, for the strict models.
    return None if settings is None else WebConfig.model_validate_json(json.dumps(settings))
