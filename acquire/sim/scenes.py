"""Build a scene from its configuration; the sum of several scenes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, Self, cast

import numpy as np
from pydantic import Field, model_validator

from acquire.config.scene import OpticsConfig, SceneConfig
from acquire.errors import UsageError
from acquire.guarded import files_read
from acquire.plugins import SCENES
from acquire.sim.checked import checked_scene
from acquire.sim.scene import SceneModel, add
from acquire.text import shown

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.config.scene import SceneBase
    from acquire.sim.scene import Scene


def build_scene(config: SceneBase, size: int, substep_s: float, *, every_frame: bool = True) -> Scene:
    """Return the scene that a configuration describes, at ``size`` rows and columns, behind its shutters.

    Raises UsageError for files, pictures and functions that do not make a scene. A scene of another
    distribution is checked, too (`acquire.sim.checked`), and named in errors; ``every_frame`` of it by one of
    the two cameras, which see the same ones.
    """
    others = SCENES.whose(config.kind)
    whose = others or f"scene {config.kind!r}"
    with files_read(whose, "built"):
        scene = cast("SceneModel", config).build(size, substep_s)
        if not callable(getattr(scene, "frames", None)):
            raise UsageError(
                f"{whose} gave back {shown(scene)}", possible="an object with frames(first, count)"
            )
        frames = np.asarray(scene.frames(0, 1))
    if frames.shape != (1, size, size):
        raise UsageError(
            f"{whose} gave back shape {frames.shape} for one frame", possible=f"(1, {size}, {size})"
        )
    if frames.dtype.kind not in "fiub":
        raise UsageError(f"{whose} gave back {frames.dtype} pixels", possible="real numbers")
    if others:
        scene = checked_scene(scene, others, every_frame=every_frame)
    if not config.shutters:
        return scene
    from acquire.sim.shutters import ShutteredScene, build_shutter

    return ShutteredScene(scene, [build_shutter(shutter, size, substep_s) for shutter in config.shutters])


class SumSceneConfig(SceneModel):
    """The sum of the light of several scenes; optics and effects are those of the sum."""

    kind: Literal["sum"]
    parts: tuple[SceneConfig, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _parts_are_only_light(self) -> SumSceneConfig:
        for part in self.parts:
            if part.effects or part.optics != OpticsConfig():
                raise ValueError("effects and optics belong to the sum of scenes, not to one of its parts")
        return self

    def build(self, size: int, substep_s: float) -> Scene:
        return add([build_scene(part, size, substep_s) for part in self.parts])

    def anchored(self, directory: Path) -> Self:
        return self.model_copy(update={"parts": tuple(part.anchored(directory) for part in self.parts)})
