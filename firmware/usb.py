r"""The link over USB: one vendor-specific interface with a bulk endpoint each way, in place of the UART.

::

    host ── OUT 1 ─▶ endpoint ─▶ queue ══▶ receive queue ─▶ deframer        ══ from the clock of USB
    host ◀─ IN 1 ─── endpoint ◀─ queue ◀══ framer                               to the trigger's, or back

Packet boundaries have no meaning: frames have delimiters, and available bytes are sent as soon as the host
polls. Vendor and product are those that `acquire.trigger.transports.usb` looks for. LUNA (PyPI: luna-usb) is
the device's logic; ``bus`` is a UTMI or ULPI bus, or a pair of pins at full speed.
"""

import warnings
from typing import Any

from amaranth.hdl import Elaboratable, Module, Signal
from amaranth.lib import stream, wiring
from amaranth.lib.fifo import AsyncFIFO
from amaranth.lib.wiring import In, Out
from usb_protocol.emitters import DeviceDescriptorCollection

from acquire.trigger.transports.usb import PRODUCT, VENDOR
from firmware.fifo import Queue
from firmware.framer import Framer
from firmware.top import Build, SyncTrigger

with warnings.catch_warnings():  # LUNA 0.2 still uses features that Amaranth 0.6 removes
    warnings.simplefilter("ignore", DeprecationWarning)
    from luna.gateware.usb.usb2.device import USBDevice
    from luna.gateware.usb.usb2.endpoints.stream import USBStreamInEndpoint, USBStreamOutEndpoint

ENDPOINT = 1
PACKET_BYTES = 64
"""Largest packet at full speed."""
CROSSING_BYTES = 16
VENDOR_SPECIFIC = 0xFF
_TO_HOST = 0x80


class UsbLink(wiring.Component):
    """Bytes from and to the host, in the trigger's clock; ``bus`` in the domain ``usb``."""

    received: Out(stream.Signature(8))
    sending: In(stream.Signature(8))

    def __init__(self, bus: Any, serial: int = 0) -> None:
        self._bus, self._serial = bus, serial
        super().__init__()

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        m.submodules.usb = usb = USBDevice(bus=self._bus)
        usb.add_standard_control_endpoint(descriptors(self._serial))
        out_end = USBStreamOutEndpoint(endpoint_number=ENDPOINT, max_packet_size=PACKET_BYTES)
        in_end = USBStreamInEndpoint(endpoint_number=ENDPOINT, max_packet_size=PACKET_BYTES)
        usb.add_endpoint(out_end)
        usb.add_endpoint(in_end)
        crossing = {"width": 8, "depth": CROSSING_BYTES}
        m.submodules.inward = inward = AsyncFIFO(**crossing, w_domain="usb", r_domain="sync")
        m.submodules.outward = outward = AsyncFIFO(**crossing, w_domain="sync", r_domain="usb")
        m.d.comb += [
            usb.connect.eq(1),
            inward.w_data.eq(out_end.stream.payload),
            inward.w_en.eq(out_end.stream.valid),
            out_end.stream.ready.eq(inward.w_rdy),
            self.received.payload.eq(inward.r_data),
            self.received.valid.eq(inward.r_rdy),
            inward.r_en.eq(self.received.ready),
            outward.w_data.eq(self.sending.payload),
            outward.w_en.eq(self.sending.valid),
            self.sending.ready.eq(outward.w_rdy),
            in_end.stream.payload.eq(outward.r_data),
            in_end.stream.valid.eq(outward.r_rdy),
            outward.r_en.eq(in_end.stream.ready),
            in_end.flush.eq(~outward.r_rdy),  # nothing more to wait for
        ]
        return m


class UsbSyncTrigger(SyncTrigger):
    """The trigger with USB as its link. The pins of the UART are idle."""

    def __init__(self, build: Build, bus: Any) -> None:
        self._bus = bus
        super().__init__(build)

    def _bytes(self, m: Module, queue: Queue, framer: Framer) -> None:
        m.submodules.usb_link = link = UsbLink(self._bus, self.build.serial)
        wiring.connect(m, framer.bytes, link.sending)
        m.d.comb += [
            queue.put.eq(link.received.valid & ~queue.full),
            queue.data.eq(link.received.payload),
            link.received.ready.eq(~queue.full),
            self.tx.eq(Signal(init=1)),
        ]


def descriptors(serial: int) -> DeviceDescriptorCollection:
    """Return the descriptors for the host's enumeration."""
    collection = DeviceDescriptorCollection()
    with collection.DeviceDescriptor() as device:
        device.idVendor, device.idProduct = VENDOR, PRODUCT
        device.iManufacturer, device.iProduct = "acquire", "TDI sync trigger"
        device.iSerialNumber = f"{serial:08x}"
        device.bNumConfigurations = 1
    with collection.ConfigurationDescriptor() as configuration:
        with configuration.InterfaceDescriptor() as interface:
            interface.bInterfaceNumber = 0
            interface.bInterfaceClass = VENDOR_SPECIFIC
            for address in (_TO_HOST | ENDPOINT, ENDPOINT):
                with interface.EndpointDescriptor() as endpoint:
                    endpoint.bEndpointAddress = address
                    endpoint.wMaxPacketSize = PACKET_BYTES
    return collection
