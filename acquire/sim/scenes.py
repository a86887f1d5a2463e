"""From a scene's description to the scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.sim.leds import LedScene
from acquire.sim.scene import add

if TYPE_CHECKING:
    from acquire.config.scene import SceneConfig
    from acquire.sim.scene import Scene


def build_scene(config: SceneConfig, size: int, substep_s: float) -> Scene:
    """The scene that a configuration describes, at ``size`` rows and columns.

    What a scene needs beyond this module is imported when it is asked for. UsageError for files, pictures and
    functions that are no scene.
    """
    scene = _source(config, size, substep_s)
    if not config.shutters:
        return scene
    from acquire.sim.shutters import ShutteredScene, build_shutter

    return ShutteredScene(scene, [build_shutter(shutter, size, substep_s) for shutter in config.shutters])


def _source(config: SceneConfig, size: int, substep_s: float) -> Scene:  # noqa: PLR0911  # a table
    match config.kind:
        case "leds":
            return LedScene(config.leds, size, substep_s)
        case "usaf":
            from acquire.sim.targets import TargetScene, usaf_picture

            picture = usaf_picture(config.groups, size, config.field_mm, config.dark)
            return TargetScene(picture, config.drive, substep_s)
        case "digits":
            from acquire.sim.digits import DigitScene

            return DigitScene(config.displays, config.period_s, size, substep_s)
        case "sprites":
            from acquire.sim.sprites import SpriteScene

            return SpriteScene(config.sprites, config.background, size, substep_s)
        case "video":
            from acquire.sim.media import VideoScene

            return VideoScene(config, size, substep_s)
        case "function":
            from acquire.sim.functions import FunctionScene, load_function

            return FunctionScene(load_function(config.function), size, substep_s)
        case "sum":
            return add([build_scene(part, size, substep_s) for part in config.parts])
