"""Plug-ins with mistakes that show only when they are used, or that their classes show."""

from typing import ClassVar, Literal

from acquire.sim.effects.base import Effect, Stage
from acquire.sim.scene import SceneModel
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
