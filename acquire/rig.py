"""The composition root: a rig's configuration becomes devices, here and nowhere else.

Above this file nobody knows whether a device is simulated; below it no device knows of another, except
through the wire that the rig lays between simulated ones.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

from acquire.codes import ConstantCode
from acquire.config import load_scene
from acquire.lines import ARMS
from acquire.sim.clock import Wire
from acquire.sim.devices import SimulatedCameraOpener, SimulatedOptics, SimulatedTrigger
from acquire.sim.pipeline import Bench, describe
from acquire.sim.replay import ReplayCameraOpener, describe_replay
from acquire.sim.scenes import build_scene
from acquire.store import open_recording

if TYPE_CHECKING:
    from types import TracebackType

    from acquire.camera.base import CameraOpener
    from acquire.config import RigConfig
    from acquire.scene_config import SceneConfig
    from acquire.sim.scenes import Scene
    from acquire.trigger.base import Trigger


class Rig:
    """The devices of one instrument; a context manager that lets go of them.

    Building one reads the scene and touches no device. Raises ConfigError for files and values, UsageError
    for a scene that cannot be shown to these cameras.
    """

    def __init__(self, config: RigConfig) -> None:
        self.config = config
        self._scene = load_scene(config.simulation.scene)
        if config.simulation.replay is None:
            _check_scene(config, self._scene)
        self._wire = Wire()
        self._closed = False
        self.trigger: Trigger = open_trigger(config, self._wire)

    def openers(self) -> dict[str, CameraOpener]:
        """Arm → what opens its camera, here or in a process being spawned."""
        if self.config.simulation.replay is not None:
            return {arm: _replay_opener(self.config, self._wire, arm) for arm in ARMS}
        return {arm: _camera_opener(self.config, self._scene, self._wire, arm) for arm in ARMS}

    def describe(self) -> dict[str, Any]:
        """What a recording must say about where its lines come from (JSON)."""
        replay = self.config.simulation.replay
        return describe(self._scene) if replay is None else describe_replay(replay)

    @property
    def layout(self) -> str:
        """How the instrument is laid out: ``dual``, ``compact``, ``emulated``, ``interline``."""
        replay = self.config.simulation.replay
        return self._scene.optics.layout if replay is None else str(open_recording(replay).attrs["layout"])

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
            self.trigger.close()
            self._wire.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _check_scene(config: RigConfig, scene: SceneConfig) -> None:
    """Raise UsageError here rather than in a camera's process."""
    code = ConstantCode(0)
    substep_s = config.trigger.substep_ticks / config.trigger.clock_hz
    bench = Bench(scene, config.geometry, {arm: config.cameras.arm(arm) for arm in ARMS}, substep_s)
    for arm in ARMS:
        bench.camera(arm, code)


def open_trigger(config: RigConfig, wire: Wire | None = None) -> Trigger:
    """The rig's trigger; without a ``wire`` it pulses for nobody."""
    return SimulatedTrigger(
        wire or Wire(), config.trigger.clock_hz, config.geometry.substeps, config.simulation.speed
    )


def _camera_opener(config: RigConfig, scene: SceneConfig, wire: Wire, arm: str) -> CameraOpener:
    optics = SimulatedOptics(arm, config.geometry, scene)
    return SimulatedCameraOpener(
        wire, optics, config.cameras.arm(arm), config.stream.block_lines, config.line_rate_hz
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
