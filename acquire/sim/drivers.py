"""The drivers of simulated devices. The simulation itself is imported when a rig opens one."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

from acquire.camera.variant import CameraVariant
from acquire.trigger.variant import GatewareTrigger

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.camera.base import CameraOpener
    from acquire.config import RigConfig
    from acquire.config.device import TriggerConfig
    from acquire.sim.instrument import SimulatedDevices
    from acquire.trigger.settings import Capabilities
    from acquire.trigger.transports import Transport


class SimulatedCameras(CameraVariant):
    """Lines computed from the scene, in the process that captures them."""

    simulated: ClassVar[bool] = True
    sees_scene: ClassVar[bool] = True

    def opener(self, config: RigConfig, arm: str, bench: SimulatedDevices) -> CameraOpener:  # noqa: ARG002
        return bench.sensor(arm)


class PatternCameras(CameraVariant):
    """Stored lines in place of a scene, at any rate, for load tests."""

    simulated: ClassVar[bool] = True
    sees_light: ClassVar[bool] = False

    def opener(self, config: RigConfig, arm: str, bench: SimulatedDevices) -> CameraOpener:  # noqa: ARG002
        return bench.pattern(arm)


class GentlCameras(CameraVariant):
    """Simulated cameras behind the project's own GenTL producer, driven through harvesters."""

    simulated: ClassVar[bool] = True
    sees_scene: ClassVar[bool] = True

    def opener(self, config: RigConfig, arm: str, bench: SimulatedDevices) -> CameraOpener:  # noqa: ARG002
        return bench.gentl(arm)


class GigeCameras(CameraVariant):
    """Simulated cameras behind the project's own GigE Vision port, driven through Aravis."""

    simulated: ClassVar[bool] = True
    sees_scene: ClassVar[bool] = True

    def opener(self, config: RigConfig, arm: str, bench: SimulatedDevices) -> CameraOpener:  # noqa: ARG002
        return bench.gige(arm)


class SimulatedTrigger(GatewareTrigger):
    """A model of the gateware, in this process."""

    simulated: ClassVar[bool] = True
    has_exact_light: ClassVar[bool] = True

    def transport(self, config: RigConfig, bench: SimulatedDevices | None) -> Callable[[], Transport]:
        from acquire.sim.instrument import unconnected_transport

        return unconnected_transport(config) if bench is None else bench.transport()

    def possible(self, trigger: TriggerConfig) -> Capabilities:
        from acquire.sim.trigger_registers import INPUTS

        return replace(super().possible(trigger), inputs=INPUTS)


class CompiledTrigger(SimulatedTrigger):
    """The gateware itself, compiled, with pins that the simulated cameras read."""

    has_exact_light: ClassVar[bool] = False

    def bytes_per_s(self, trigger: TriggerConfig) -> float:
        from acquire.sim import rtl
        from acquire.trigger.transports.serial import BITS_PER_BYTE

        return rtl.baud(trigger.clock_hz) / BITS_PER_BYTE

    def possible(self, trigger: TriggerConfig) -> Capabilities:
        # The compiled gateware has all of its inputs, the model only some.
        return GatewareTrigger.possible(self, trigger)
