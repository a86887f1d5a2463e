"""Transport over anything that pyserial opens: a port, ``socket://host:port``, ``loop://``, a pseudo-
terminal."""

from __future__ import annotations

import errno
import termios
from dataclasses import dataclass
from pathlib import Path

import serial
from serial.tools.list_ports import comports

from acquire.errors import TriggerError
from acquire.trigger.transports.base import READ_WAIT_S, UDEV_HINT
from acquire.trigger.transports.lock import PortLock, holder_of

BITS_PER_BYTE = 10
"""8N1."""
_WRITE_S = 2.0
_READ_BYTES = 4096


@dataclass(frozen=True, slots=True)
class FoundPort:
    """A serial port of this host; ``held_by``: its user, if that locks ports in the same way."""

    device: str
    description: str
    serial_number: str
    held_by: str


def list_ports() -> list[FoundPort]:
    """Return the existing ports, without opening any."""
    found = []
    for port in sorted(comports()):
        description = "" if port.description == "n/a" else port.description  # pyserial's text for none
        held_by = holder_of(_lock_name(port.device))
        found.append(FoundPort(port.device, description, port.serial_number or "", held_by))
    return found


class SerialTransport:
    """An open serial port, locked against a second user.

    Modem lines are used for ``rts_cts`` only: pseudo-terminals and many boards have none. Raises TriggerError
    if the port is not there, or in use.
    """

    def __init__(self, url: str, baud: int, *, rts_cts: bool = False) -> None:
        self.name = url
        self._local = local = "://" not in url
        self.bytes_per_s = baud / BITS_PER_BYTE if local else float("inf")
        # Lock before opening: opening a port that another program reads takes some of its bytes.
        self._lock = PortLock(_lock_name(url) if local else url)
        try:
            self._port = serial.serial_for_url(
                url, baudrate=baud, timeout=READ_WAIT_S, write_timeout=_WRITE_S, rtscts=rts_cts
            )
            self._port.reset_input_buffer()  # drops answers to the previous user of the port
        # SerialException is an OSError; termios.error, of a port that vanishes while it is set up, is not
        except (OSError, ValueError, termios.error) as error:
            self._lock.release()
            # The advice depends on the cause: no permission, a wrong address, or a port that is missing.
            if getattr(error, "errno", None) in (errno.EACCES, errno.EPERM):
                raise TriggerError(f"{url} may not be opened: permission denied", hint=UDEV_HINT) from error
            if not local:
                hint = "check the address"
                raise TriggerError(f"{url} cannot be opened: {error}", hint=hint) from error
            ports = ", ".join(sorted(port.device for port in comports()))
            what = "is not there" if not Path(url).exists() else f"cannot be opened: {error}"
            # pyserial has the number in its text alone
            if Path(url).exists() and (not Path(url).is_char_device() or f"({errno.ENOTTY}, " in str(error)):
                what = "is not a serial port"
            raise TriggerError(
                f"{url} {what}", possible=ports or "no serial port", hint="check cable and power"
            ) from error

    def read(self) -> bytes:
        try:
            if self._local:
                # What is there, or one byte: pyserial waits for all the bytes that it is asked for.
                return bytes(self._port.read(self._port.in_waiting or 1))
            # A socket does not report how much is waiting; with timeout 0 it returns what it has.
            data = bytes(self._port.read(1))
            if data:
                self._port.timeout = 0
                data += self._port.read(_READ_BYTES)
                self._port.timeout = READ_WAIT_S
        except OSError as error:
            raise self._gone(error) from error
        return data

    def write(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except serial.SerialTimeoutException as error:
            raise TriggerError(
                f"{self.name} took no byte for {_WRITE_S:g} s",
                hint="check cable and power, and trigger.flow_control:"
                " 'rts-cts' needs both lines of the board",
            ) from error
        except OSError as error:
            raise self._gone(error) from error

    def close(self) -> None:
        remote = getattr(self._port, "_socket", None)
        self._port.close()
        if remote is not None:
            remote.close()  # pyserial leaves it open if the other end is gone
        self._lock.release()

    def _gone(self, error: OSError) -> TriggerError:
        return TriggerError(f"{self.name} is gone: {error}", hint="check cable and power")


def _lock_name(path: str) -> str:
    """Return one name per port, also for links to it."""
    return str(Path(path).resolve())  # /dev/serial/by-id/… is a link to what another rig calls /dev/ttyUSB0
