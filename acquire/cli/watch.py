"""``acquire status --watch``: the same page again and again on a terminal, a line each time elsewhere."""

from __future__ import annotations

import sys
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from acquire.cli.interrupts import first_interrupt_asks
from acquire.cli.output import json_text, say
from acquire.cli.status_page import status_line, status_lines
from acquire.client import Client
from acquire.errors import NoDaemonError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

SHORTEST_S = 0.1
"""The daemon has other things to do."""


def watch_status(socket: Path | None, every_s: float, *, as_json: bool) -> None:
    """Show the status every ``every_s`` until Ctrl-C; a daemon that has gone is waited for, and said to be.

    Raises NoDaemonError where there is none to begin with.
    """
    client = Client(socket)
    status: Any = client.status().model_dump(mode="json")
    with first_interrupt_asks("ending") as asked, _screen(as_json=as_json) as draw:
        while not asked.is_set():
            draw(status)
            asked.wait(max(SHORTEST_S, every_s))
            try:
                status = client.status().model_dump(mode="json")
            except NoDaemonError as error:
                status = error


@contextmanager
def _screen(*, as_json: bool) -> Iterator[Callable[[Any], None]]:
    if as_json or not sys.stdout.isatty():
        yield _json if as_json else _line
        return
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    with Live(console=Console(), auto_refresh=False, vertical_overflow="visible") as live:

        def draw(status: Any) -> None:
            live.update(Text("\n".join(_gone(status) or status_lines(status))), refresh=True)

        yield draw


def _line(status: Any) -> None:
    say(f"{time.strftime('%H:%M:%S')} {' '.join(_gone(status)) or status_line(status)}")
    sys.stdout.flush()


def _json(status: Any) -> None:
    say(json_text({"error": status.to_dict()} if isinstance(status, NoDaemonError) else status))
    sys.stdout.flush()


def _gone(status: Any) -> list[str]:
    return [status.message] if isinstance(status, NoDaemonError) else []
