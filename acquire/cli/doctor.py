"""``acquire doctor``: check whether this host is fit to capture, and advise what to change."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.completion import rigs
from acquire.cli.control import SocketOption
from acquire.cli.output import JsonFlag, print_json, print_table, say
from acquire.errors import AcquireError, DeviceError, UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from acquire.daemon.doctor import CheckResult

# In capitals, since these tables have no colours.
WORDS = {"good": "good", "warning": "WARNING", "bad": "BAD"}


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Rig")(doctor)


def doctor(
    config: Annotated[
        str | None,
        typer.Option(
            "--config",
            "-c",
            metavar="RIG",
            autocompletion=rigs,
            help="Rig file, to also check its devices and requirements. Default: check the host only.",
        ),
    ] = None,
    running: Annotated[
        bool,
        typer.Option(
            "--running",
            help="Check the host by the setup of the daemon that is running; also while it records.",
        ),
    ] = False,
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """Check kernel limits, disk, memory, real-time rights, clock, devices, ports and versions.

    The command advises what to do about each problem and changes nothing. It opens the devices of the rig,
    unless a daemon is running, and none with --running. The exit code is 5 if a check fails.

    Example: [bold]acquire doctor --config rig-demo[/]
    """
    findings = _of_daemon(config, socket) if running else _of_rig(config, socket)
    if json:
        print_json([asdict(one) for one in findings])
    else:
        print_table(("check", "", "result"), [(one.name, WORDS[one.level], one.text) for one in findings])
        # Below the table, which long advice would make too wide for a terminal.
        for one in findings:
            if one.level != "good" and one.todo:
                say(f"{one.name}: {one.todo}")
    if any(one.level == "bad" for one in findings):
        raise typer.Exit(DeviceError.exit_code)


def _of_daemon(config: str | None, socket: Path | None) -> list[CheckResult]:
    from acquire.client import Client
    from acquire.daemon.checkup import examine_running

    if config is not None:
        raise UsageError("--config and --running exclude each other", hint="one of them")
    client = Client(socket)
    return list(examine_running(client.setup(), client.status()))


def _of_rig(config: str | None, socket: Path | None) -> list[CheckResult]:
    from acquire.client import Client
    from acquire.config import load_rig
    from acquire.daemon.doctor import examine

    rig = None if config is None else load_rig(config)
    running: str | None = None  # version of the daemon that is running
    with suppress(AcquireError):
        # At the rig's own socket: a daemon of another rig elsewhere does not concern it.
        running = Client(socket or (rig.control.socket if rig else None)).status().version
    # A daemon that is running has the devices open, and may be recording.
    return [*examine(rig, running), *(_devices(config) if config and running is None else ())]


def _devices(config: str) -> Iterator[CheckResult]:
    from acquire.cli.devices import of_rig
    from acquire.daemon.doctor import CheckResult

    try:
        for row in of_rig(config):
            ready = row["state"] == "ready"
            name = f"{row['model']} {row['serial']} {row['firmware']}".strip()
            text = f"{name or 'it'} is ready" if ready else row["state"]
            todo = "" if ready else "acquire devices lists the devices of this host"
            yield CheckResult(row["device"], "good" if ready else "bad", text, todo)
    except AcquireError as error:
        yield CheckResult("devices", "bad", error.message, error.hint)
