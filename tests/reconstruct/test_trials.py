"""Trials are compared by their prediction: the error of a video that nobody sees is not estimated."""

from __future__ import annotations

import pytest

from acquire.calibrate.calibration import Calibration
from acquire.calibrate.exposure import instrument_of
from acquire.config.scene import ConstantDrive
from acquire.recon.auto import tempo
from acquire.reconstruct.explain import explain
from acquire.sim.leds import LedConfig, LedSceneConfig
from acquire.simulate import simulate
from acquire.store import open_recording


@pytest.fixture
def recording(rig, tmp_path, monkeypatch):
    def estimate(*_, **__):
        raise AssertionError("the error of a trial was estimated")

    monkeypatch.setattr("acquire.recon.api.estimate_error", estimate)
    drive = ConstantDrive(waveform="constant", level=0.7)
    led = LedConfig(name="l", shape="square", row=0.5, column=0.5, size=0.6, drive=drive)
    simulate(rig, LedSceneConfig(kind="leds", title="one", leds=(led,)), tmp_path / "r.zarr", 60)
    return open_recording(tmp_path / "r.zarr")


def test_the_tempo_of_a_range_is_found_without(recording):
    assert tempo(recording.cut(0, 60)).tried


def test_the_benefit_of_a_calibration_is_found_without(recording):
    known = Calibration(instrument_of(recording))
    assert len(explain(recording.cut(0, 60), known, 3, 4)) == 2
