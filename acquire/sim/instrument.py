"""The simulated devices of a rig: a trigger, the cameras that it pulses, and what these look at.

Made where a rig has a simulated device, and imported only there. Cameras see the trigger's pulses on a wire,
or on the pins of the compiled gateware.
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
    """See the module. Reads the scene, if a camera sees one, and touches no device.

    Raises ConfigError for files and values, UsageError for a scene that cannot be shown to these cameras.
    """

    def __init__(self, config: RigConfig) -> None:
        self.config = config
        self._scene: SceneConfig | None = None
        self._read: tuple[int, int] | None = None
        self._look_at_scene()
        self._wire = Wire()
        self._pins = PinPage() if config.trigger.driver == "rtl" else None
        self._gentl, self._gige = GentlArms(config), GigeArms(config)

    def transport(self) -> Callable[[], Transport]:
        """What opens the way to the trigger."""
        return _transport(self.config, self._wire, self._pins)

    def gentl(self, arm: str) -> CameraOpener:
        """The arm's camera behind our GenTL producer. Raises DeviceError without a C compiler."""
        return self._gentl.opener(arm, self.sensor)

    def gige(self, arm: str) -> CameraOpener:
        """The arm's camera behind our GigE Vision port."""
        return self._gige.opener(arm, self.sensor)

    def replay(self, arm: str) -> CameraOpener:
        """A camera that gives the lines of the recording to be replayed."""
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

    def _look_at_scene(self) -> None:
        """What is before the cameras now: a scene's file may change between runs, as what is on a bench does.

        Raises ConfigError and UsageError as the class does.
        """
        if not self.config.needs_scene:
            return
        place = find(self.config.scene_file(), kind="scene").stat()
        if self._read != (place.st_mtime_ns, place.st_ino):
            scene = load_scene(self.config.scene_file())
            _check_scene(self.config, scene)
            self._scene, self._read = scene, (place.st_mtime_ns, place.st_ino)

    def sensor(self, arm: str) -> CameraOpener:
        """The model of the arm's camera, in the process that opens it."""
        parts = {arm: self._part(arm) for arm in ARMS}
        columns = self.config.columns
        if not columns:
            return parts[arm]
        return SideBySideOpener(
            tuple(parts.values()), tuple(columns[arm][0] for arm in ARMS), sensor_width(self.config)
        )

    def _part(self, arm: str) -> SimulatedCameraOpener:
        config = self.config
        self._look_at_scene()
        assert self._scene is not None
        optics = SimulatedOptics(arm, config.geometry, self._scene, config.laid_out)
        camera = config.cameras.arm(arm)
        return SimulatedCameraOpener(
            self.pulses(arm), optics, camera, config.stream.block_lines, config.line_rate_hz
        )

    def pattern(self, arm: str) -> CameraOpener:
        """A camera with stored lines."""
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
        """Where an arm's camera sees its trigger's pulses."""
        return self._wire if self._pins is None else PinWire(self._pins, arm)

    def describe(self) -> dict[str, Any]:
        """What a recording must say about where its lines come from (JSON)."""
        if self.config.simulation.replay is not None:
            return describe_replay(self.config.simulation.replay)
        if self._scene is not None:
            return describe(self._scene)
        return {"simulated": self.config.simulates_cameras}

    @property
    def layout(self) -> str:
        """How the instrument is laid out, as the cameras or the scene's optics have it."""
        if self.config.simulation.replay is not None:
            return str(open_recording(self.config.simulation.replay).attrs["layout"])
        if self.config.cameras.layout != "dual" or self._scene is None:
            return self.config.cameras.layout
        return self._scene.optics.layout

    def scene(self) -> Scene:
        """What the cameras see, in camera A's rows and columns; sub-step 0 is the run's first.

        Behind a fibre a square, in the middle of which the fibre's field lies (`acquire.fibre.Fibre.field`).
        """
        trigger, geometry = self.config.trigger, self.config.geometry
        scene = self._scene or load_scene(self.config.scene_file())
        fibre = self.config.laid_out
        size = geometry.stages * geometry.substeps if fibre is None else fibre.side
        return build_scene(scene, size, trigger.substep_ticks / trigger.clock_hz)

    def close_cameras(self) -> None:
        """Take the cameras away that have processes of their own."""
        self._gentl.close()
        self._gige.close()

    def close_wires(self) -> None:
        """Take away what carries the trigger's pulses, once the trigger is closed."""
        self._wire.close()
        if self._pins is not None:
            self._pins.close()


def lonely_transport(config: RigConfig) -> Callable[[], Transport]:
    """What opens the way to a simulated trigger whose pulses nobody sees."""
    return _transport(config, Wire(), None)


def _transport(config: RigConfig, wire: Wire, pins: PinPage | None) -> Callable[[], Transport]:
    """To the trigger's model, or to the compiled gateware."""
    clock_hz = config.trigger.clock_hz
    if config.trigger.driver == "rtl":
        return partial(rtl.RtlTransport, clock_hz, pins)
    return partial(TwinTransport, TriggerModel(wire, clock_hz, config.simulation.speed))


def _check_scene(config: RigConfig, scene: SceneConfig) -> None:
    """Raise UsageError here rather than in a camera's process."""
    if config.trigger.driver == "rtl" and any(effect.kind == "delays" for effect in scene.effects):
        raise UsageError(
            "effect 'delays' cannot act on the pins of the gateware", possible="trigger.driver = 'simulated'"
        )
    code = ConstantCode(0)
    substep_s = config.trigger.substep_ticks / config.trigger.clock_hz
    cameras = {arm: config.cameras.arm(arm) for arm in ARMS}
    bench = Bench(scene, config.geometry, cameras, substep_s, fibre=config.laid_out)
    for arm in ARMS:
        bench.camera(arm, code)
