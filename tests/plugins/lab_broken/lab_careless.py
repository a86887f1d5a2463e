"""Plug-ins with mistakes that show only when they are used, or that their classes show."""

from pathlib import Path
from typing import ClassVar, Literal

from acquire.sim.effects.base import Effect, Stage
from acquire.sim.scene import MaskScene, SceneModel
from acquire.store.variant import CodecVariant


class Nowhere(Effect):
    """An effect without a place."""

    kind: Literal["nowhere"]

    def stages(self, setting):
        return []


class Short(Effect):
    """An effect that loses a line."""

    kind: Literal["short"]
    place: ClassVar = "readout"

    def stages(self, setting):
        return [Stage("short", "readout", lambda dn, first: dn[1:])]


class Hollow(Effect):
    """An effect whose numbers are none."""

    kind: Literal["hollow"]
    place: ClassVar = "readout"

    def stages(self, setting):
        return [Stage("hollow", "readout", lambda dn, first: dn * float("nan"))]


class Raises(Effect):
    """An effect with a defect."""

    kind: Literal["raises"]
    place: ClassVar = "readout"

    def stages(self, setting):
        return [Stage("raises", "readout", lambda dn, first: 1 // 0)]


class Oblong(SceneModel):
    """A scene that is not a square."""

    kind: Literal["oblong"]

    def build(self, size, substep_s):
        return OblongScene(size)


class OblongScene:
    def __init__(self, size):
        self.size = size

    def frames(self, first, count):
        import numpy as np

        return np.ones((count, self.size, self.size - 1), np.float32)


class Gloom(SceneModel):
    """A scene whose light is wrong from a sub-step on, at one pixel; or whose file is not there."""

    kind: Literal["gloom"]
    light: str = "nan"  # the model has finite numbers only
    masks: bool = False
    file: str = ""

    def build(self, size, substep_s):
        if self.file:
            Path(self.file).read_bytes()
        return (GloomMasks if self.masks else GloomFrames)(float(self.light), size)


class GloomFrames:
    def __init__(self, light, size):
        self.size, self._light = size, light

    def frames(self, first, count):
        import numpy as np

        frames = np.ones((count, self.size, self.size), np.float32)
        frames[np.arange(first, first + count) >= 700, 3, 5] = self._light
        return frames


class GloomMasks(MaskScene):
    def __init__(self, light, size):
        import numpy as np

        self.masks = np.zeros((2, size, size), np.float32)
        self.masks[0, 1, 1] = self.masks[1, 3, 5] = 1.0
        self._light = light

    def intensity(self, first, count, substep_s=None):
        import numpy as np

        light = np.ones((2, count))
        light[1, np.arange(first, first + count) >= 700] = self._light
        return light


class Lost(Effect):
    """An effect whose file is not there."""

    kind: Literal["lost"]
    place: ClassVar = "readout"

    def stages(self, setting):
        return [Path("/nowhere/gain.npy").read_bytes()]


class Unnamed(CodecVariant):
    """A codec that no reader could ask for."""

    def encode(self, data):
        return data

    def decode(self, data, size):
        return data


class NoProx:
    """A denoiser without the method."""


class NeedsArgument:
    """A denoiser that cannot be made by its name."""

    def __init__(self, strength):
        self.strength = strength

    def prox(self, frames, weight):
        return frames
