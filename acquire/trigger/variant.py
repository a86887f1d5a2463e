"""A rig's view of a trigger driver: its options, its checks, and the connection to the device."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

from acquire.config.base import FrozenModel
from acquire.errors import ConfigError, TriggerError, UsageError
from acquire.text import shown
from acquire.trigger.base import TriggerRun
from acquire.trigger.driver import TriggerDriver
from acquire.trigger.settings import GATEWARE, register_values

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.config import RigConfig
    from acquire.config.device import TriggerConfig
    from acquire.trigger.base import Trigger
    from acquire.trigger.settings import Capabilities
    from acquire.trigger.transports import Transport


class TriggerVariant(FrozenModel, ABC):
    """A driver with its options (``[trigger.options]``), none by default. Named by an entry point.

    ``simulated``: its pulses reach simulated cameras, and its time may run at another speed.
    ``has_exact_light``: it passes the light's lead and window on to simulated cameras, and can pace a replay;
    of any other, these cameras only see for each sub-step whether it was lit for most of it.
    """

    simulated: ClassVar[bool] = False
    has_exact_light: ClassVar[bool] = False

    @abstractmethod
    def open(self, config: RigConfig, bench: Any) -> Trigger:
        """Return the rig's trigger, which connects when it is first used.

        ``bench`` is the rig's `acquire.sim.instrument.SimulatedDevices` if anything of it is simulated,
        otherwise None.
        """

    def check(self, config: RigConfig) -> None:  # most triggers support everything that a file can request
        """Raise ConfigError for settings that this trigger does not support. Touches no device."""


class GatewareTrigger(TriggerVariant):
    """This project's gateware, or a twin of it, behind a transport."""

    @abstractmethod
    def transport(self, config: RigConfig, bench: Any) -> Callable[[], Transport]:
        """Return the function that opens the transport to the device."""

    def bytes_per_s(self, trigger: TriggerConfig) -> float:  # noqa: ARG002 - used by subclasses
        """Return the rate of the transport; infinite if it is no limit."""
        return float("inf")

    def possible(self, trigger: TriggerConfig) -> Capabilities:
        """Return the capabilities of such a device, as far as they are known before it is connected."""
        return replace(GATEWARE, clock_hz=trigger.clock_hz)

    def open(self, config: RigConfig, bench: Any) -> Trigger:
        connect = self.transport(config, bench)
        if not callable(connect):
            raise UsageError(
                f"trigger driver {config.trigger.driver!r} gave back {shown(connect)} from transport",
                possible="a function that opens the transport",
            )
        return TriggerDriver(connect, config.trigger)

    def check(self, config: RigConfig) -> None:
        trigger = config.trigger
        # As `prepare` would, so that a rig is refused when its file is read, and not when it is armed.
        run = TriggerRun(
            "check",
            config.code.build(),
            config.geometry.substeps,
            trigger.substep_ticks,
            trigger.tag_every_lines,
        )
        try:
            register_values(run, trigger, self.possible(trigger), self.bytes_per_s(trigger))
        except TriggerError as error:
            raise ConfigError(error.message, possible=error.possible, hint=error.hint) from error
