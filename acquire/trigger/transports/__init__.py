"""Transports of bytes between host and trigger: serial ports and anything that pyserial opens, USB bulk."""

from acquire.trigger.transports.base import Transport

__all__ = ["Transport"]
