"""``acquire devices``: the triggers and cameras of a rig, or of this host, and what each lacks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.completion import rigs
from acquire.cli.output import JsonFlag, print_json, print_table
from acquire.errors import AcquireError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from acquire.camera.base import CameraOpener
    from acquire.rig import Rig

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
            metavar="FILE",
            autocompletion=rigs,
            help="Rig file whose devices are opened; absent: all that this host shows.",
        ),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """List triggers and cameras with their serial numbers, and say what each lacks.

    With a rig file its devices are opened and set, one after the other, and closed again. Without one
    the host's serial ports, triggers on USB and cameras are listed; nothing is opened, nothing is sent.

    Example: [bold]acquire devices --config rig-demo[/]
    """
    rows = list(of_rig(config) if config else _of_host())
    if json:
        print_json(rows)
        return
    print_table(COLUMNS, [[row[column] for column in COLUMNS] for row in rows])


def of_rig(config: str) -> Iterator[dict[str, Any]]:
    """Trigger and cameras of a rig file, opened one after the other; what each lacks. Raises ConfigError."""
    from acquire.camera.look import facts
    from acquire.camera.visit import visit
    from acquire.config import load_rig
    from acquire.rig import Rig

    rig_config = load_rig(config)
    with Rig(rig_config) as rig:
        yield _trigger(rig)
        openers = _openers(rig)
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


def _openers(rig: Rig) -> dict[str, CameraOpener] | AcquireError:
    try:
        return rig.openers()
    except AcquireError as error:
        return error


def _trigger(rig: Rig) -> dict[str, Any]:
    try:
        found = rig.trigger.identify()
    except AcquireError as error:
        return {"device": "trigger", "serial": "", "model": "", "firmware": "", "state": str(error)}
    return {
        "device": "trigger",
        "serial": found.serial,
        "model": found.model,
        "firmware": found.firmware,
        "state": "ready",
    }


def _of_host() -> Iterator[Row]:
    yield from _or_why("trigger, serial", _serial_ports)
    yield from _or_why("trigger, USB", _usb_triggers)
    yield from _or_why("camera, GenTL", _gentl_cameras)
    yield from _or_why("camera, Aravis", _aravis_cameras)


def _or_why(device: str, look: Callable[[], Iterable[Row]]) -> list[Row]:
    """The rows of one way to a device, or one that says why there is none."""
    try:
        rows = [_row(device) | row for row in look()]
    except AcquireError as error:
        return [_row(device) | {"state": str(error)}]
    return rows or [_row(device) | {"state": "none"}]


def _row(device: str) -> Row:
    return dict.fromkeys(COLUMNS, "") | {"device": device}


def _serial_ports() -> Iterator[Row]:
    """Whether a trigger is behind a port only its answer tells, and others may not like to be asked."""
    from acquire.trigger.transports.serial import list_ports

    for port in list_ports():
        ask = f"to ask what it is: acquire trigger info --url {port.device}"
        yield {"serial": port.serial_number, "model": port.description, "state": port.held_by or ask}


def _usb_triggers() -> Iterator[Row]:
    from acquire.trigger.transports.usb import list_devices

    for found in list_devices():
        yield {"serial": found.serial, "model": found.name, "state": found.lacks or "ready"}


def _gentl_cameras() -> Iterator[Row]:
    from acquire.camera.harvesters import list_cameras

    for camera in list_cameras():
        yield {
            "serial": camera.serial,
            "model": camera.model,
            "firmware": camera.firmware,
            "state": camera.access,
        }


def _aravis_cameras() -> Iterator[Row]:
    from acquire.camera.aravis import list_cameras

    for serial, model in list_cameras():
        yield {"serial": serial, "model": model, "state": "answers"}
