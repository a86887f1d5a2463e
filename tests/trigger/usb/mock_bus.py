"""A USB bus without hardware for a program with the real libusb; run by umockdev-wrapper.

``mock_bus.py PORT COMMAND…``: runs COMMAND with one device on its bus, whose two bulk endpoints end at the
terminal PORT. Ends with the command's exit code. This runs in the system's Python, which has umockdev's
bindings and none of the packages of the project; so it imports nothing else.

libusb talks to ``/dev/bus/usb/001/002`` in ioctls: a transfer is submitted as an URB, and reaped when it is
complete. A reading URB is complete when the terminal has bytes.
"""

import errno
import os
import select
import struct
import subprocess
import sys

import gi

gi.require_version("UMockdev", "1.0")
from gi.repository import GLib, UMockdev  # noqa: E402

NODE = "/dev/bus/usb/001/002"
SUBMITURB, DISCARDURB, REAPURBNDELAY = 0x8038550A, 0x550B, 0x4008550D
CLAIM, RELEASE, GET_CAPABILITIES = 0x8004550F, 0x80045510, 0x8004551A
CONTROL, BULK = 2, 3
URB = struct.Struct("@BBiIQiiiiiIQ")
STATUS_AT, BUFFER_AT, ACTUAL_AT = 4, 16, 28
DESCRIPTORS = bytes.fromhex(
    "12010002000000400912010000010003 0301"  # device 1209:0001, USB 2.0, serial number: string 3
    "0902200001010080320904000002ff000000"  # a configuration with one interface of two endpoints
    "07058102000200"  # bulk in, 512 bytes
    "07050102000200"  # bulk out
)
STRINGS = {0: b"\x04\x03\x09\x04", 3: b"\x06\x03" + "42".encode("utf-16-le")}
DEVICE = f"""P: /devices/usb1/1-1
N: bus/usb/001/002
E: DEVNAME=/dev/bus/usb/001/002
E: DEVTYPE=usb_device
E: SUBSYSTEM=usb
E: BUSNUM=001
E: DEVNUM=002
E: PRODUCT=1209/1/100
A: busnum=1\\n
A: devnum=2\\n
A: speed=480\\n
A: bConfigurationValue=1\\n
A: bNumConfigurations=1\\n
A: idVendor=1209\\n
A: idProduct=0001\\n
H: descriptors={DESCRIPTORS.hex().upper()}
"""


class Bus(UMockdev.IoctlBase):
    def __init__(self, port: int) -> None:
        super().__init__()
        self.port = port
        self.pending: list = []
        self.done: list = []
        self.gone = False

    def do_handle_ioctl(self, client) -> bool:
        request, argument = client.get_request(), client.get_arg()
        refusal = 0
        if request == SUBMITURB and self.gone:
            refusal = errno.ENODEV
        elif request == SUBMITURB:
            self.submit(argument.resolve(0, URB.size))
        elif request == REAPURBNDELAY:
            refusal = self.reap(argument.resolve(0, 8))
        elif request == DISCARDURB:
            self.discard(argument)
        elif request == GET_CAPABILITIES:
            argument.resolve(0, 4).update(0, list(struct.pack("@I", 0)))
        elif request not in (CLAIM, RELEASE):
            refusal = errno.ENOTTY
        client.complete(-1 if refusal else 0, refusal)
        return True

    def submit(self, urb) -> None:
        kind, endpoint, *_, length, _, _, _, _, _, _ = URB.unpack(bytes(urb.retrieve()))
        buffer = urb.resolve(BUFFER_AT, length) if length else None
        if kind == CONTROL:
            value = bytes(buffer.retrieve())[2]
            text = STRINGS.get(value, b"")
            buffer.update(8, list(text))
            self.finish(urb, 0, len(text))
        elif endpoint & 0x80:
            self.pending.append((urb, buffer, length))
        else:
            self.finish(urb, 0, os.write(self.port, bytes(buffer.retrieve())))

    def finish(self, urb, status: int, actual: int) -> None:
        urb.update(STATUS_AT, list(struct.pack("@i", status)))
        urb.update(ACTUAL_AT, list(struct.pack("@i", actual)))
        self.done.append(urb)

    def reap(self, pointer) -> int:
        if self.pending and select.select([self.port], [], [], 0)[0]:
            urb, buffer, length = self.pending.pop(0)
            data = self.read(length)
            buffer.update(0, list(data))
            self.finish(urb, -errno.ENODEV if self.gone else 0, len(data))
        if not self.done:
            return errno.EAGAIN
        pointer.set_ptr(0, self.done.pop(0))
        return 0

    def read(self, length: int) -> bytes:
        """A terminal that hangs up is an unplugged device."""
        try:
            data = os.read(self.port, length)
        except OSError:
            data = b""
        self.gone = not data
        return data

    def discard(self, argument) -> None:
        (address,) = struct.unpack("@Q", bytes(argument.retrieve()))
        for entry in self.pending:
            if entry[0].client_addr == address:
                self.pending.remove(entry)
                self.finish(entry[0], -errno.ENOENT, 0)
                return


def main(port: str, *command: str) -> int:
    testbed = UMockdev.Testbed.new()
    testbed.add_from_string(DEVICE)
    testbed.attach_ioctl(NODE, Bus(os.open(port, os.O_RDWR | os.O_NOCTTY)))
    child, loop, codes = subprocess.Popen(command), GLib.MainLoop(), []

    def ended(pid: int, status: int) -> None:
        codes.append(os.waitstatus_to_exitcode(status))
        loop.quit()

    GLib.child_watch_add(GLib.PRIORITY_DEFAULT, child.pid, ended)
    loop.run()
    testbed.detach_ioctl(NODE)
    return codes[0]


raise SystemExit(main(*sys.argv[1:]))
