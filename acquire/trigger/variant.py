"""What a trigger driver is to a rig: options of its own, what it refuses, and what connects to the device."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

from acquire.config.base import FrozenModel
from acquire.errors import ConfigError, TriggerError
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
    """

    simulated: ClassVar[bool] = False

    @abstractmethod
    def open(self, config: RigConfig, bench: Any) -> Trigger:
        """The rig's trigger, connected when it is first used.

        ``bench`` is the rig's `acquire.sim.instrument.SimulatedDevices` where anything of it is simulated,
        else None.
        """

    def check(self, config: RigConfig) -> None:  # most can do all that a file may ask for
        """Raise ConfigError for what this trigger cannot honour. Touches no device."""


class GatewareTrigger(TriggerVariant):
    """Our gateware, or a twin of it, at the end of some way for bytes."""

    @abstractmethod
    def transport(self, config: RigConfig, bench: Any) -> Callable[[], Transport]:
        """What opens the way to the device."""

    def bytes_per_s(self, trigger: TriggerConfig) -> float:  # noqa: ARG002
        """What the way carries; infinite where it is no limit."""
        return float("inf")

    def possible(self, trigger: TriggerConfig) -> Capabilities:
        """What such a device can do, as far as is known before it is asked."""
        return replace(GATEWARE, clock_hz=trigger.clock_hz)

    def open(self, config: RigConfig, bench: Any) -> Trigger:
        return TriggerDriver(self.transport(config, bench), config.trigger)

    def check(self, config: RigConfig) -> None:
        trigger = config.trigger
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
