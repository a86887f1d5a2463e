"""The composition root: a rig's configuration becomes devices, here and nowhere else.

Layers above this file do not depend on whether a device is simulated. Below it, devices are independent of
one another, except for the wire that the rig lays between simulated ones.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self, cast

from acquire.camera.checked import checked_opener
from acquire.errors import ConfigError, UsageError
from acquire.lines import ARMS
from acquire.plugins import CAMERAS, CODECS, TRIGGERS, of_others
from acquire.trigger.checked import open_checked

if TYPE_CHECKING:
    from types import TracebackType

    from acquire.camera.base import CameraOpener
    from acquire.camera.variant import CameraVariant
    from acquire.config import RigConfig
    from acquire.sim.instrument import SimulatedDevices
    from acquire.sim.scene import Scene
    from acquire.trigger.base import Trigger
    from acquire.trigger.variant import TriggerVariant


class Rig:
    """The devices of one instrument; a context manager that closes them.

    The constructor touches no device, but reads the scene of simulated cameras. Raises ConfigError for files
    and values, UsageError for a scene that does not suit these cameras.
    """

    def __init__(self, config: RigConfig) -> None:
        check_rig(config)
        self.config = config
        self._simulated: SimulatedDevices | None = None
        # A replay needs the simulated trigger, too; see `check_rig`.
        if _trigger(config).simulated or config.simulates_cameras:
            from acquire.sim.instrument import SimulatedDevices  # only here: a real rig never loads it

            self._simulated = SimulatedDevices(config)
        self._closed = False
        self.trigger: Trigger = open_trigger(config, self._simulated)

    def openers(self) -> dict[str, CameraOpener]:
        """Return arm → opener of its camera, for use here or in a child process."""
        if self.config.columns:
            return dict.fromkeys(ARMS, self._opener(ARMS[0]))
        return {arm: self._opener(arm) for arm in ARMS}

    def _opener(self, arm: str) -> CameraOpener:
        if self.config.simulation.replay is not None:
            return self.simulated.replay(arm)
        camera = self.config.cameras.arm(arm)
        variant = cast("CameraVariant", camera.options)
        if whose := CAMERAS.whose(camera.driver):
            return checked_opener(whose, variant, self.config, arm, self._simulated)
        return variant.opener(self.config, arm, self._simulated)

    @property
    def simulated(self) -> SimulatedDevices:
        """The simulated devices of the rig. Raises UsageError if all devices are real."""
        if self._simulated is None:
            raise UsageError(
                f"rig {self.config.name} has no simulated device",
                possible="a camera or trigger whose driver is a simulated one",
                hint="acquire plugins, which lists the drivers",
            )
        return self._simulated

    def describe(self) -> dict[str, Any]:
        """Return what a recording must state about the origin of its lines (JSON)."""
        origin: dict[str, Any] = (
            {"simulated": False} if self._simulated is None else self._simulated.describe()
        )
        config = self.config
        drivers = [(TRIGGERS, config.trigger.driver)]
        if config.simulation.replay is None:  # otherwise no camera is opened
            drivers = [*((CAMERAS, config.cameras.arm(arm).driver) for arm in ARMS), *drivers]
        used = of_others([*drivers, (CODECS, config.recording.codec)])
        return {**origin, "plugins": [*used, *origin.get("plugins", ())]}

    @property
    def layout(self) -> str:
        """Layout of the instrument: ``dual``, ``compact``, ``emulated``, ``interline`` or ``fibre``."""
        return self.config.cameras.layout if self._simulated is None else self._simulated.layout

    def scene(self) -> Scene:
        """Return the simulated cameras' scene in camera A's view; sub-step 0 is the run's first."""
        return self.simulated.scene()

    def close(self) -> None:
        """Stop the trigger and close the simulated devices. Idempotent."""
        if self._closed:
            return
        self._closed = True
        if self._simulated is not None:
            # Before the trigger, whose pulses they read. The wire goes last, since a stop is written to it.
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


def check_rig(config: RigConfig) -> None:
    """Raise ConfigError for settings that no trigger, or not the rig's simulated cameras, can honour."""
    trigger = config.trigger
    if config.simulation.replay is not None and not _trigger(config).has_exact_light:
        raise ConfigError(f"a replay cannot have trigger.driver = {trigger.driver!r}", possible="'simulated'")
    if not _trigger(config).simulated and config.simulation.speed != 1:
        raise ConfigError(
            f"simulation.speed = {config.simulation.speed:g} does not go with "
            f"trigger.driver = {trigger.driver!r}",
            possible="1, since that trigger runs in real time",
        )
    _trigger(config).check(config)
    if config.simulates_cameras:
        _check_simulated_cameras(config)


def _check_simulated_cameras(config: RigConfig) -> None:
    """Refuse trigger settings that simulated cameras would ignore.

    They only receive the line starts and the code of the light, and a simulated trigger has no inputs.
    """
    trigger, variant = config.trigger, _trigger(config)
    if not variant.simulated:
        # One of the two may be real.
        named = {arm: config.cameras.arm(arm).driver for arm in ARMS}
        drivers = ", ".join(f"{arm}: {name}" for arm, name in named.items() if CAMERAS.load(name).simulated)
        raise ConfigError(
            f"simulated cameras ({drivers}) cannot be triggered by trigger.driver = {trigger.driver!r}",
            possible="a simulated trigger, such as 'simulated'",
        )
    on_pins = not variant.has_exact_light
    pulsed, leads = trigger.lit_part != (0.0, 1.0), trigger.light.lead_ticks != 0
    for ignored, key, possible in (
        (trigger.external_start != "off", f"external_start = {trigger.external_start!r}", "'off'"),
        (trigger.line_start != "per-line", f"line_start = {trigger.line_start!r}", "'per-line'"),
        (not trigger.a.enable, "a.enable = false", "true"),
        (not trigger.b.enable, "b.enable = false", "true"),
        (trigger.a.direction != "forward", f"a.direction = {trigger.a.direction!r}", "'forward'"),
        (trigger.b.direction != "forward", f"b.direction = {trigger.b.direction!r}", "'forward'"),
        (on_pins and pulsed, "light.open_ticks, light.close_ticks", "absent, or driver = 'simulated'"),
        (on_pins and leads, f"light.lead_ticks = {trigger.light.lead_ticks}", "0, or driver = 'simulated'"),
    ):
        if ignored:
            raise ConfigError(f"trigger.{key} cannot be simulated", possible=possible)


def open_trigger(config: RigConfig, simulated: SimulatedDevices | None = None) -> Trigger:
    """Return the rig's trigger without its cameras; it connects at its first use."""
    if whose := TRIGGERS.whose(config.trigger.driver):
        return open_checked(whose, _trigger(config), config, simulated)
    return _trigger(config).open(config, simulated)


def _trigger(config: RigConfig) -> TriggerVariant:
    return cast("TriggerVariant", config.trigger.options)  # the configuration has validated it
