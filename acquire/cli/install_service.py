"""``acquire install-service``: install the daemon as a systemd service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from acquire.cli.completion import rigs
from acquire.cli.output import note, say
from acquire.errors import UsageError


def register(app: typer.Typer) -> None:
    app.command("install-service", rich_help_panel="Rig")(install_service)


def install_service(
    config: Annotated[
        str | None,
        typer.Option(
            "--config",
            "-c",
            metavar="RIG",
            autocompletion=rigs,
            help="Rig file of the service. Required without --udev.",
        ),
    ] = None,
    user: Annotated[
        bool,
        typer.Option(
            "--user", help="Make a service of the current user, without root. Default: a service of the host."
        ),
    ] = False,
    account: Annotated[
        str | None,
        typer.Option(
            metavar="USER", help="Account under which the host's service runs. Default: the current user."
        ),
    ] = None,
    udev: Annotated[
        bool,
        typer.Option(
            "--udev", help="Only the udev rule, which lets users open the trigger and cameras without root."
        ),
    ] = False,
    install: Annotated[
        bool, typer.Option("--install", help="Write the files. Default: only print them.")
    ] = False,
    directory: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Write the files to this directory instead, as for a package."),
    ] = None,
) -> None:
    """Print or write a hardened systemd unit for the daemon and a udev rule.

    The daemon tells systemd when it is ready and answers its watchdog. If it is killed or hangs, systemd
    restarts it; it then recovers an unfinished recording and follows [service] begin in the rig file.
    This command starts nothing.

    Example: [bold]acquire install-service --config rig-demo --user[/], or
    [bold]acquire install-service --udev | sudo tee /etc/udev/rules.d/70-acquire.rules[/]
    """
    if udev and (config is not None or user or account is not None):
        raise UsageError(
            "--udev makes no service, so that --config, --user and --account have no effect",
            possible="--udev, with --install or --directory; or a service, whose files include the rule",
        )
    if udev:
        _deliver(_rule(directory), wanted=bool(install or directory))
        note(
            "next, as root: save the rule at its path, unless that is done, and udevadm control --reload; "
            "then plug the devices in again; who is not at the machine's screen joins the group plugdev"
        )
        return
    if config is None:
        raise UsageError(
            "install-service needs --config, the rig file of the service",
            possible="--config RIG, or --udev for the rule alone",
        )
    from acquire.config import find, load_rig
    from acquire.daemon.unit import SOCKET, UNIT, UnitPlace, unit_text
    from acquire.place import default_socket

    rig = load_rig(config)
    place = UnitPlace.of(user=user)
    where = directory or place.directory
    # By the path of the rig file, also of a built-in one: systemd starts the daemon in another directory.
    files = {where / UNIT: unit_text(rig, find(config, kind="rig"), user=user, account=account)}
    # Only root may write rules for devices.
    if not user:
        files |= _rule(directory)
    if not _deliver(files, wanted=bool(install or directory)):
        return
    flag = " --user" if user else ""
    say(f"next: systemctl{flag} daemon-reload && systemctl{flag} enable --now acquire")
    # The unit's daemon has no XDG_RUNTIME_DIR: it listens in /run, where a user's client does not look.
    if not user and rig.control.socket == default_socket():
        say(f"for clients: export ACQUIRE_SOCKET={SOCKET}")


def _rule(directory: Path | None) -> dict[Path, str]:
    """Return the udev rule by its path."""
    from acquire.daemon.unit import RULES, UDEV

    return {(directory or Path("/etc/udev/rules.d")) / RULES: UDEV}


def _deliver(files: dict[Path, str], *, wanted: bool) -> bool:
    """Write the files if that is wanted, otherwise print them; return whether they were written."""
    from acquire.store.refusals import refused

    if not wanted:
        for path, text in files.items():
            # As a comment, so that what is printed can be saved as the file.
            say(f"# {path}")
            for line in text.splitlines():
                say(line)
        return False
    # check all files before the first is written
    for path, text in files.items():
        # Another program's file may not be UTF-8, and then differs in any case.
        if path.exists() and path.read_text(encoding="utf-8", errors="replace") != text:
            raise UsageError(
                f"{path} exists with different contents and is not overwritten",
                hint="compare the two, and remove the old file first",
            )
    for path, text in files.items():
        with refused(path, "written", "sudo for the host's service, or --directory"):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        say(f"wrote {path}")
    return True
