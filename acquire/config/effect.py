"""The base of the models of effects, which are defined with their stages in `acquire.sim.effects`."""

from __future__ import annotations

from acquire.config.base import FrozenModel


class EffectConfig(FrozenModel):
    """An effect with its parameters, as a scene file lists it: ``kind`` is the name of its entry point."""

    kind: str
