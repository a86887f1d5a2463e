"""A USB bus within this process: a backend for pyusb without hardware and libusb."""

from __future__ import annotations

import errno
import os
import threading
from array import array
from types import SimpleNamespace

import usb.backend
import usb.core

from acquire.trigger.transports.usb import PRODUCT, VENDOR


class FakeBus(usb.backend.IBackend):
    """One device with a bulk endpoint each way, a twin behind it.

    ``gone`` is the unplugged state; ``refusal`` the errno with which it is not given away.
    """

    def __init__(self, twin, product: int = PRODUCT) -> None:
        self.twin, self.product, self.gone, self.claimed = twin, product, False, 0
        self.refusal: int | None = None
        self.open = 0
        """Number of handles."""
        self.rest = b""

    def unplug(self) -> None:
        self.gone = True

    def enumerate_devices(self):
        return ["device"]

    def get_device_descriptor(self, dev):
        names = ("bLength", 18), ("bDescriptorType", 1), ("bcdUSB", 0x200), ("bDeviceClass", 0)
        more = ("bDeviceSubClass", 0), ("bDeviceProtocol", 0), ("bMaxPacketSize0", 64), ("bcdDevice", 0x100)
        ids = ("idVendor", VENDOR), ("idProduct", self.product), ("iManufacturer", 0), ("iProduct", 0)
        rest = ("iSerialNumber", 3), ("bNumConfigurations", 1), ("address", 4), ("bus", 1), ("speed", 3)
        return SimpleNamespace(**dict((*names, *more, *ids, *rest)), port_number=1, port_numbers=(1,))

    def get_configuration_descriptor(self, dev, config):
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=2,
            wTotalLength=32,
            bNumInterfaces=1,
            bConfigurationValue=1,
            iConfiguration=0,
            bmAttributes=0x80,
            bMaxPower=50,
            extra_descriptors=[],
        )

    def get_interface_descriptor(self, dev, intf, alt, config):
        if intf or alt:
            raise IndexError
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=4,
            bInterfaceNumber=0,
            bAlternateSetting=0,
            bNumEndpoints=2,
            bInterfaceClass=255,
            bInterfaceSubClass=0,
            bInterfaceProtocol=0,
            iInterface=0,
            extra_descriptors=[],
        )

    def get_endpoint_descriptor(self, dev, ep, intf, alt, config):
        return SimpleNamespace(
            bLength=7,
            bDescriptorType=5,
            bEndpointAddress=(0x81, 0x01)[ep],
            bmAttributes=2,
            wMaxPacketSize=512,
            bInterval=0,
            bRefresh=0,
            bSynchAddress=0,
            extra_descriptors=[],
        )

    def open_device(self, dev):
        self._refuse(errno.EACCES)
        self.open += 1
        return dev

    def close_device(self, dev_handle):
        self.open -= 1

    def get_configuration(self, dev_handle):
        return 1

    def _refuse(self, *reasons: int) -> None:
        """Refuse as libusb does: without permission to open, or to claim a device in use."""
        if self.refusal in reasons:
            raise usb.core.USBError(os.strerror(self.refusal), None, self.refusal)

    def claim_interface(self, dev_handle, intf):
        self._refuse(errno.EBUSY, errno.EIO)
        self.claimed += 1

    def release_interface(self, dev_handle, intf):
        self.claimed -= 1

    def ctrl_transfer(self, dev_handle, bmRequestType, bRequest, wValue, wIndex, data, timeout):
        text = b"\x04\x03\x09\x04" if not wValue & 0xFF else b"\x06\x03" + "42".encode("utf-16-le")
        data[: len(text)] = array("B", text)
        return len(text)

    def bulk_write(self, dev_handle, ep, intf, data, timeout):
        self._demand()
        self.twin.feed(bytes(data))
        return len(data)

    def bulk_read(self, dev_handle, ep, intf, buff, timeout):
        self._demand()
        data = self.rest or self.twin.take()
        if not data:
            threading.Event().wait(min(timeout, 2) / 1000)
            raise usb.core.USBTimeoutError("timed out", None, errno.ETIMEDOUT)
        data, self.rest = data[: len(buff)], data[len(buff) :]
        buff[: len(data)] = array("B", data)
        return len(data)

    def _demand(self):
        if self.gone:
            raise usb.core.USBError("No such device", None, errno.ENODEV)
