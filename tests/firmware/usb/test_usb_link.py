"""The USB link as a host sees it: its identity, and every byte in both directions for any packets."""

from __future__ import annotations

import random
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from amaranth.hdl import Elaboratable, Module
from amaranth.lib import wiring
from amaranth.sim import Simulator
from utmi_host import UtmiHost

import firmware
from acquire.trigger import registers as r
from acquire.trigger.frames import Frame, decode, encode, read_payload
from acquire.trigger.registers import FrameType
from acquire.trigger.transports.usb import PRODUCT, VENDOR
from firmware.top import Build
from firmware.usb import ENDPOINT, UsbLink, UsbSyncTrigger

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")
"""LUNA 0.2 still uses what Amaranth 0.6 will no longer have."""

GET_DESCRIPTOR, SET_ADDRESS, SET_CONFIGURATION = 6, 5, 9
DEVICE, CONFIGURATION = 1 << 8, 2 << 8
BULK = 2


def simulate(
    test: Callable[[UtmiHost], Coroutine[Any, Any, None]], make: Callable[[Any], Elaboratable]
) -> None:
    """At the clocks of USB and of the trigger."""
    from luna.gateware.interface.utmi import UTMIInterface

    bus = UTMIInterface()

    async def host(context: Any) -> None:
        context.set(bus.line_state, 0b01)  # J: a bus at rest
        await test(UtmiHost(context, bus))

    simulator = Simulator(make(bus))
    simulator.add_clock(1 / 60e6, domain="usb")
    simulator.add_clock(1 / 90e6, domain="sync")
    simulator.add_testbench(host)
    simulator.run()


def echo(bus: Any) -> Elaboratable:
    """A link that returns its bytes."""
    m = Module()
    m.submodules.link = link = UsbLink(bus, serial=42)
    wiring.connect(m, link.received, link.sending)
    return m


def trigger(bus: Any) -> Elaboratable:
    return UsbSyncTrigger(Build(code_words=16, tags=16), bus)


async def enumerate_device(host: UtmiHost) -> None:
    await host.control_out(SET_ADDRESS, 5)
    host.address = 5
    await host.control_out(SET_CONFIGURATION, 1)


def test_the_device_is_the_one_that_the_transport_looks_for() -> None:
    async def test(host: UtmiHost) -> None:
        device = await host.control_in(GET_DESCRIPTOR, DEVICE, 18)
        assert int.from_bytes(device[8:10], "little") == VENDOR
        assert int.from_bytes(device[10:12], "little") == PRODUCT
        whole = await host.control_in(GET_DESCRIPTOR, CONFIGURATION, 64)
        assert endpoints(whole) == {0x80 | ENDPOINT: BULK, ENDPOINT: BULK}

    simulate(test, echo)


def test_bytes_come_back_in_order_whatever_the_packets() -> None:
    draw = random.Random(1)
    parts = [draw.randbytes(length) for length in (1, 64, 63, 130, 7)]

    async def test(host: UtmiHost) -> None:
        await enumerate_device(host)
        received = b""
        for part in parts:
            await host.write(ENDPOINT, part)
            wanted = len(received) + len(part)
            while len(received) < wanted:
                received += await host.read(ENDPOINT)
        assert received == b"".join(parts)

    simulate(test, echo)


def test_the_trigger_answers_over_usb() -> None:
    async def test(host: UtmiHost) -> None:
        await enumerate_device(host)
        await host.write(ENDPOINT, encode(Frame(FrameType.READ, 7, read_payload(r.ID.address, 1))))
        received = b""
        while not received.endswith(b"\0"):
            received += await host.read(ENDPOINT)
        answer = decode(received[:-1])
        assert (answer.type, answer.sequence) == (FrameType.DATA, 7)
        assert int.from_bytes(answer.payload[2:], "little") == r.DEVICE_ID

    simulate(test, trigger)


def test_the_udev_rule_matches_this_device() -> None:
    (rule,) = (Path(firmware.__file__).parent / "udev").glob("*.rules")
    assert f'ATTR{{idVendor}}=="{VENDOR:04x}", ATTR{{idProduct}}=="{PRODUCT:04x}"' in rule.read_text()
    assert int(rule.name[:2]) < 73, "TAG uaccess has no effect from 73 on"


def endpoints(configuration: bytes) -> dict[int, int]:
    """Address → kind of transfer of every endpoint described."""
    found, at = {}, 0
    while at < len(configuration):
        length, kind = configuration[at], configuration[at + 1]
        if kind == 5:
            found[configuration[at + 2]] = configuration[at + 3]
        at += length
    return found
