"""``acquire status --watch``: redraw the status on a terminal; elsewhere print one line per update."""

from __future__ import annotations

import sys
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from acquire.cli.interrupts import stop_on_interrupt
from acquire.cli.output import json_text, say
from acquire.cli.status_page import status_line, status_lines
from acquire.client import Client
from acquire.errors import NoDaemonError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

SHORTEST_S = 0.1
"""Shortest time between two updates, to keep the load on the daemon low."""


def watch_status(socket: Path | None, every_s: float, *, as_json: bool) -> None:
    """Show the status every ``every_s`` until Ctrl-C. If the daemon ends, wait for it and show that.

    Raises NoDaemonError if no daemon is running at the start.
    """
    client = Client(socket)
    status: Any = client.status().model_dump(mode="json")
    with stop_on_interrupt("ending") as stop_requested, _display(as_json=as_json) as draw:
        while not stop_requested.is_set():
            draw(status)
            # Not by sleeping, which Ctrl-C could not end: its handler only sets this event.
            stop_requested.wait(max(SHORTEST_S, every_s))
            try:
                status = client.status().model_dump(mode="json")
            except NoDaemonError as error:
                status = error


@contextmanager
def _display(*, as_json: bool) -> Iterator[Callable[[Any], None]]:
    """Yield a function that shows a status document, or the error of a daemon that has ended."""
    if as_json or not sys.stdout.isatty():

        def write(status: Any) -> None:
            ended = isinstance(status, NoDaemonError)
            if as_json:
                say(json_text({"error": status.to_dict()} if ended else status))
            else:
                say(f"{time.strftime('%H:%M:%S')} {status.message if ended else status_line(status)}")
            # In a pipe the line would otherwise wait until a buffer is full.
            sys.stdout.flush()

        yield write
        return
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    # Refreshed by `draw` alone, at the user's interval.
    # Visible: rich would otherwise cut a status that is longer than the terminal.
    with Live(console=Console(), auto_refresh=False, vertical_overflow="visible") as live:

        def draw(status: Any) -> None:
            lines = [status.message] if isinstance(status, NoDaemonError) else status_lines(status)
            live.update(Text("\n".join(lines)), refresh=True)

        yield draw
