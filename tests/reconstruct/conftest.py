"""A small recording of a scene with a still and a flickering square, made by the simulator."""

from __future__ import annotations

from pathlib import Path

import pytest

from acquire.config import RigConfig, load_rig
from acquire.config.scene import ConstantDrive, SineDrive
from acquire.sim.leds import LedConfig, LedSceneConfig
from acquire.simulate import simulate

STAGES, SUBSTEPS, LINES = 12, 2, 400


@pytest.fixture(scope="session")
def rig() -> RigConfig:
    return load_rig("rig-demo", {"geometry.stages": STAGES, "geometry.substeps": SUBSTEPS})


@pytest.fixture(scope="session")
def recording_path(rig: RigConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    leds = (
        LedConfig(
            name="slow",
            shape="square",
            row=0.3,
            column=0.3,
            size=0.3,
            drive=SineDrive(waveform="sine", frequency_hz=300.0, low=0.1),
        ),
        LedConfig(
            name="still",
            shape="square",
            row=0.7,
            column=0.7,
            size=0.3,
            drive=ConstantDrive(waveform="constant", level=0.6),
        ),
    )
    path = tmp_path_factory.mktemp("recordings") / "small.zarr"
    simulate(rig, LedSceneConfig(kind="leds", title="small", leds=leds), path, LINES)
    return path
