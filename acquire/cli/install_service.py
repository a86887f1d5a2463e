"""``acquire install-service``: the daemon as a service of systemd."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from acquire.cli.completion import rigs
from acquire.cli.output import say
from acquire.errors import UsageError


def register(app: typer.Typer) -> None:
    app.command("install-service", rich_help_panel="Rig")(install_service)


def install_service(
    config: Annotated[
        str,
        typer.Option("--config", "-c", metavar="FILE", autocompletion=rigs, help="Rig file of the service."),
    ],
    user: Annotated[
        bool,
        typer.Option("--user", help="Make a service of this user, who needs no root; absent: of the host."),
    ] = False,
    account: Annotated[
        str | None, typer.Option(help="User that the host's service runs as; absent: whoever calls this.")
    ] = None,
    install: Annotated[
        bool, typer.Option("--install", help="Write the files; absent: they are printed.")
    ] = False,
    directory: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Directory that the files are written to instead, as for a package."
        ),
    ] = None,
) -> None:
    """Print or write a unit for systemd (ready, watchdog, hardened, restarted) and a udev rule.

    The service tells systemd when it is ready and that it lives; killed or hung it comes back, recovers what
    was being recorded, and does what [service] begin of the rig says. Nothing is started by this command.

    Example: [bold]acquire install-service --config rig-demo --user[/]
    """
    from acquire.config import find, load_rig
    from acquire.daemon.unit import RULES, SOCKET, UDEV, UNIT, Place, unit_text
    from acquire.place import default_socket

    rig = load_rig(config)
    place = Place.of(user=user)
    where = directory or place.directory
    rules = (directory or Path("/etc/udev/rules.d")) / RULES
    files = {where / UNIT: unit_text(rig, find(config, kind="rig"), user=user, account=account)}
    if not user:
        files[rules] = UDEV
    if not (install or directory):
        for path, text in files.items():
            say(f"# {path}")
            for line in text.splitlines():
                say(line)
        return
    _write(files)
    flag = " --user" if user else ""
    say(f"now: systemctl{flag} daemon-reload && systemctl{flag} enable --now acquire")
    if not user and rig.control.socket == default_socket():
        say(f"clients find it with: export ACQUIRE_SOCKET={SOCKET}")


def _write(files: dict[Path, str]) -> None:
    """What is there and another text is not overwritten. Raises UsageError before anything is written."""
    from acquire.store.refusals import refused

    for path, text in files.items():
        if path.exists() and path.read_text(encoding="utf-8", errors="replace") != text:
            raise UsageError(f"{path} is there, with another text", hint="compare, and remove it first")
    for path, text in files.items():
        with refused(path, "written"):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        say(f"{path} is written")
