"""What a link asks of the thing that carries its bytes."""

from __future__ import annotations

from typing import Protocol

READ_WAIT_S = 0.05
"""How long one `Transport.read` may wait: also how long its reader takes to notice that it shall end."""
UDEV_HINT = "install the udev rule that comes with the firmware, or join the group dialout; then log in again"


class Transport(Protocol):
    """An open connection. One thread reads, one at a time writes. Raises TriggerError once it is gone."""

    name: str
    """As the user wrote it: the port's URL, or the USB device."""
    bytes_per_s: float
    """What the way can carry in one direction; inf where nothing is known to limit it."""

    def read(self) -> bytes:
        """What has come; waits at most `READ_WAIT_S` for the first byte, then returns b""."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of it; bounded in time."""
        ...

    def close(self) -> None:
        """Close the connection. Idempotent."""
        ...
