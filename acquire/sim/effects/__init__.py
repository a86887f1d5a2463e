"""Effects: what a real instrument adds to Eq. (1), as small pure stages that exist only if listed.

Stages run in the order of the physics, whatever the order of the list. The built-in effects::

    light    code_errors ▸ pwm ▸ led_nonlinearity ▸ led_rise_fall ▸ delays ▸ trigger_jitter   sub-steps' light
    image    misregistration ▸ lens_distortion ▸ vignetting ▸ psf ▸ stray_light (veil) ▸ fibre_bands ▸
             fibre_gain                                                             frames, or masks once
    signal   beam_splitter ▸ stray_light (ambient) ▸ cti                              expected lines, Eq. (1)
    charge   prnu ▸ shot_noise ▸ dark_current ▸ dsnu ▸ column_defects ▸ full_well ▸ read_noise     electrons
    readout  drift ▸ column_offsets ▸ adc_nonlinearity ▸ adc                          DN
    stream   dropped_lines ▸ duplicated_lines                                           lines as delivered

An effect is one class, with its parameters and stages, that an entry point names (`acquire.plugins`). It is
imported when a scene lists it. Every effect draws from its own random streams, one per arm and tile of lines
(`acquire.sim.effects.base.draws`), so that adding an effect leaves the draws of the others unchanged and
results do not depend on how the stream is split into calls.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from acquire.guarded import files_read
from acquire.plugins import EFFECTS
from acquire.sim.effects.base import PLACES, Effect, Setting, Stage

if TYPE_CHECKING:
    from collections.abc import Iterable


def in_order(effects: Iterable[Any]) -> list[Any]:
    """Return effect configurations in the order in which they act."""
    return sorted(effects, key=_order)


def kinds() -> list[str]:
    """Return every effect that is installed and can be imported, in the order in which they act."""
    return sorted(EFFECTS.working(), key=lambda kind: _order(EFFECTS.load(kind), kind))


def _order(effect: Effect | type[Effect], kind: str = "") -> tuple[int, float, str]:
    return PLACES.index(effect.place), effect.rank, kind or effect.kind


def build_stages(effects: Iterable[Any], setting: Setting) -> list[Stage]:
    """Return the stages of the listed effects on one arm, in the order in which they act."""
    # Not imported by scenes without effects.
    from acquire.sim.effects.checked import checked_stages

    stages = []
    for effect in in_order(effects):
        with files_read(EFFECTS.whose(effect.kind) or f"effect {effect.kind!r}", "set up"):
            stages += checked_stages(effect.kind, effect.stages(setting))
    # An effect may act in several places. Sorting is stable: within a place the order of the effects remains.
    return sorted(stages, key=lambda stage: PLACES.index(stage.place))


__all__ = ["Effect", "Setting", "Stage", "build_stages", "in_order", "kinds"]
