"""The composition root: a rig's configuration becomes devices, here and nowhere else.

Above this file nobody knows whether a device is simulated; below it no device knows of another, except
through the wire that the rig lays between simulated ones.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

from acquire.camera.aravis import AravisOpener
from acquire.camera.harvesters import HarvestersOpener
from acquire.camera.spec import spec_of
from acquire.config import load_scene
from acquire.lines import ARMS
from acquire.sim.clock import Wire
from acquire.sim.compact import SideBySideOpener
from acquire.sim.devices import SimulatedCameraOpener, SimulatedOptics, SimulatedTrigger
from acquire.sim.gentl.arms import GentlArms, sensor_width
from acquire.sim.gige.arms import GigeArms
from acquire.sim.scenes import build_scene

if TYPE_CHECKING:
    from types import TracebackType

    from acquire.camera.base import CameraOpener
    from acquire.config import RigConfig, SceneConfig
    from acquire.sim.scenes import Scene
    from acquire.trigger.base import Trigger


class Rig:
    """The devices of one instrument; a context manager that lets go of them.

    Building one reads the scene's file and touches no device: ConfigError is all it raises.
    """

    def __init__(self, config: RigConfig) -> None:
        self.config = config
        self._scene = load_scene(config.simulation.scene)
        self._wire = Wire()
        self._gentl, self._gige = GentlArms(config), GigeArms(config)
        self._closed = False
        self.trigger: Trigger = open_trigger(config, self._wire)

    def openers(self) -> dict[str, CameraOpener]:
        """Arm → what opens its camera, here or in a process being spawned."""
        if self.config.columns:
            return dict.fromkeys(ARMS, self._opener(ARMS[0]))
        return {arm: self._opener(arm) for arm in ARMS}

    def _opener(self, arm: str) -> CameraOpener:
        match self.config.cameras.arm(arm).driver:
            case "harvesters":
                return HarvestersOpener(spec_of(self.config, arm))
            case "aravis":
                return AravisOpener(spec_of(self.config, arm))
            case "gentl-simulated":
                return self._gentl.opener(arm, self._sensor)
            case "gige-simulated":
                return self._gige.opener(arm, self._sensor)
            case "simulated":
                return self._sensor(arm)

    def _sensor(self, arm: str) -> CameraOpener:
        """The model of the arm's camera, in the process that opens it."""
        parts = {arm: _camera_opener(self.config, self._scene, self._wire, arm) for arm in ARMS}
        columns = self.config.columns
        if not columns:
            return parts[arm]
        return SideBySideOpener(
            tuple(parts.values()), tuple(columns[arm][0] for arm in ARMS), sensor_width(self.config)
        )

    def describe(self) -> dict[str, Any]:
        """What a recording must say about where its lines come from (JSON)."""
        return {"simulated": True, "scene": self._scene.model_dump(mode="json"), "effects": []}

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

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_trigger(config: RigConfig, wire: Wire | None = None) -> Trigger:
    """The rig's trigger; without a ``wire`` it pulses for nobody."""
    return SimulatedTrigger(
        wire or Wire(), config.trigger.clock_hz, config.geometry.substeps, config.simulation.speed
    )


def _camera_opener(config: RigConfig, scene: SceneConfig, wire: Wire, arm: str) -> SimulatedCameraOpener:
    optics = SimulatedOptics(arm, config.geometry, scene)
    return SimulatedCameraOpener(
        wire, optics, config.cameras.arm(arm), config.stream.block_lines, config.line_rate_hz
    )
