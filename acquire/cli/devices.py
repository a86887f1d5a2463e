"""``acquire devices``: list the triggers and cameras of a rig, or of this host, and any problem with them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.completion import rigs
from acquire.cli.output import JsonFlag, print_json, print_table
from acquire.errors import AcquireError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from acquire.camera.base import CameraOpener

Row = dict[str, Any]
COLUMNS = ("device", "serial", "model", "firmware", "state")
OPEN_S = 60.0


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Rig")(devices)


def devices(
    config: Annotated[
        str | None,
        typer.Option(
            "--config",
            "-c",
            metavar="RIG",
            autocompletion=rigs,
            help="Rig file whose devices are opened. Default: list all devices of this host.",
        ),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """List triggers and cameras with their serial numbers, and report any problem with them.

    With a rig file, its devices are opened and configured one after the other, and closed again. Without one,
    the serial ports, USB triggers and cameras of the host are listed; no device is opened, and nothing is
    sent.

    Example: [bold]acquire devices --config rig-demo[/]
    """
    # All of them first: the columns are as wide as their longest cells.
    rows = list(of_rig(config) if config else _of_host())
    if json:
        print_json(rows)
        return
    print_table(COLUMNS, [[row[column] for column in COLUMNS] for row in rows])


def of_rig(config: str) -> Iterator[Row]:
    """Open the trigger and the cameras of a rig file one after the other; yield the state of each.

    Raises ConfigError for the rig file.
    """
    from acquire.camera.look import facts
    from acquire.camera.visit import visit
    from acquire.config import load_rig
    from acquire.rig import Rig

    rig_config = load_rig(config)
    with Rig(rig_config) as rig:
        # A device that fails is a row like the others: the next one may be the one that was meant.
        row = {"device": "trigger", "serial": "", "model": "", "firmware": ""}
        try:
            found = rig.trigger.identify()
            yield row | {
                "serial": found.serial,
                "model": found.model,
                "firmware": found.firmware,
                "state": "ready",
            }
        except AcquireError as error:
            yield row | {"state": str(error)}
        openers: dict[str, CameraOpener] | AcquireError
        try:
            openers = rig.openers()
        except AcquireError as error:
            openers = error  # reported with each camera
        for arm in ("a", "b"):
            camera = rig_config.cameras.arm(arm)
            row = {"device": f"camera {arm}", "serial": camera.serial, "model": camera.model, "firmware": ""}
            try:
                if isinstance(openers, AcquireError):
                    raise openers
                seen = visit(openers[arm], facts, timeout_s=OPEN_S)["identity"]
                yield row | {k: seen[k] for k in ("serial", "model", "firmware")} | {"state": "ready"}
            except AcquireError as error:
                yield row | {"state": str(error)}


def _of_host() -> Iterator[Row]:
    """List the devices of this host, with at least one row for each way to connect them."""
    from acquire.camera.aravis import list_cameras as aravis_cameras
    from acquire.camera.harvesters import list_cameras as gentl_cameras
    from acquire.trigger.transports.serial import list_ports
    from acquire.trigger.transports.usb import list_devices

    def serial_ports() -> Iterator[Row]:
        # Only an answer would show whether a trigger is connected, and other devices may not like the
        # question.
        for port in list_ports():
            ask = f"to identify it: acquire trigger info --url {port.device}"
            yield {"serial": port.serial_number, "model": port.description, "state": port.held_by or ask}

    def usb_triggers() -> Iterator[Row]:
        for found in list_devices():
            yield {"serial": found.serial, "model": found.name, "state": found.lacks or "ready"}

    def gentl() -> Iterator[Row]:
        for camera in gentl_cameras():
            row = {name: getattr(camera, name) for name in ("serial", "model", "firmware")}
            yield row | {"state": camera.access}

    def aravis() -> Iterable[Row]:
        keys = ("serial", "model")
        return (dict(zip(keys, found, strict=True)) | {"state": "answers"} for found in aravis_cameras())

    ways: dict[str, Callable[[], Iterable[Row]]] = {
        "trigger, serial": serial_ports,
        "trigger, USB": usb_triggers,
        "camera, GenTL": gentl,
        "camera, Aravis": aravis,
    }
    for device, look in ways.items():
        empty = dict.fromkeys(COLUMNS, "") | {"device": device}
        try:
            # Listed before the first is shown: an error then leaves one row, and no half of a list.
            yield from [empty | row for row in look()] or [empty | {"state": "none"}]
        except AcquireError as error:
            yield empty | {"state": str(error)}
