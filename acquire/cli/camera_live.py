"""``acquire camera live``: current level, saturation and sharpness, for adjusting a lens."""

from __future__ import annotations

import sys
import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.completion import rigs
from acquire.cli.control import SocketOption
from acquire.cli.durations import seconds_between
from acquire.cli.output import JsonFlag, json_text, say
from acquire.daemon.options import LightCode

if TYPE_CHECKING:
    import threading
    from collections.abc import Iterator

    from acquire.camera.gauge import Reading
    from acquire.cli.camera_sources import LiveSource


def live(
    serial: Annotated[
        str | None,
        typer.Argument(
            metavar="SERIAL", help="Serial number of the camera. Default: both cameras of the rig."
        ),
    ] = None,
    config: Annotated[
        str | None,
        typer.Option(
            "--config",
            "-c",
            metavar="RIG",
            autocompletion=rigs,
            help="Open the cameras of this rig file. Default: read the daemon's lines.",
        ),
    ] = None,
    code: Annotated[
        LightCode | None,
        typer.Option(
            help="Light, with --config: rig (follow the rig's code), dark (off) or steady (on). Default: rig."
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            "--duration",
            "--seconds",
            parser=seconds_between(0.1, 86400),
            metavar="TIME",
            help="End after this time. Default: at Ctrl-C.",
        ),
    ] = None,
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """Show level, saturation and focus of the cameras five times a second, until Ctrl-C.

    If the daemon is armed or recording, the command reads its lines, without effect on them. With --config it
    opens the rig's cameras itself, runs the trigger, and closes both at the end. The focus number is the RMS
    difference of neighbouring pixels relative to the mean. To focus, use steady light and a target with
    detail, and turn the lens until the number is largest. With --json the command prints one object per line.

    Example: [bold]acquire camera live --config rig-demo --code steady[/]
    """
    from acquire.cli.camera_sources import open_source
    from acquire.cli.interrupts import stop_on_interrupt
    from acquire.client import Client

    with (
        # Before the cameras are opened, which takes seconds: a Ctrl-C meanwhile closes them, too.
        stop_on_interrupt("closing the cameras") as stop_requested,
        open_source(config, serial, code, Client(socket)) as source,
    ):
        readings = _readings(source, stop_requested, seconds)
        if sys.stdout.isatty() and not json:
            from rich.console import Console
            from rich.live import Live

            from acquire.camera.live import TURN_S
            from acquire.cli.camera_screen import Screen

            screen = Screen(source.names, source.where, TURN_S)
            # rich would otherwise redraw the same readings four times a second.
            with Live(screen, console=Console(), auto_refresh=False) as display:
                for _, latest in readings:
                    screen.show(latest)
                    display.refresh()
        else:
            for elapsed_s, latest in readings:
                _print_line(elapsed_s, {name: latest.get(name) for name in source.names}, as_json=json)


def _print_line(elapsed_s: float, readings: dict[str, Reading | None], *, as_json: bool) -> None:
    from acquire.cli.camera_screen import reading_text

    if as_json:
        arms: dict[str, Any] = {}
        for name, reading in readings.items():
            # five digits are as many as the numbers are good for
            facts = {} if reading is None else asdict(reading)
            arms[name] = {k: round(v, 5) if isinstance(v, float) else v for k, v in facts.items()} or None
        say(json_text({"time_s": round(elapsed_s, 2), **arms}))
    else:
        say(f"{elapsed_s:6.1f} s  " + "; ".join(f"{n}: {reading_text(r)}" for n, r in readings.items()))
    # In a pipe the line would otherwise wait until a buffer is full.
    sys.stdout.flush()


def _readings(
    source: LiveSource, stop_requested: threading.Event, seconds: float | None
) -> Iterator[tuple[float, dict[str, Reading]]]:
    """Yield the time since the start (s) and the readings, until a stop is requested or the time is over."""
    began_s = time.monotonic()
    while not stop_requested.is_set():
        readings = source.take()
        elapsed_s = time.monotonic() - began_s
        yield elapsed_s, readings
        # After the reading, so that even the shortest time yields one.
        if seconds is not None and elapsed_s >= seconds:
            return
