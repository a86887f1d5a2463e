"""A bench of 8 stages whose two cameras have the simplest of numbers, and two scenes for it."""

from __future__ import annotations

from acquire.codes import ConstantCode
from acquire.config import GeometryConfig
from acquire.config.device import CameraConfig
from acquire.sim.leds import LedSceneConfig
from acquire.sim.pipeline import Bench

M, S, DT = 8, 3, 1e-5
N = M * S
K = 0.05
LIT = ConstantCode(1)
RESPONSIVITY = 1.0


def flat(level=1.0, listed=(), **more):
    """One square LED over the whole field, at a constant level."""
    led = {
        "name": "all",
        "shape": "square",
        "row": 0.5,
        "column": 0.5,
        "size": 1.0,
        "drive": {"waveform": "constant", "level": level},
    }
    table = {"kind": "leds", "title": "", "leds": [led], "system_gain_dn_per_e": K, "effects": list(listed)}
    return LedSceneConfig.model_validate(table | more)


def blinking(listed=(), **more):
    scene = flat(listed=listed, **more).model_dump(mode="json")
    drive = {"waveform": "sine", "frequency_hz": 3700.0, "low": 0.1, "high": 0.9}
    scene["leds"][0] |= {"shape": "x", "size": 0.8, "drive": drive}
    return LedSceneConfig.model_validate(scene)


def bench(scene, **changes):
    camera = CameraConfig(pixel_format="Mono16", black_level_dn=300.0, responsivity_dn=RESPONSIVITY)
    camera = CameraConfig.model_validate(camera.model_dump() | changes)
    return Bench(scene, GeometryConfig(stages=M, substeps=S), {"a": camera, "b": camera}, DT)


def read(scene, count=2048, code=LIT, arm="a", first=512, **changes):
    return bench(scene, **changes).camera(arm, code).read(first, count)
