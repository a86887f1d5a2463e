"""The streaming simulator and the batch operator, which share no code, give the same lines."""

from __future__ import annotations

import numpy as np
import pytest
from sim_helpers import CODE, LEDS

from acquire.forward import DualArm
from acquire.geometry import Geometry
from acquire.sim.lines import StreamingArm
from acquire.sim.scene import ArrayScene, Scene
from acquire.sim.scenes import build_scene

GEOMETRY = Geometry(8, 3, 50)
FIRST_LINE = 1234


def scenes() -> dict[str, Scene]:
    noise = np.random.default_rng(5).random((GEOMETRY.span, GEOMETRY.size, GEOMETRY.size), np.float32)
    return {"separable": build_scene(LEDS, GEOMETRY.size, 1e-5), "frames": ArrayScene(noise)}


@pytest.mark.parametrize("kind", ["separable", "frames"])
@pytest.mark.parametrize("arm", ["a", "b"])
def test_line_by_line(kind: str, arm: str) -> None:
    scene, first = scenes()[kind], GEOMETRY.substeps * FIRST_LINE
    stream = StreamingArm(scene, CODE, GEOMETRY.stages, GEOMETRY.substeps, arm)
    streamed = np.concatenate(
        [stream.lines(FIRST_LINE + offset, 10) for offset in range(0, GEOMETRY.lines, 10)]
    )
    operator = DualArm(GEOMETRY, CODE.bits(first, GEOMETRY.span))
    batch = operator.forward(scene.frames(first, GEOMETRY.span))["ab".index(arm)]
    assert batch.max() > 10
    np.testing.assert_allclose(streamed, batch, rtol=2e-6, atol=2e-5)
