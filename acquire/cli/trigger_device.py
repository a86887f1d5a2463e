"""The device that ``acquire trigger``'s commands talk to: the rig's, or one at another port."""

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
        "--config", "-c", metavar="FILE", autocompletion=rigs, help="Rig file, or the name of a built-in one."
    ),
]
UrlOption = Annotated[
    str | None,
    typer.Option(
        "--url", "--port", metavar="URL", help="Serial port or socket://host:port, not the rig file's."
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change one value of the file, e.g. code.seed=7."),
]


@contextmanager
def device_of(
    config: str, url: str | None, settings: list[str] | None
) -> Iterator[tuple[TriggerDriver, RigConfig]]:
    """The rig's trigger; left as it is at the end."""
    from acquire.config import load_rig, parse_settings
    from acquire.rig import open_trigger
    from acquire.trigger.driver import TriggerDriver

    overrides = parse_settings(settings or [])
    if url is not None:
        overrides |= {"trigger.driver": "serial", "trigger.url": url}
    rig = load_rig(config, overrides)
    driver = open_trigger(rig)
    if not isinstance(driver, TriggerDriver):
        raise UsageError(
            f"trigger.driver = {rig.trigger.driver!r} is no board with this project's gateware",
            possible="'simulated', 'rtl', 'serial', 'usb'; for others: acquire devices, acquire serve",
        )
    try:
        yield driver, rig
    finally:
        driver.release()
