"""Twins of the trigger's device, for the tests of the contract. A new twin is one more entry in TWINS.

Each entry is a context manager that gives a `Bench`. ``speed`` says how many of its line periods of 30 µs
(3 sub-steps of 900 ticks at 90 MHz) it issues per line period of the host's time.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from fake_bus import FakeBus

import firmware.cxxrtl
from acquire.codes import PrbsCode
from acquire.config.device import TriggerConfig
from acquire.sim.clock import Wire
from acquire.sim.trigger_model import TriggerModel
from acquire.sim.twin_links import PtyTwin, TwinTransport
from acquire.trigger.base import TriggerRun
from acquire.trigger.driver import TriggerDriver
from acquire.trigger.transports.serial import SerialTransport
from acquire.trigger.transports.usb import UsbTransport

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.sim.twin_links import Twin
    from acquire.trigger.transports import Transport

CLOCK_HZ = 90_000_000
CODE = PrbsCode.from_seed(64, 3)


@dataclass
class Bench:
    """A device, its link, and a way to unplug it."""

    connect: Callable[[], Transport]
    unplug: Callable[[], None]
    external_edge: Callable[[], None] | None = None
    watchdog_s: float = 0.2
    """Enough for a host that lives, and soon over."""
    drivers: list[TriggerDriver] = field(default_factory=list)

    def driver(self, **settings: object) -> TriggerDriver:
        """A driver whose rig has these settings; closed with the bench."""
        made = TriggerDriver(self.connect, TriggerConfig(**({"clock_hz": CLOCK_HZ} | settings)))
        self.drivers.append(made)
        return made


@contextmanager
def model_in_process() -> Iterator[Bench]:
    with wired_model() as model:
        way = TwinTransport(model)
        yield Bench(lambda: way, way.unplug, model.external_edge)


@contextmanager
def model_behind_pty() -> Iterator[Bench]:
    with wired_model() as model:
        twin = PtyTwin(model)
        try:
            yield Bench(lambda: SerialTransport(twin.path, 3_000_000), twin.close, model.external_edge)
        finally:
            twin.close()


@contextmanager
def wired_model() -> Iterator[TriggerModel]:
    wire = Wire()
    yield TriggerModel(wire, CLOCK_HZ, serial=0x1234)
    wire.close()


@contextmanager
def gateware() -> Iterator[Any]:
    """The RTL itself, at 8 clocks per bit: its time is some fifty times slower than the host's."""
    from firmware.device import RtlDevice
    from firmware.top import Build

    device = RtlDevice(Build(clock_hz=CLOCK_HZ, baud=CLOCK_HZ // 8, serial=0x1234))
    try:
        yield device
    finally:
        device.close()


class SocketTwin:
    """Owns a thread that carries the bytes between a twin and whoever connects to ``url``, one at a time."""

    def __init__(self, twin: Twin) -> None:
        self._twin = twin
        self._server = socket.create_server(("127.0.0.1", 0))
        self.url = f"socket://127.0.0.1:{self._server.getsockname()[1]}"
        self._server.settimeout(0.01)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._ending.set()
        self._thread.join(300)
        self._server.close()

    def _live(self) -> None:
        while not self._ending.is_set():
            with contextlib.suppress(TimeoutError, ConnectionError):
                connection, _ = self._server.accept()
                with connection:
                    connection.settimeout(0.002)
                    self._carry(connection)

    def _carry(self, connection: socket.socket) -> None:
        while not self._ending.is_set():
            with contextlib.suppress(TimeoutError):
                if not (data := connection.recv(4096)):
                    return
                self._twin.feed(data)
            connection.sendall(self._twin.take())


@contextmanager
def model_behind_socket() -> Iterator[Bench]:
    with wired_model() as model:
        twin = SocketTwin(model)
        try:
            yield Bench(lambda: SerialTransport(twin.url, 9600), twin.close, model.external_edge)
        finally:
            twin.close()


@contextmanager
def model_behind_usb() -> Iterator[Bench]:
    with wired_model() as model:
        bus = FakeBus(model)
        yield Bench(lambda: UsbTransport(backend=bus), bus.unplug, model.external_edge)


@contextmanager
def gateware_behind_pty() -> Iterator[Bench]:
    with gateware() as device:
        twin = PtyTwin(device)
        try:
            edge = partial(device.set, "external_arm", True)
            yield Bench(lambda: SerialTransport(twin.path, 3_000_000), twin.close, edge, 0.02)
        finally:
            twin.close()


DEVICES = {"model": wired_model}
TWINS = {
    "model": model_in_process,
    "model-pty": model_behind_pty,
    "model-socket": model_behind_socket,
    "model-usb": model_behind_usb,
}
if firmware.cxxrtl.missing() is None:  # else the run's summary says why
    DEVICES["gateware"] = gateware
    TWINS["gateware-pty"] = gateware_behind_pty


def run(run_id: str = "run", **changes: object) -> TriggerRun:
    """Lines of 30 µs."""
    asked = {"run_id": run_id, "code": CODE, "substeps": 3, "substep_ticks": 900, "tag_every_lines": 16}
    return TriggerRun(**(asked | changes))
