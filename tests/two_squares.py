"""A pulsing square and a steady one, recorded by a small rig: enough to tell what a recording is not."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from acquire.config import load_rig
from acquire.config.effect import EffectConfig
from acquire.config.scene import ArmOptics, ConstantDrive, OpticsConfig, SineDrive
from acquire.sim.leds import LedConfig, LedSceneConfig
from acquire.simulate import simulate


def record_two_squares(
    path: Path, lines: int, effects: Iterable[EffectConfig] = (), b: ArmOptics | None = None
) -> Path:
    """``b`` is how arm B really sees the scene."""
    slow = SineDrive(waveform="sine", frequency_hz=200.0, low=0.3)
    still = ConstantDrive(waveform="constant", level=0.9)
    leds = (
        LedConfig(name="slow", shape="square", row=0.25, column=0.3, size=0.3, drive=slow),
        LedConfig(name="still", shape="square", row=0.75, column=0.6, size=0.2, drive=still),
    )
    optics = OpticsConfig() if b is None else OpticsConfig(b=b)
    rig = load_rig("rig-demo", {"geometry.stages": 24, "geometry.substeps": 2})
    simulate(rig, LedSceneConfig(kind="leds", leds=leds, optics=optics, effects=tuple(effects)), path, lines)
    return path
