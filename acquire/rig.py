"""The composition root: a rig's configuration becomes devices, here and nowhere else.

Above this file nobody knows whether a device is simulated; below it no device knows of another, except
through the wire that the rig lays between simulated ones.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Self

from acquire.camera.aravis import AravisOpener
from acquire.camera.harvesters import HarvestersOpener
from acquire.camera.spec import spec_of
from acquire.codes import ConstantCode
from acquire.config import load_scene
from acquire.device_config import LightOutputConfig
from acquire.errors import ConfigError, TriggerError
from acquire.lines import ARMS
from acquire.sim import rtl
from acquire.sim.clock import Wire
from acquire.sim.compact import SideBySideOpener
from acquire.sim.devices import SimulatedCameraOpener, SimulatedOptics
from acquire.sim.gentl.arms import GentlArms, sensor_width
from acquire.sim.gige.arms import GigeArms
from acquire.sim.pattern import PatternCameraOpener
from acquire.sim.pins import PinPage, PinWire
from acquire.sim.pipeline import Bench, describe
from acquire.sim.replay import ReplayCameraOpener, describe_replay
from acquire.sim.scenes import build_scene
from acquire.sim.trigger_model import TriggerModel
from acquire.sim.trigger_registers import INPUTS as SIMULATED_INPUTS
from acquire.sim.twin_links import TwinTransport
from acquire.store import open_recording
from acquire.trigger.base import TriggerRun
from acquire.trigger.driver import TriggerDriver
from acquire.trigger.settings import GATEWARE, register_values
from acquire.trigger.transports.serial import BITS_PER_BYTE, SerialTransport
from acquire.trigger.transports.usb import UsbTransport

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from acquire.camera.base import CameraOpener
    from acquire.config import RigConfig
    from acquire.device_config import TriggerConfig
    from acquire.scene_config import SceneConfig
    from acquire.sim.scene import Scene
    from acquire.trigger.base import Trigger
    from acquire.trigger.transports import Transport

SIMULATED_CAMERAS = ("simulated", "pattern", "gentl-simulated", "gige-simulated")
"""Drivers of cameras that only a simulated trigger, or the compiled gateware, can pulse."""


class Rig:
    """The devices of one instrument; a context manager that lets go of them.

    Building one reads the scene and touches no device. Raises ConfigError for files and values, UsageError
    for a scene that cannot be shown to these cameras.
    """

    def __init__(self, config: RigConfig) -> None:
        check_rig(config)
        self.config = config
        self._scene = load_scene(config.simulation.scene)
        if config.simulation.replay is None and simulates_light(config):
            _check_scene(config, self._scene)
        self._wire = Wire()
        self._pins = PinPage() if config.trigger.driver == "rtl" else None
        self._gentl, self._gige = GentlArms(config), GigeArms(config)
        self._closed = False
        self.trigger: Trigger = open_trigger(config, self._wire, self._pins)

    def openers(self) -> dict[str, CameraOpener]:
        """Arm → what opens its camera, here or in a process being spawned."""
        if self.config.columns:
            return dict.fromkeys(ARMS, self._opener(ARMS[0]))
        return {arm: self._opener(arm) for arm in ARMS}

    def _opener(self, arm: str) -> CameraOpener:
        if self.config.simulation.replay is not None:
            return _replay_opener(self.config, self._wire, arm)
        opener: CameraOpener
        match self.config.cameras.arm(arm).driver:
            case "harvesters":
                opener = HarvestersOpener(spec_of(self.config, arm))
            case "aravis":
                opener = AravisOpener(spec_of(self.config, arm))
            case "gentl-simulated":
                opener = self._gentl.opener(arm, self._sensor)
            case "gige-simulated":
                opener = self._gige.opener(arm, self._sensor)
            case "simulated":
                opener = self._sensor(arm)
            case "pattern":
                opener = _pattern_opener(self.config, self._pulses(arm), arm)
        return opener

    def _sensor(self, arm: str) -> CameraOpener:
        """The model of the arm's camera, in the process that opens it."""
        parts = {arm: _camera_opener(self.config, self._scene, self._pulses(arm), arm) for arm in ARMS}
        columns = self.config.columns
        if not columns:
            return parts[arm]
        return SideBySideOpener(
            tuple(parts.values()), tuple(columns[arm][0] for arm in ARMS), sensor_width(self.config)
        )

    def describe(self) -> dict[str, Any]:
        """What a recording must say about where its lines come from (JSON)."""
        replay = self.config.simulation.replay
        if replay is not None:
            return describe_replay(replay)
        return describe(self._scene) if simulates_light(self.config) else {"simulated": False}

    @property
    def layout(self) -> str:
        """How the instrument is laid out: ``dual``, ``compact``, ``emulated``, ``interline``."""
        replay = self.config.simulation.replay
        if replay is not None:
            return str(open_recording(replay).attrs["layout"])
        cameras = self.config.cameras.layout
        if cameras != "dual" or not simulates_light(self.config):
            return cameras
        return self._scene.optics.layout

    def scene(self) -> Scene:
        """What the simulated cameras see, in camera A's rows and columns; sub-step 0 is the run's first."""
        size = self.config.geometry.stages * self.config.geometry.substeps
        return build_scene(
            self._scene, size, self.config.trigger.substep_ticks / self.config.trigger.clock_hz
        )

    def close(self) -> None:
        """Stop the trigger and take the wire away. Idempotent."""
        if not self._closed:
            self._closed = True
            self._gentl.close()
            self._gige.close()
            self.trigger.close()
            self._wire.close()
            if self._pins is not None:
                self._pins.close()

    def _pulses(self, arm: str) -> Wire | PinWire:
        """Where an arm's camera sees its trigger's pulses."""
        return self._wire if self._pins is None else PinWire(self._pins, arm)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def simulates_light(config: RigConfig) -> bool:
    """Whether what the cameras see comes out of the forward model."""
    return any(config.cameras.arm(arm).driver in SIMULATED_CAMERAS for arm in ARMS)


