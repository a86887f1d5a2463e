"""Light that flickers while something in it moves: the path and the brightness are found together."""

from __future__ import annotations

import numpy as np

from acquire.codes import mix_seed, prbs
from acquire.evaluate.metrics import psnr
from acquire.forward import DualArm
from acquire.geometry import Geometry
from acquire.recon import reconstruct
from acquire.recon.reuse import Choice
from acquire.sim.procedural import CameraNoise, Recorded, expose, light, record

ORDINARY = CameraNoise(1e4)
PERIODS = 7


def test_what_crosses_the_picture_in_flickering_light_is_followed_in_that_light() -> None:
    """At rest, the volume has 29.1 dB, since it adapts to a wrong brightness."""
    recorded = record("flicker", 42, stages=32, lines=200, camera=ORDINARY)
    truth = recorded.truth(3, 1)
    result = reconstruct(recorded.segment, 3, 1, "fast", error=False)
    assert result.parameters["brightness"]
    across, along = result.parameters["drift"]
    assert abs(across) < 0.02
    assert abs(along - 0.7) < 0.02
    assert psnr(result.video[result.trusted], truth) > 31.5

    again = reconstruct(recorded.segment, 3, 1, "fast", choice=Choice.of(result), check=False, error=False)
    assert len(again.parameters["candidates"]) < len(result.parameters["candidates"])
    assert again.parameters["brightness"]
    assert again.parameters["drift"]
    assert psnr(again.video[again.trusted], truth) > 30


def test_what_turns_in_changing_light_is_followed_in_that_light() -> None:
    """Without its brightness, the wheel has 19.1 dB."""
    geometry, seed = Geometry(32, 3, 200), 51
    code = prbs(31, mix_seed(seed, 31), 0, geometry.span)
    video = light("wheel", seed, geometry.size, geometry.span)
    swing = 0.65 + 0.35 * np.sin(np.linspace(0, 2 * np.pi * PERIODS, geometry.span))
    video = (video * swing[:, None, None]).astype(np.float32)
    lines = DualArm(geometry, code).forward(video).astype(np.float64)
    recorded = Recorded(expose(lines, geometry, code, ORDINARY, seed), video)
    result = reconstruct(recorded.segment, 3, 1, "fast", error=False)
    assert result.parameters["brightness"]
    assert result.parameters["rotation"]
    assert psnr(result.video[result.trusted], recorded.truth(3, 1)) > 28
