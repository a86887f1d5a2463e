"""The drivers of a board with this project's gateware, at a serial port or on USB."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from acquire.trigger.transports.serial import BITS_PER_BYTE, SerialTransport
from acquire.trigger.transports.usb import UsbTransport
from acquire.trigger.variant import GatewareTrigger

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.config import RigConfig
    from acquire.config.device import TriggerConfig
    from acquire.trigger.transports import Transport


class SerialTrigger(GatewareTrigger):
    """A board at a serial port, or at anything else that pyserial opens, such as socket://host:port."""

    def transport(self, config: RigConfig, bench: Any) -> Callable[[], Transport]:  # noqa: ARG002
        trigger = config.trigger
        return partial(SerialTransport, trigger.url, trigger.baud, rts_cts=trigger.flow_control == "rts-cts")

    def bytes_per_s(self, trigger: TriggerConfig) -> float:
        return trigger.baud / BITS_PER_BYTE


class UsbTrigger(GatewareTrigger):
    """A board whose gateware is a USB device itself."""

    def transport(self, config: RigConfig, bench: Any) -> Callable[[], Transport]:  # noqa: ARG002
        return partial(UsbTransport, serial=config.trigger.serial)