def _check_scene(config: RigConfig, scene: SceneConfig) -> None:
    """Raise UsageError here rather than in a camera's process."""
    code = ConstantCode(0)
    substep_s = config.trigger.substep_ticks / config.trigger.clock_hz
    bench = Bench(scene, config.geometry, {arm: config.cameras.arm(arm) for arm in ARMS}, substep_s)
    for arm in ARMS:
        bench.camera(arm, code)


def check_rig(config: RigConfig) -> None:
    """Raise ConfigError for what no trigger, or not the rig's simulated cameras, can honour."""
    trigger = config.trigger
    if config.simulation.replay is not None and trigger.driver != "simulated":
        raise ConfigError(
            f"trigger.driver = {trigger.driver!r} with simulation.replay", possible="'simulated'"
        )
    run = TriggerRun(
        "check",
        config.code.build(),
        config.geometry.substeps,
        trigger.substep_ticks,
        trigger.tag_every_lines,
    )
    possible = replace(GATEWARE, clock_hz=trigger.clock_hz)
    if trigger.driver == "simulated":
        possible = replace(possible, inputs=SIMULATED_INPUTS)
    try:
        register_values(run, trigger, possible, _link_bytes_per_s(trigger))
    except TriggerError as error:
        raise ConfigError(error.message, possible=error.possible, hint=error.hint) from error
    if simulates_light(config):
        _check_simulated_cameras(trigger)


def _link_bytes_per_s(trigger: TriggerConfig) -> float:
    match trigger.driver:
        case "serial":
            return trigger.baud / BITS_PER_BYTE
        case "rtl":
            return rtl.baud(trigger.clock_hz) / BITS_PER_BYTE
        case "simulated" | "usb":
            return float("inf")


def _check_simulated_cameras(trigger: TriggerConfig) -> None:
    """They see when lines begin and which code the light follows; a simulated trigger has no inputs."""
    light, plain = trigger.light, LightOutputConfig()
    same = (light.open_ticks, light.close_ticks) == (plain.open_ticks, plain.close_ticks)
    for ignored, key, possible in (
        (trigger.driver in ("serial", "usb"), f"driver = {trigger.driver!r}", "'simulated'"),
        (trigger.external_start != "off", f"external_start = {trigger.external_start!r}", "'off'"),
        (trigger.line_start != "per-line", f"line_start = {trigger.line_start!r}", "'per-line'"),
        (not trigger.a.enable, "a.enable = false", "true"),
        (not trigger.b.enable, "b.enable = false", "true"),
        (trigger.a.direction != "forward", f"a.direction = {trigger.a.direction!r}", "'forward'"),
        (trigger.b.direction != "forward", f"b.direction = {trigger.b.direction!r}", "'forward'"),
        (not same, "light.open_ticks, light.close_ticks", "absent: the whole sub-step"),
    ):
        if ignored:
            raise ConfigError(f"trigger.{key}: cannot be simulated", possible=possible)


def open_trigger(config: RigConfig, wire: Wire | None = None, pins: PinPage | None = None) -> Trigger:
    """The rig's trigger; connected when first used. A simulated one without a ``wire``, or the gateware
    without ``pins``, pulses for nobody."""
    return TriggerDriver(_trigger_way(config, wire or Wire(), pins), config.trigger)


def _trigger_way(config: RigConfig, wire: Wire, pins: PinPage | None) -> Callable[[], Transport]:
    """What opens the way to the trigger's device."""
    trigger = config.trigger
    match trigger.driver:
        case "simulated":
            model = TriggerModel(wire, trigger.clock_hz, config.simulation.speed)
            return partial(TwinTransport, model)
        case "rtl":
            return partial(rtl.RtlTransport, trigger.clock_hz, pins)
        case "serial":
            return partial(
                SerialTransport, trigger.url, trigger.baud, rts_cts=trigger.flow_control == "rts-cts"
            )
        case "usb":
            return partial(UsbTransport, serial=trigger.serial)


def _camera_opener(
    config: RigConfig, scene: SceneConfig, wire: Wire | PinWire, arm: str
) -> SimulatedCameraOpener:
    optics = SimulatedOptics(arm, config.geometry, scene)
    return SimulatedCameraOpener(
        wire, optics, config.cameras.arm(arm), config.stream.block_lines, config.line_rate_hz
    )


def _pattern_opener(config: RigConfig, wire: Wire | PinWire, arm: str) -> CameraOpener:
    return PatternCameraOpener(
        wire,
        arm,
        config.geometry,
        config.cameras.arm(arm),
        config.stream.block_lines,
        config.line_rate_hz,
    )


def _replay_opener(config: RigConfig, wire: Wire, arm: str) -> CameraOpener:
    simulation = config.simulation
    assert simulation.replay is not None
    return ReplayCameraOpener(
        wire,
        simulation.replay,
        arm,
        config.stream.block_lines,
        simulation.replay_loop,
        simulation.replay_hold_s,
    )
