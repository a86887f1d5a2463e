"""The compiled gateware as a program: a trigger at the end of a pseudo-terminal, for any host software.

::

    $ python -m firmware.twin
    {"port": "/dev/pts/7", "clock_hz": 90000000}        acquire trigger info --port /dev/pts/7

It runs until Ctrl-C or SIGTERM; with ``--owned`` until its standard input is closed, which also happens when
the process at the other end is killed.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import threading
from typing import TYPE_CHECKING

from acquire.errors import AcquireError
from acquire.sim.pins import PinPage, PinRun
from acquire.sim.twin_links import PtyTwin
from firmware.cxxrtl import library
from firmware.device import RtlDevice
from firmware.top import Build

if TYPE_CHECKING:
    from firmware.cxxrtl import Twin


class Publisher:
    """Publishes the activity of the pins in a page of memory at every call."""

    def __init__(self, page: PinPage, clock_hz: int) -> None:
        self._page, self._clock_hz = page, clock_hz
        self._before = page.latest_run  # of an earlier process, whose numbers are not used again

    def __call__(self, twin: Twin) -> None:
        run, light = twin.latest_run, twin.take_light()
        if run.number:
            pins = PinRun(
                self._before + run.number,
                bool(run.running),
                (run.pulses_a, run.pulses_b),
                run.line_clocks,
                (run.delay_a, run.delay_b),
            )
            self._page.publish(pins, light, self._clock_hz)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m firmware.twin", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--clock-hz", type=int, default=Build.clock_hz, help="clock frequency that the device reports"
    )
    parser.add_argument("--clocks-per-bit", type=int, default=8, help="clocks per bit of the UART, 8 or more")
    parser.add_argument("--pins", type=int, metavar="FD", help="inherited page to publish the pins on")
    parser.add_argument("--compile", action="store_true", help="compile the gateware and end")
    parser.add_argument("--owned", action="store_true", help="end when standard input is closed")
    chosen = parser.parse_args(arguments)
    end = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: end.set())
    if chosen.owned:
        threading.Thread(target=_await_owner, args=(end,), daemon=True).start()
    try:
        _run(chosen, end)
    except AcquireError as error:
        _say({"error": str(error)})
        return 1
    return 0


def _run(chosen: argparse.Namespace, end: threading.Event) -> None:
    build = Build(clock_hz=chosen.clock_hz, baud=chosen.clock_hz // chosen.clocks_per_bit)
    if chosen.compile:
        _say({"library": str(library(build))})
        return
    watch = Publisher(PinPage(chosen.pins), build.clock_hz) if chosen.pins is not None else None
    device = RtlDevice(build, watch)
    port = PtyTwin(device)
    try:
        _say({"port": port.path, "clock_hz": build.clock_hz})
        end.wait()
    finally:
        port.close()
        device.close()


def _await_owner(end: threading.Event) -> None:
    while os.read(0, 1024):  # not through sys.stdin, for which the interpreter would wait when it exits
        pass
    end.set()


def _say(facts: dict[str, object]) -> None:
    print(json.dumps(facts), flush=True)  # noqa: T201


if __name__ == "__main__":
    sys.exit(main())
