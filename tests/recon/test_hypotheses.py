"""Descriptions of lines compared with the lines: the right one is found, or nothing is claimed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from acquire.alignment import Alignment
from acquire.codes import PrbsCode, mix_seed, prbs
from acquire.config import load_scene
from acquire.forward import DualArm
from acquire.geometry import Geometry
from acquire.lines import ARMS, Segment
from acquire.recon.hypotheses import AS_BUILT, TURNS, Hypothesis, LineModel, Turn, compare
from acquire.recon.search import Inquiry, Standing, inquire
from acquire.sim.lines import StreamingArm
from acquire.sim.scenes import build_scene

GEOMETRY = Geometry(24, 3, 120)


def lit_by(seed: int, start: int = 0, geometry: Geometry = GEOMETRY) -> np.ndarray:
    return prbs(31, mix_seed(seed, 31), start, geometry.span)


def recorded(scene_seed: int = 1, *, texture: float = 3.0, alignment: Alignment | None = None) -> Segment:
    """A bright disc that passes before a textured still, with a camera's noise."""
    rng, n = np.random.default_rng(scene_seed), GEOMETRY.size
    ground = gaussian_filter(rng.standard_normal((n, n)), texture, mode="wrap")
    ground = 0.5 + 0.2 * ground / ground.std()
    y, x = np.mgrid[:n, :n] / n
    video = np.stack(
        [
            np.where(np.hypot(y - 0.4, x - 0.1 - 0.8 * t / GEOMETRY.span) < 0.12, 1.0, np.clip(ground, 0, 1))
            for t in range(GEOMETRY.span)
        ]
    ).astype(np.float32)
    code = lit_by(scene_seed)
    exact = DualArm(GEOMETRY, code, alignment=alignment).forward(video)
    lines = exact + rng.standard_normal(exact.shape) * 0.01 * exact.max()
    return Segment(
        lines=lines,
        mask=np.ones(GEOMETRY.lines_shape, bool),
        code=code,
        geometry=GEOMETRY,
        time_ns=np.arange(GEOMETRY.lines, dtype=np.int64) * 30_000,
        alignment=alignment,
    )


def found(segment: Segment) -> Inquiry:
    return inquire(LineModel(segment))


def test_a_right_description_is_confirmed() -> None:
    inquiry = found(recorded())
    assert inquiry.standing is Standing.RIGHT
    assert inquiry.best is inquiry.described


def test_lamps_that_blink_fast_for_a_large_sensor_follow_their_code() -> None:
    """Fig. 9 on 96 stages: the fastest lamp is near the highest of the cosines in its long segment."""
    geometry, code = Geometry(96, 3, 392), PrbsCode.from_seed(64, 1)
    scene = build_scene(load_scene("scene-leds"), geometry.size, 1e-5)
    arms = [StreamingArm(scene, code, geometry.stages, geometry.substeps, arm) for arm in ARMS]
    exact = np.stack([arm.lines(0, geometry.lines) for arm in arms])
    noise = 0.006 * exact.max() * np.random.default_rng(1).standard_normal(exact.shape)
    segment = Segment(
        lines=exact + noise,
        mask=np.ones(geometry.lines_shape, bool),
        code=code.bits(0, geometry.span),
        geometry=geometry,
        time_ns=np.arange(geometry.lines, dtype=np.int64) * 30_000,
    )
    assert found(segment).standing is Standing.RIGHT


def test_a_late_code_is_named_to_the_substep() -> None:
    segment = recorded()
    for late in (1, 3):
        inquiry = found(replace(segment, code=lit_by(1, late)))
        assert inquiry.standing is Standing.NAMED
        assert inquiry.best.hypothesis == Hypothesis(late=(late, late))


def test_a_known_displacement_of_arm_b_is_not_taken_for_a_delay() -> None:
    segment = recorded(alignment=Alignment(rows=4.4, columns=-3.7, turn_deg=0.6, magnification=1.003))
    assert found(segment).standing is Standing.RIGHT
    assert found(replace(segment, alignment=None)).standing is not Standing.RIGHT
    late = found(replace(segment, code=lit_by(1, 3)))
    assert late.standing is Standing.NAMED
    assert late.best.hypothesis == Hypothesis(late=(3, 3))


def test_an_inverted_code_is_named() -> None:
    segment = recorded()
    inquiry = found(replace(segment, code=1 - segment.code))
    assert inquiry.standing is Standing.NAMED
    assert inquiry.best.hypothesis == Hypothesis(inverted=True)


def test_another_runs_code_explains_nothing() -> None:
    assert found(replace(recorded(), code=lit_by(77))).standing is Standing.UNEXPLAINED


def test_turned_arms_are_named() -> None:
    segment = recorded()
    a, b = segment.lines
    turned = {
        Turn(pixels=True): np.stack([a, b[:, ::-1]]),
        Turn(rows=True): np.stack([a[:, ::-1], b]),
        Turn(rows=True, pixels=True): np.stack([b, a]),
    }
    for turn, lines in turned.items():
        inquiry = found(replace(segment, lines=lines))
        assert inquiry.standing is Standing.NAMED
        assert inquiry.best.hypothesis == Hypothesis(turn=turn)


def test_another_number_of_substeps_is_named() -> None:
    four = Geometry(24, 4, 120)
    inquiry = found(replace(recorded(), geometry=four, code=lit_by(1, geometry=four)))
    assert inquiry.standing is Standing.NAMED
    assert inquiry.best.hypothesis == Hypothesis(substeps=3)


def test_lost_samples_do_not_matter() -> None:
    segment = recorded()
    segment.mask[:, 40:43] = False
    segment.mask[0, :, 7] = False
    segment.lines[~segment.mask] = 0
    assert found(segment).standing is Standing.RIGHT


def test_no_orientation_is_claimed_for_a_uniform_scene() -> None:
    """It equals its mirror image."""
    segment = recorded()
    flat = DualArm(GEOMETRY, segment.code).forward(
        np.ones((GEOMETRY.span, GEOMETRY.size, GEOMETRY.size), np.float32)
    )
    flat += np.random.default_rng(3).standard_normal(flat.shape).astype(np.float32)
    assert found(replace(segment, lines=flat)).standing is not Standing.NAMED


@pytest.mark.parametrize("turn", TURNS)
def test_turns_undo_themselves(turn: Turn) -> None:
    scene = np.random.default_rng(0).random((5, 2, 5)).astype(np.float32)
    assert (turn.to_a(turn.to_b(scene)) == scene).all()


def test_arm_b_is_built_as_the_forward_model_says() -> None:
    """Rows of arm B are the scene's columns from right to left."""
    scene = np.arange(9, dtype=np.float32).reshape(3, 1, 3)
    assert (AS_BUILT.to_b(scene)[:, 0] == scene[:, 0].T[::-1]).all()


def test_evidence_is_compared_with_its_spread() -> None:
    more, errors = compare(np.array([2.0, 3.0, 4.0]), np.zeros(3))
    assert more == 9
    assert errors == pytest.approx(9 / np.sqrt(3))
