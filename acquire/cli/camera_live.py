"""``acquire camera live``: level, saturation and sharpness as they are now, for whoever turns a lens."""

from __future__ import annotations

import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from acquire.cli.completion import rigs
from acquire.cli.durations import seconds_between
from acquire.cli.output import JsonFlag, json_text, say
from acquire.errors import UsageError

if TYPE_CHECKING:
    import threading

    from acquire.camera.gauge import Reading
    from acquire.cli.camera_eyes import Eyes


def live(
    serial: Annotated[
        str | None,
        typer.Argument(metavar="SERIAL", help="Serial number of the camera; absent: both of the rig."),
    ] = None,
    config: Annotated[
        str | None,
        typer.Option(
            "--config",
            "-c",
            metavar="FILE",
            autocompletion=rigs,
            help="Open this rig's cameras; else look at the daemon's.",
        ),
    ] = None,
    code: Annotated[
        str | None,
        typer.Option(help="With --config, what the light follows: rig, its code; dark, off; steady, on."),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            parser=seconds_between(0.1, 86400), metavar="TIME", help="End after this time; absent: at Ctrl-C."
        ),
    ] = None,
    socket: Annotated[
        Path | None, typer.Option("--socket", envvar="ACQUIRE_SOCKET", help="The daemon's control socket.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Show level, saturation and focus of the cameras, five times a second, until Ctrl-C.

    Of a daemon that is armed or records it shows the lines that pass, and takes none away. With --config it
    opens the rig's cameras itself, lets the trigger run, and closes both at the end. The focus number is
    the difference between neighbouring pixels beside the mean: turn the lens to where it is largest, at
    steady light and with a target that has detail. With --json, one object per line.

    Example: [bold]acquire camera live --config rig-demo --code steady[/]
    """
    from acquire.cli.camera_eyes import eyes_of
    from acquire.cli.interrupts import first_interrupt_asks
    from acquire.client import Client
    from acquire.daemon.messages import LightCode

    if code is not None and code not in get_args(LightCode):
        raise UsageError(f"the light cannot follow --code {code!r}", possible=", ".join(get_args(LightCode)))
    with (
        first_interrupt_asks("closing the cameras") as asked,
        eyes_of(config, serial, code, Client(socket)) as eyes,  # type: ignore[arg-type]  # checked above
    ):
        if sys.stdout.isatty() and not json:
            _on_screen(eyes, asked, seconds)
        else:
            _by_lines(eyes, asked, seconds, as_json=json)


def _by_lines(eyes: Eyes, asked: threading.Event, seconds: float | None, *, as_json: bool) -> None:
    from acquire.cli.camera_screen import words

    for elapsed_s, readings in _turns(eyes, asked, seconds):
        if as_json:
            arms = {name: _facts(readings.get(name)) for name in eyes.names}
            say(json_text({"time_s": round(elapsed_s, 2), **arms}))
        else:
            say(f"{elapsed_s:6.1f} s  " + "; ".join(f"{n}: {words(readings.get(n))}" for n in eyes.names))
        sys.stdout.flush()


def _on_screen(eyes: Eyes, asked: threading.Event, seconds: float | None) -> None:
    from rich.console import Console
    from rich.live import Live

    from acquire.camera.live import TURN_S
    from acquire.cli.camera_screen import Screen

    screen = Screen(eyes.names, eyes.where, TURN_S)
    with Live(screen, console=Console(), auto_refresh=False) as shown:
        for _, readings in _turns(eyes, asked, seconds):
            screen.show(readings)
            shown.refresh()


def _turns(eyes: Eyes, asked: threading.Event, seconds: float | None) -> Any:
    """Time since the first turn (s), and readings, until it is time to end."""
    began_s = time.monotonic()
    while not asked.is_set():
        readings = eyes.take()
        elapsed_s = time.monotonic() - began_s
        yield elapsed_s, readings
        if seconds is not None and elapsed_s >= seconds:
            return


def _facts(reading: Reading | None) -> dict[str, Any] | None:
    """Numbers with as many digits as mean something."""
    if reading is None:
        return None
    return {k: round(v, 5) if isinstance(v, float) else v for k, v in asdict(reading).items()}
