"""The device that ``acquire trigger`` operates: the trigger of a rig, or one on another port."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.completion import rigs
from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.config import RigConfig
    from acquire.trigger.driver import TriggerDriver

ConfigOption = Annotated[
    str,
    typer.Option(
        "--config", "-c", metavar="RIG", autocompletion=rigs, help="Rig file, or the name of a built-in rig."
    ),
]
UrlOption = Annotated[
    str | None,
    typer.Option(
        "--url",
        "--port",
        metavar="URL",
        help="Serial port, or socket://host:port, to use instead of the one in the rig file.",
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override one value of the rig file, such as code.seed=7. Repeatable.",
    ),
]


@contextmanager
def device_of(
    config: str, url: str | None, settings: list[str] | None
) -> Iterator[tuple[TriggerDriver, RigConfig]]:
    """Open the rig's trigger; at the end it is released in the state that it is in."""
    from acquire.config import load_rig, parse_settings
    from acquire.rig import open_trigger
    from acquire.trigger.driver import TriggerDriver

    overrides = parse_settings(settings or [])
    if url is not None:
        # A port on the command line means a board, whatever trigger the rig has.
        overrides.give("trigger.driver", "serial", "--url")
        overrides.give("trigger.url", url, "--url")
    rig = load_rig(config, overrides)
    driver = open_trigger(rig)
    if not isinstance(driver, TriggerDriver):
        raise UsageError(
            f"trigger.driver = {rig.trigger.driver!r} is not a board with this project's gateware",
            possible="'simulated', 'rtl', 'serial', 'usb'; for other drivers: acquire devices, acquire serve",
        )
    try:
        yield driver, rig
    finally:
        # Not closed, which would stop a run that is to go on (`arm --start`).
        driver.release()
