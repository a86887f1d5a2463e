"""Streaming lines against Eq. (1) term by term, for both arms, both methods, and any split of the stream."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sim_helpers import CODE, LEDS, naive_lines

from acquire.codes import ConstantCode
from acquire.errors import UsageError
from acquire.sim import lines as lines_module
from acquire.sim.lines import FrameLines, SeparableLines, StreamingArm
from acquire.sim.scene import ArrayScene
from acquire.sim.scenes import build_scene

SUBSTEP_S = 1e-5
sizes = st.tuples(st.integers(1, 4), st.integers(1, 4))
arms = st.sampled_from("ab")


def led_scene(stages, substeps):
    return build_scene(LEDS, stages * substeps, SUBSTEP_S)


def array_scene(stages, substeps, frames=37):
    n = stages * substeps
    return ArrayScene(np.random.default_rng(n).random((frames, n, n)).astype(np.float32))


SCENES = {"separable": led_scene, "frames": array_scene}
scenes = st.sampled_from(sorted(SCENES))


@given(kind=scenes, size=sizes, arm=arms, first=st.integers(-20, 300), count=st.integers(1, 12))
@settings(max_examples=60, deadline=None)
def test_lines_obey_equation_1(kind, size, arm, first, count):
    scene = SCENES[kind](*size)
    Y = StreamingArm(scene, CODE, *size, arm).lines(first, count)
    assert (Y.dtype, Y.shape) == (np.float32, (count, size[0]))
    expected = naive_lines(scene, CODE, *size, arm, range(first, first + count))
    np.testing.assert_allclose(Y, expected, rtol=2e-6, atol=1e-5)


@given(
    kind=scenes,
    size=sizes,
    arm=arms,
    first=st.integers(-300, 300),
    splits=st.lists(st.integers(1, 200), min_size=1, max_size=5),
    block=st.integers(1, 40),
)
@settings(max_examples=60, deadline=None)
def test_lines_are_bit_for_bit_the_same_however_they_are_split(kind, size, arm, first, splits, block):
    scene = SCENES[kind](*size)
    whole = StreamingArm(scene, CODE, *size, arm).lines(first, sum(splits))
    parts, arm_again, line = [], StreamingArm(scene, CODE, *size, arm), first
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lines_module, "_BLOCK_BYTES", block * 4 * scene.size**2)
        fresh = StreamingArm(scene, CODE, *size, arm)
        for count in splits:
            parts.append(arm_again.lines(line, count))
            line += count
        np.testing.assert_array_equal(fresh.lines(first, sum(splits)), whole)
    np.testing.assert_array_equal(np.concatenate(parts), whole)


@given(kind=scenes, starts=st.lists(st.integers(-30, 600), min_size=2, max_size=6))
@settings(max_examples=25, deadline=None)
def test_any_line_can_be_asked_for_at_any_time(kind, starts):
    scene = SCENES[kind](3, 2)
    arm = StreamingArm(scene, CODE, 3, 2, "b")
    for first in starts:
        fresh = StreamingArm(scene, CODE, 3, 2, "b").lines(first, 9)
        np.testing.assert_array_equal(arm.lines(first, 9), fresh)


@pytest.mark.parametrize("arm", ["a", "b"])
def test_both_ways_agree(arm):
    """A separable scene, once as such and once as frames."""
    scene = led_scene(8, 3)

    class AsFrames:
        size = scene.size
        frames = staticmethod(scene.frames)

    separable = StreamingArm(scene, CODE, 8, 3, arm)
    by_frames = StreamingArm(AsFrames(), CODE, 8, 3, arm)
    assert isinstance(separable._lines, SeparableLines)
    assert isinstance(by_frames._lines, FrameLines)
    np.testing.assert_allclose(separable.lines(-9, 600), by_frames.lines(-9, 600), rtol=2e-6, atol=1e-5)


@pytest.mark.parametrize("kind", SCENES)
def test_preroll_is_dark_until_light_reaches_it(kind):
    """Line −(M + 1) ends before sub-step 0; the one after it holds a single lit sub-step."""
    M, S = 5, 3
    Y = StreamingArm(SCENES[kind](M, S), ConstantCode(1), M, S, "a").lines(-(M + 1), M + 2)
    assert (Y[0] == 0).all()
    assert (np.diff(Y.sum(axis=1)) > 0).all()


def test_a_constant_scene_gives_every_exposed_term():
    M, S = 4, 3
    Y = StreamingArm(ArrayScene(np.ones((1, 12, 12))), ConstantCode(1), M, S, "b").lines(0, 7)
    np.testing.assert_array_equal(Y, np.full((7, M), M * S * S * S))


def test_a_scene_is_sampled_in_bounded_ranges_and_not_in_the_dark():
    scene = array_scene(16, 3)
    asked = []

    class Watched:
        size = scene.size

        def frames(self, first, count):
            asked.append((first, count))
            return scene.frames(first, count)

    StreamingArm(Watched(), CODE, 16, 3, "a").lines(-2000, 4000)
    assert max(count for _, count in asked) * 4 * scene.size**2 <= lines_module._BLOCK_BYTES
    assert min(first for first, _ in asked) > -1000
    assert sum(count for _, count in asked) < 3 * 2000 + 2 * 16 * 3 + 1000


def test_a_continued_stream_asks_for_every_sub_step_once():
    scene = array_scene(4, 3)
    asked = []

    class Watched:
        size = scene.size

        def frames(self, first, count):
            asked.extend(range(first, first + count))
            return scene.frames(first, count)

    arm = StreamingArm(Watched(), ConstantCode(1), 4, 3, "a")
    for first, count in ((0, 7), (7, 1), (8, 30), (38, 2)):
        arm.lines(first, count)
    assert asked == list(range(3 * 40 + 12 - 1))


def test_an_led_out_of_sight_gives_darkness():
    lost = LEDS.leds[0].model_copy(update={"shape": "circle", "row": 0.0, "column": 0.0, "size": 0.001})
    scene = build_scene(LEDS.model_copy(update={"leds": (lost,)}), 6, SUBSTEP_S)
    assert not scene.masks.any()
    assert not StreamingArm(scene, CODE, 2, 3, "a").lines(0, 10).any()


@pytest.mark.parametrize(("stages", "arm", "word"), [(5, "a", "size 12"), (4, "c", "arm 'c'")])
def test_what_does_not_fit_is_refused(stages, arm, word):
    with pytest.raises(UsageError, match=word):
        StreamingArm(led_scene(4, 3), CODE, stages, 3, arm)
