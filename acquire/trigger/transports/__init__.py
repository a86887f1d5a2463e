"""Ways for bytes between host and trigger: serial ports and what pyserial can open, USB bulk."""

from acquire.trigger.transports.base import Transport

__all__ = ["Transport"]
