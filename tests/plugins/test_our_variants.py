"""Our own effects, codecs, solvers and denoisers under the suites that are public for everybody's."""

from __future__ import annotations

import numpy as np
import pytest

from acquire.config import load_scene
from acquire.forward import DualArm
from acquire.geometry import Geometry
from acquire.plugins import CODECS, EFFECTS
from acquire.recon import HaarShrink
from acquire.sim.effects.base import Effect
from acquire.sim.scene import SceneModel
from acquire.store.variant import CodecVariant
from acquire.testing import (
    CodecContract,
    DenoiserContract,
    EffectContract,
    SceneContract,
    SolverContract,
    assert_adjoint,
)

OF_EACH_PLACE = {
    "led_rise_fall": {"rise_s": 3e-6, "fall_s": 5e-6},
    "psf": {"sigma_pixels": 1.2},
    "misregistration": {"rows": 0.4},
    "cti": {"inefficiency": 1e-3},
    "shot_noise": {},
    "column_offsets": {"sigma_dn": 4.0},
    "dropped_lines": {"rate": 0.02},
    "duplicated_lines": {"rate": 0.02},
}

OF_EACH_KIND = ("scene-leds", "scene-usaf", "scene-digits", "scene-goldfish", "scene-practice")


class TestEffects(EffectContract):
    @pytest.fixture(params=OF_EACH_PLACE)
    def effect(self, request: pytest.FixtureRequest) -> Effect:
        return EFFECTS.load(request.param)(kind=request.param, **OF_EACH_PLACE[request.param])


class TestScenes(SceneContract):
    @pytest.fixture(params=OF_EACH_KIND)
    def scene(self, request: pytest.FixtureRequest) -> SceneModel:
        scene = load_scene(request.param)
        assert isinstance(scene, SceneModel)
        return scene


class TestCodecs(CodecContract):
    @pytest.fixture(params=["none", "lz4", "zstd"])
    def codec(self, request: pytest.FixtureRequest) -> CodecVariant:
        return CODECS.load(request.param)()


class TestAdmm(SolverContract):
    solver = "admm"
    iterations = 60
    most_error = 0.15


class TestTwist(SolverContract):
    solver = "twist"


class TestBandedTwist(SolverContract):
    solver = "twist-band"
    most_error = 0.3


class TestHaarShrink(DenoiserContract):
    def make(self) -> HaarShrink:
        return HaarShrink(2)


def test_the_forward_model_has_its_transpose_and_a_wrong_one_is_noticed() -> None:
    geometry = Geometry(5, 3, 12)
    code = np.random.default_rng(1).integers(0, 2, geometry.span).astype(np.uint8)
    operator = DualArm(geometry, code, 2, 3, np.float64)
    assert_adjoint(operator.forward, operator.adjoint, operator.video_shape)
    with pytest.raises(AssertionError, match="differ by"):
        assert_adjoint(operator.forward, lambda y: 1.001 * operator.adjoint(y), operator.video_shape)
