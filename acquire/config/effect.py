"""What the models of all effects have in common. Each stands with its stages, in `acquire.sim.effects`."""

from __future__ import annotations

from acquire.config.base import FrozenModel


class EffectConfig(FrozenModel):
    """An effect with its parameters, as a scene file lists it: ``kind`` is the name of its entry point."""

    kind: str
