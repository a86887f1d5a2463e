"""The suites of acquire, for what the laboratory adds: pytest check_lab_extras.py."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from lab_extras import Differences, Flicker, LocalWiener, Stars

from acquire.codes import ConstantCode
from acquire.config import load_rig
from acquire.rig import Rig
from acquire.sim.instrument import SimulatedDevices
from acquire.testing import (
    CameraContract,
    CameraStand,
    CodecContract,
    DenoiserContract,
    EffectContract,
    SceneContract,
    SolverContract,
    TriggerContract,
)

STAGES = 16
RAMPS = {
    "geometry.stages": STAGES,
    "stream.block_lines": 32,
    "cameras.a.driver": "ramp",
    "cameras.b.driver": "ramp",
}


class TestFlicker(EffectContract):
    @pytest.fixture
    def effect(self):
        return Flicker(kind="flicker", depth=0.3)


class TestStars(SceneContract):
    @pytest.fixture
    def scene(self):
        return Stars(kind="stars", count=5)


class TestDifferences(CodecContract):
    @pytest.fixture
    def codec(self):
        return Differences(level=2)


class TestLeastSquares(SolverContract):
    solver = "least-squares"
    most_error = 0.65


class TestLocalWiener(DenoiserContract):
    def make(self):
        return LocalWiener()


class TestSlowLink(TriggerContract):
    @pytest.fixture
    def trigger(self):
        with Rig(load_rig("rig-demo", RAMPS | {"trigger.driver": "slow-link"})) as rig:
            yield rig.trigger


class TestRamp(CameraContract):
    @pytest.fixture
    def stand(self):
        rig = load_rig("rig-demo", RAMPS | {"cameras.a.options": {"step": 3}})
        bench = SimulatedDevices(rig)
        wire, opener = bench.pulses("a"), rig.cameras.a.options.opener(rig, "a", bench)

        def lines(first, count):
            line = np.arange(first, first + count)[:, None] - STAGES - 1
            return (3 * line + np.arange(STAGES)) % rig.cameras.a.white_dn

        start = lambda: wire.start(Fraction(30_000), Fraction(1), ConstantCode(1).to_attrs())  # noqa: E731
        yield CameraStand(opener, start, wire.stop, "SIM-A", lines, sent=opener.ramp)
        bench.close_cameras()
        bench.close_wires()
