"""Transport over the two bulk endpoints of a USB device."""

from __future__ import annotations

import errno
from dataclasses import dataclass
from typing import Any

import usb.core
import usb.util

from acquire.errors import TriggerError
from acquire.trigger.transports.base import READ_WAIT_S, UDEV_HINT
from acquire.trigger.transports.lock import PortLock

VENDOR, PRODUCT = 0x1209, 0x0001
"""The IDs of pid.codes for private testing."""
_WRITE_S = 2.0
# A multiple of every packet size: libusb reports an overflow if a packet exceeds the rest of the buffer.
_READ_BYTES = 16384
_IN = usb.util.ENDPOINT_IN
_BULK = usb.util.ENDPOINT_TYPE_BULK
_HINTS = {
    errno.EACCES: UDEV_HINT,
    errno.EPERM: UDEV_HINT,
    errno.EBUSY: "another program or a driver of the kernel has it: end that",
}


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """A trigger on the bus; ``lacks`` states why it cannot be used."""

    name: str
    serial: str
    lacks: str


def list_devices(backend: Any = None) -> list[FoundDevice]:
    """Return every trigger on the bus, without claiming any. Raises TriggerError without libusb."""
    try:
        found = list(usb.core.find(find_all=True, idVendor=VENDOR, idProduct=PRODUCT, backend=backend) or ())
    except usb.core.NoBackendError as error:
        raise TriggerError("no USB: libusb is not installed", hint="install libusb-1.0") from error
    name, listed = f"usb {VENDOR:04x}:{PRODUCT:04x}", []
    for device in found:
        serial = trouble = ""
        # Reading a serial number opens the device, which requires permission, and is undone below.
        try:
            serial = str(device.serial_number or "")
        except (usb.core.USBError, ValueError) as error:  # ValueError: no permission to read the languages
            trouble = f"it may not be opened ({error}); try: {UDEV_HINT}"
        finally:
            usb.util.dispose_resources(device)
        listed.append(FoundDevice(name, serial, trouble))
    return listed


class UsbTransport:
    """The device ``vendor:product``, with a ``serial`` number if several are on the bus.

    Uses the first interface with a bulk endpoint in each direction. Raises TriggerError if the device is not
    there, or may not be opened.
    """

    def __init__(
        self, vendor: int = VENDOR, product: int = PRODUCT, serial: str = "", backend: Any = None
    ) -> None:
        self.name = f"usb {vendor:04x}:{product:04x}{' ' + serial if serial else ''}"
        self.bytes_per_s = float("inf")
        self._lock = PortLock(self.name)
        self._device: Any = None
        try:
            self._device = self._find(vendor, product, serial, backend)
            self._in, self._out = self._claim()
        except (usb.core.USBError, NotImplementedError, ValueError) as error:
            # pyusb: no backend is a ValueError, a call that this host's libusb lacks NotImplementedError
            self.close()
            hint = _HINTS.get(getattr(error, "errno", None) or 0, "check cable and power")
            if isinstance(error, usb.core.NoBackendError):
                hint = "install libusb-1.0"
            raise TriggerError(f"{self.name} cannot be opened: {error}", hint=hint) from error
        except TriggerError:
            self.close()
            raise

    def read(self) -> bytes:
        try:
            return bytes(self._in.read(_READ_BYTES, round(READ_WAIT_S * 1000)))
        except usb.core.USBTimeoutError:
            return b""
        except usb.core.USBError as error:
            raise self._gone(error) from error

    def write(self, data: bytes) -> None:
        try:
            sent = self._out.write(data, round(_WRITE_S * 1000))
        except usb.core.USBTimeoutError as error:
            raise TriggerError(
                f"{self.name} took no byte for {_WRITE_S:g} s", hint="check cable and power, then arm again"
            ) from error
        except usb.core.USBError as error:
            raise self._gone(error) from error
        # A transfer may end short without an error; the rest, sent later, would not be a frame.
        if sent != len(data):
            raise TriggerError(
                f"{self.name} took {sent} of {len(data)} bytes", hint="check cable and power, then arm again"
            )

    def close(self) -> None:
        # Also a device that was opened and could not be claimed: its handle would stay.
        if self._device is not None:
            usb.util.dispose_resources(self._device)
        self._lock.release()  # last: whoever gets it finds the interface free

    def _find(self, vendor: int, product: int, serial: str, backend: Any) -> Any:
        # Read serial numbers only if one is given: it requires permission to open every device.
        found = list(usb.core.find(find_all=True, idVendor=vendor, idProduct=product, backend=backend) or ())
        if found and not serial:
            return found[0]
        devices = {}
        for device in found:
            number = str(device.serial_number or "")
            devices[number] = device
            if number != serial:
                usb.util.dispose_resources(device)  # reading its number has opened it
        if serial in devices:
            return devices[serial]
        raise TriggerError(
            f"{self.name} is not on the bus",
            possible=", ".join(devices) or "no device of this kind is there",
            hint="check cable and power",
        )

    def _claim(self) -> tuple[Any, Any]:
        for interface in self._device.get_active_configuration():
            bulk = [end for end in interface if usb.util.endpoint_type(end.bmAttributes) == _BULK]
            ways = {usb.util.endpoint_direction(end.bEndpointAddress): end for end in bulk}
            if len(ways) == 2:
                usb.util.claim_interface(self._device, interface.bInterfaceNumber)
                return ways[_IN], ways[usb.util.ENDPOINT_OUT]
        raise TriggerError(
            f"{self.name} has no interface with a bulk endpoint in each direction",
            hint="load the firmware that belongs to this program",
        )

    def _gone(self, error: usb.core.USBError) -> TriggerError:
        what = "was unplugged" if error.errno == errno.ENODEV else "failed"
        return TriggerError(f"{self.name} {what}: {error}", hint="check cable and power")
