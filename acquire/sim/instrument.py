"""The simulated devices of a rig: a trigger, the cameras that it pulses, and the scene before them.

This module is imported only if a rig has a simulated device. Cameras see the trigger's pulses on a wire, or
on the pins of the compiled gateware.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from acquire.codes import ConstantCode
from acquire.config import find, load_scene
from acquire.errors import UsageError
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
from acquire.sim.twin_links import TwinTransport
from acquire.store import open_recording

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.camera.base import CameraOpener
    from acquire.config import RigConfig
    from acquire.config.scene import SceneConfig
    from acquire.sim.scene import Scene
    from acquire.trigger.transports import Transport


class SimulatedDevices:
    """The simulated devices of one rig. Reads the scene, if a camera sees one, and opens no device.

    Raises ConfigError for files and values, UsageError for a scene that cannot be shown to these cameras.
    """

    def __init__(self, config: RigConfig) -> None:
        self.config = config
        self._scene: SceneConfig | None = None
        self._scene_version: tuple[int, int] | None = None
        self._shown = set(ARMS)
        """Arms whose cameras have been given the scene as it was read last."""
        self._update_scene()
        self._wire = Wire()
        self._pins = PinPage() if config.trigger.driver == "rtl" else None
        self._gentl, self._gige = GentlArms(config), GigeArms(config)

    def transport(self) -> Callable[[], Transport]:
        """Return the function that opens the connection to the trigger."""
        return _transport(self.config, self._wire, self._pins)

    def gentl(self, arm: str) -> CameraOpener:
        """The arm's camera behind the simulated GenTL producer. Raises DeviceError without a C compiler."""
        return self._gentl.opener(arm, self.sensor)

    def gige(self, arm: str) -> CameraOpener:
        """The arm's camera behind the simulated GigE Vision port."""
        return self._gige.opener(arm, self.sensor)

    def replay(self, arm: str) -> CameraOpener:
        """A camera that repeats the lines of the recording named by ``simulation.replay``."""
        simulation = self.config.simulation
        assert simulation.replay is not None
        return ReplayCameraOpener(
            wire=self._wire,
            path=simulation.replay,
            arm=arm,
            block_lines=self.config.stream.block_lines,
            loop=simulation.replay_loop,
            gate=simulation.replay_gate,
        )

    def _update_scene(self) -> None:
        """Read the scene's file again if it has changed: it may change between runs, as a real bench does.

        Raises ConfigError and UsageError as the class does.
        """
        config = self.config
        if not config.needs_scene:
            return
        file = find(config.scene_file(), kind="scene").stat()
        # The inode as well: a file that replaces another one may have the same time.
        version = (file.st_mtime_ns, file.st_ino)
        if self._scene_version != version:
            scene = load_scene(config.scene_file())
            if config.trigger.driver == "rtl" and any(effect.kind == "delays" for effect in scene.effects):
                raise UsageError(
                    "effect 'delays' cannot act on the pins of the gateware",
                    possible="trigger.driver = 'simulated'",
                )
            # Each camera is built once here, so that UsageError is not raised in a camera's process.
            substep_s = config.trigger.substep_ticks / config.trigger.clock_hz
            cameras = {arm: config.cameras.arm(arm) for arm in ARMS}
            bench = Bench(
                scene,
                config.geometry,
                cameras,
                substep_s,
                settled_s=config.trigger.settled_s,
                lit_part=config.trigger.lit_part,
                fibre=config.laid_out,
            )
            for arm in ARMS:
                # under any code: scene, optics and effects are what may be refused
                bench.camera(arm, ConstantCode(0))
            self._scene, self._scene_version = scene, version

    def sensor(self, arm: str) -> CameraOpener:
        """The model of the arm's camera, to be opened in any process."""
        config = self.config
        # Once per pair of cameras: a file that is saved between the two must not show them different scenes.
        if arm in self._shown:
            self._update_scene()
            self._shown.clear()
        self._shown.add(arm)
        parts = {}
        for name in ARMS:
            assert self._scene is not None
            parts[name] = SimulatedCameraOpener(
                wire=self.pulses(name),
                optics=SimulatedOptics(name, config.geometry, self._scene, config.laid_out),
                config=config.cameras.arm(name),
                block_lines=config.stream.block_lines,
                line_rate_hz=config.line_rate_hz,
            )
        columns = config.columns
        if not columns:
            return parts[arm]
        # Both arms' parts, whichever arm was asked for: they are one sensor.
        return SideBySideOpener(
            tuple(parts.values()), tuple(columns[name][0] for name in ARMS), sensor_width(config)
        )

    def pattern(self, arm: str) -> CameraOpener:
        """A camera that repeats stored lines."""
        config = self.config
        return PatternCameraOpener(
            wire=self.pulses(arm),
            arm=arm,
            geometry=config.geometry,
            config=config.cameras.arm(arm),
            block_lines=config.stream.block_lines,
            line_rate_hz=config.line_rate_hz,
            pixels=config.pixels,
        )

    def pulses(self, arm: str) -> Wire | PinWire:
        """The wire, or the pins, on which an arm's camera sees its trigger's pulses."""
        return self._wire if self._pins is None else PinWire(self._pins, arm)

    def describe(self) -> dict[str, Any]:
        """Return the origin of the lines, as a recording must state it (JSON)."""
        if self.config.simulation.replay is not None:
            return describe_replay(self.config.simulation.replay)
        if self._scene is not None:
            return describe(self._scene)
        return {"simulated": self.config.simulates_cameras}

    @property
    def layout(self) -> str:
        """The layout of the instrument, from the replayed recording, the cameras or the scene's optics."""
        if self.config.simulation.replay is not None:
            return str(open_recording(self.config.simulation.replay).attrs["layout"])
        if self.config.cameras.layout != "dual" or self._scene is None:
            return self.config.cameras.layout
        return self._scene.optics.layout

    def scene(self) -> Scene:
        """The scene that the cameras see, in camera A's rows and columns; sub-step 0 is the run's first.

        Behind a fibre it is the square around the fibre's field (`acquire.fibre.Fibre.field`).
        """
        trigger, geometry = self.config.trigger, self.config.geometry
        scene = self._scene or load_scene(self.config.scene_file())
        fibre = self.config.laid_out
        size = geometry.stages * geometry.substeps if fibre is None else fibre.side
        return build_scene(scene, size, trigger.substep_ticks / trigger.clock_hz)

    def close_cameras(self) -> None:
        """Remove the cameras that have their own processes."""
        self._gentl.close()
        self._gige.close()

    def close_wires(self) -> None:
        """Release the wire and the pins, once the trigger is closed."""
        self._wire.close()
        if self._pins is not None:
            self._pins.close()


def unconnected_transport(config: RigConfig) -> Callable[[], Transport]:
    """Return the function that opens a simulated trigger whose pulses reach no camera."""
    return _transport(config, Wire(), None)


def _transport(config: RigConfig, wire: Wire, pins: PinPage | None) -> Callable[[], Transport]:
    """Return the function that opens the trigger's model, or the compiled gateware."""
    clock_hz = config.trigger.clock_hz
    if config.trigger.driver == "rtl":
        return partial(rtl.RtlTransport, clock_hz, pins)
    return partial(TwinTransport, TriggerModel(wire, clock_hz, config.simulation.speed))
