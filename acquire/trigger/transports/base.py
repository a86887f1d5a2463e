"""Interface of transports, which carry a link's bytes."""

from __future__ import annotations

from typing import Protocol

READ_WAIT_S = 0.05
"""How long one `Transport.read` may wait, and so how late its thread notices a request to end."""
UDEV_HINT = (
    "install the udev rule (acquire install-service --udev prints it and says how), or for a serial port "
    "join the group dialout; then log in again"
)


class Transport(Protocol):
    """An open connection. One thread reads, one at a time writes. Raises TriggerError once it is gone."""

    name: str
    """The port's URL as the user wrote it, or the USB device."""
    bytes_per_s: float
    """Rate in one direction; inf if there is no known limit."""

    def read(self) -> bytes:
        """Return the bytes that have come; wait at most `READ_WAIT_S` for the first, then return b""."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of it; bounded in time."""
        ...

    def close(self) -> None:
        """Close the connection. Idempotent."""
        ...
