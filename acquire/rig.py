"""The composition root: a rig's configuration becomes devices, here and nowhere else.

Above this file nobody knows whether a device is simulated; below it no device knows of another, except
through the wire that the rig lays between simulated ones.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self, cast

from acquire.errors import ConfigError, UsageError
from acquire.lines import ARMS

if TYPE_CHECKING:
    from types import TracebackType

    from acquire.camera.base import CameraOpener
    from acquire.camera.variant import CameraVariant
    from acquire.config import RigConfig
    from acquire.config.device import TriggerConfig
    from acquire.sim.instrument import SimulatedDevices
    from acquire.sim.scene import Scene
    from acquire.trigger.base import Trigger
    from acquire.trigger.variant import TriggerVariant


class Rig:
    """The devices of one instrument; a context manager that closes them.

    Building one touches no device; it reads the scene where cameras see one. Raises ConfigError for files and
    values, UsageError for a scene that cannot be shown to these cameras.
    """

    def __init__(self, config: RigConfig) -> None:
        check_rig(config)
        self.config = config
        self._simulated = _simulated_devices(config)
        self._closed = False
        self.trigger: Trigger = _trigger(config).open(config, self._simulated)

    def openers(self) -> dict[str, CameraOpener]:
        """Arm → what opens its camera, here or in a process being spawned."""
        if self.config.columns:
            return dict.fromkeys(ARMS, self._opener(ARMS[0]))
        return {arm: self._opener(arm) for arm in ARMS}

    def _opener(self, arm: str) -> CameraOpener:
        if self.config.simulation.replay is not None:
            return self.simulated.replay(arm)
        variant = cast("CameraVariant", self.config.cameras.arm(arm).options)
        return variant.opener(self.config, arm, self._simulated)

    @property
    def simulated(self) -> SimulatedDevices:
        """The simulated ones of the rig's devices. Raises UsageError where all are real."""
        if self._simulated is None:
            raise UsageError(f"rig {self.config.name} has no simulated device")
        return self._simulated

    def describe(self) -> dict[str, Any]:
        """What a recording must say about where its lines come from (JSON)."""
        return {"simulated": False} if self._simulated is None else self._simulated.describe()

    @property
    def layout(self) -> str:
        """How the instrument is laid out: ``dual``, ``compact``, ``emulated``, ``interline``, ``fibre``."""
        return self.config.cameras.layout if self._simulated is None else self._simulated.layout

    def scene(self) -> Scene:
        """What simulated cameras see, in camera A's rows and columns; sub-step 0 is the run's first."""
        return self.simulated.scene()

    def close(self) -> None:
        """Stop the trigger and take simulated devices away. Idempotent."""
        if self._closed:
            return
        self._closed = True
        if self._simulated is not None:
            self._simulated.close_cameras()
        self.trigger.close()
        if self._simulated is not None:
            self._simulated.close_wires()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _simulated_devices(config: RigConfig) -> SimulatedDevices | None:
    """None where there are none: the simulator is then not even imported."""
    if not _trigger(config).simulated and not config.simulates_cameras:
        return None  # nor is a recording replayed, see `check_rig`
    from acquire.sim.instrument import SimulatedDevices

    return SimulatedDevices(config)


def check_rig(config: RigConfig) -> None:
    """Raise ConfigError for what no trigger, or not the rig's simulated cameras, can honour."""
    trigger = config.trigger
    if config.simulation.replay is not None and trigger.driver != "simulated":
        raise ConfigError(f"a replay cannot have trigger.driver = {trigger.driver!r}", possible="'simulated'")
    if not _trigger(config).simulated and config.simulation.speed != 1:
        raise ConfigError(
            f"simulation.speed = {config.simulation.speed:g} does not go with "
            f"trigger.driver = {trigger.driver!r}",
            possible="1: its time is real",
        )
    _trigger(config).check(config)
    if config.simulates_cameras:
        _check_simulated_cameras(trigger, simulated=_trigger(config).simulated)


def _check_simulated_cameras(trigger: TriggerConfig, *, simulated: bool) -> None:
    """They see when lines begin and which code the light follows; a simulated trigger has no inputs."""
    pulsed = trigger.driver != "simulated" and trigger.lit_part != (0.0, 1.0)
    for ignored, key, possible in (
        (not simulated, f"driver = {trigger.driver!r}", "'simulated'"),
        (trigger.external_start != "off", f"external_start = {trigger.external_start!r}", "'off'"),
        (trigger.line_start != "per-line", f"line_start = {trigger.line_start!r}", "'per-line'"),
        (not trigger.a.enable, "a.enable = false", "true"),
        (not trigger.b.enable, "b.enable = false", "true"),
        (trigger.a.direction != "forward", f"a.direction = {trigger.a.direction!r}", "'forward'"),
        (trigger.b.direction != "forward", f"b.direction = {trigger.b.direction!r}", "'forward'"),
        (
            pulsed,
            "light.open_ticks, light.close_ticks",
            "absent; or driver = 'simulated'",
        ),
    ):
        if ignored:
            raise ConfigError(f"trigger.{key}: cannot be simulated", possible=possible)


def open_trigger(config: RigConfig) -> Trigger:
    """The rig's trigger without its cameras; connected when first used."""
    return _trigger(config).open(config, None)


def _trigger(config: RigConfig) -> TriggerVariant:
    return cast("TriggerVariant", config.trigger.options)  # which the configuration has made sure of
