"""Effects: what a real instrument adds to Eq. (1), each a small pure stage that is there only when listed.

Stages run in the order of the physics, which is the order of this table, whatever the order of the list::

    light    code_errors ▸ pwm ▸ led_nonlinearity ▸ led_rise_fall ▸ trigger_jitter   what lights a sub-step
    image    misregistration ▸ lens_distortion ▸ vignetting ▸ psf ▸ stray_light (veil)   frames, or masks once
    signal   beam_splitter ▸ stray_light (ambient) ▸ cti                              expected lines, Eq. (1)
    charge   prnu ▸ shot_noise ▸ dark_current ▸ dsnu ▸ column_defects ▸ full_well ▸ read_noise     electrons
    readout  drift ▸ column_offsets ▸ adc_nonlinearity ▸ adc                          DN
    stream   dropped_lines ▸ duplicated_lines                                           lines as delivered

The module of an effect is imported when a scene lists it. Every effect draws from streams of its own
(`acquire.sim.effects.base.draws`), per arm and tile of lines: adding one leaves the draws of the others as
they were, and nothing depends on how the stream is split into calls.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from acquire.sim.effects.base import PLACES, Setting, Stage

if TYPE_CHECKING:
    from collections.abc import Iterable

_MODULES = {
    "code_errors": "light",
    "pwm": "light",
    "led_nonlinearity": "light",
    "led_rise_fall": "light",
    "trigger_jitter": "light",
    "misregistration": "image",
    "lens_distortion": "lens",
    "vignetting": "lens",
    "psf": "image",
    "stray_light": "image",
    "beam_splitter": "signal",
    "cti": "signal",
    "prnu": "charge",
    "shot_noise": "charge",
    "dark_current": "charge",
    "dsnu": "charge",
    "column_defects": "charge",
    "full_well": "charge",
    "read_noise": "charge",
    "drift": "readout",
    "column_offsets": "readout",
    "adc_nonlinearity": "readout",
    "adc": "readout",
    "dropped_lines": "stream",
    "duplicated_lines": "stream",
}
"""Effect → module of this package, in the order of the physics."""

ORDER = tuple(_MODULES)


def in_order(effects: Iterable[Any]) -> list[Any]:
    """Effect configurations in the order in which they act."""
    return sorted(effects, key=lambda effect: ORDER.index(effect.kind))


def build_stages(effects: Iterable[Any], setting: Setting) -> list[Stage]:
    """The stages of the listed effects on one arm, in the order in which they act. None listed: none."""
    stages: list[Stage] = []
    for effect in in_order(effects):
        module = importlib.import_module(f"{__name__}.{_MODULES[effect.kind]}")
        stages += getattr(module, effect.kind)(effect, setting)
    return sorted(stages, key=lambda stage: PLACES.index(stage.place))


__all__ = ["ORDER", "Setting", "Stage", "build_stages", "in_order"]
