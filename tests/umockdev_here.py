"""Whether this machine can make up a USB bus for a real libusb."""

from __future__ import annotations

import functools
import shutil
import subprocess
import sys

import usb.backend.libusb1

_BINDINGS = "import gi; gi.require_version('UMockdev', '1.0'); from gi.repository import UMockdev"


def missing() -> str | None:
    """What is not there, None if nothing."""
    if shutil.which("umockdev-wrapper") is None:
        return "no umockdev-wrapper (Debian: umockdev)"
    if usb.backend.libusb1.get_backend() is None:
        return "no libusb-1.0 (Debian: libusb-1.0-0)"
    return (
        None
        if interpreter()
        else "no Python with umockdev's bindings (Debian: gir1.2-umockdev-1.0 python3-gi)"
    )


@functools.cache
def interpreter() -> str | None:
    """A Python that has umockdev's bindings: rarely that of a virtual environment."""
    for python in (sys.executable, "/usr/bin/python3"):
        if (
            shutil.which(python)
            and not subprocess.run([python, "-c", _BINDINGS], capture_output=True, check=False).returncode
        ):
            return python
    return None
