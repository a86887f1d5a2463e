"""Small simulated instruments before a white field and a target, recorded under each of the codes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from acquire.config import load_rig
from acquire.sim.leds import LedSceneConfig
from acquire.sim.media import VideoSceneConfig
from acquire.simulate import bench_of, simulate

M, S = 24, 3
N = M * S
LIGHT = {"dark": 0, "flat": 1, "target": None}
NOISE = ({"kind": "shot_noise"}, {"kind": "read_noise", "sigma_e": 25.0})
COLUMNS = ({"kind": "prnu", "prnu": 0.02}, {"kind": "column_offsets", "sigma_dn": 2.0, "channels": 6})
ALL = (
    *NOISE,
    *COLUMNS,
    {"kind": "beam_splitter", "part_a": 0.46},
    {"kind": "misregistration", "rows": 1.5, "columns": -1.0, "turn_deg": 0.5},
)
RIG = {
    "geometry.stages": M,
    "geometry.substeps": S,
    "cameras.a.black_level_dn": 20.0,
    "cameras.b.black_level_dn": 20.0,
    "cameras.a.responsivity_dn": 8.0,
    "cameras.b.responsivity_dn": 8.0,
}
"""A white field of level 1 is 24·27·8 = 5184 DN above black under code 1."""
LEVEL = 0.5


def rig(light: str = "target", **changes: Any) -> Any:
    value = LIGHT[light]
    code = {} if value is None else {"code": {"kind": "constant", "value": value}}
    return load_rig("rig-demo", RIG | code | changes)


def white(level: float = LEVEL, effects: Any = (), **more: Any) -> LedSceneConfig:
    led = {"name": "all", "shape": "square", "row": 0.5, "column": 0.5, "size": 1.0}
    led["drive"] = {"waveform": "constant", "level": level}
    table = {"kind": "leds", "leds": [led], "system_gain_dn_per_e": 0.1, "effects": list(effects)}
    return LedSceneConfig.model_validate(table | more)


def dots(directory: Path, effects: Any = (), seed: int = 3, **more: Any) -> VideoSceneConfig:
    """Bright squares of 2 to 6 fine pixels, anywhere; dark at the rim, where an arm may not see them."""
    rng = np.random.default_rng(seed)
    picture = np.zeros((1, N, N), np.float32)
    for _ in range(90):
        side = int(rng.integers(2, 7))
        row, column = rng.integers(6, N - 6 - side, 2)
        picture[0, row : row + side, column : column + side] = 1
    path = directory / "dots.npy"
    np.save(path, picture)
    table = {"kind": "video", "path": path, "system_gain_dn_per_e": 0.1, "effects": list(effects)}
    return VideoSceneConfig.model_validate(table | more)


def record(path: Path, scene: Any, light: str, lines: int = 512, **changes: Any) -> Path:
    simulate(rig(light, **changes), scene, path, lines)
    return path


def columns_truth(scene: Any, light: str = "flat", lines: int = 64) -> Mapping[str, np.ndarray]:
    """Arm → DN of every column without temporal noise, before rounding: the mean of many lines."""
    noise = ("shot_noise", "read_noise", "dark_current", "misregistration")
    bench = bench_of(rig(light), scene).without(*noise)
    code = rig(light).code.build()
    return {arm: bench.camera(arm, code).read(64, lines).pixels.mean(axis=0) for arm in ("a", "b")}
