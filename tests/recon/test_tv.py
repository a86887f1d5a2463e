"""The TV prox against closed forms and against an independent implementation."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.restoration import denoise_tv_chambolle

from acquire.errors import UsageError
from acquire.recon.tv import FrameTv


def prox(frames: np.ndarray, weight: float, iterations: int = 3000) -> np.ndarray:
    return FrameTv(iterations).prox(frames, weight)


def test_two_pixels_move_towards_each_other_until_they_meet() -> None:
    frame = np.array([[[0.0, 1.0]]])
    np.testing.assert_allclose(prox(frame, 0.2), [[[0.2, 0.8]]], atol=1e-9)
    np.testing.assert_allclose(prox(frame, 0.7), [[[0.5, 0.5]]], atol=1e-9)


def test_a_step_loses_height_by_weight_times_edge_over_area() -> None:
    """A half-bright frame: each side moves by λ · edge length / area of that side."""
    frame = np.zeros((1, 6, 10))
    frame[:, :, 5:] = 1.0
    expected = np.where(frame > 0, 1 - 0.5 * 6 / 30, 0.5 * 6 / 30)
    np.testing.assert_allclose(prox(frame, 0.5), expected, atol=1e-6)


def test_equals_an_independent_implementation() -> None:
    frame = np.random.default_rng(0).random((20, 30))
    ours = prox(frame[None], 0.3, 5000)[0]
    theirs = denoise_tv_chambolle(frame, weight=0.3, eps=1e-14, max_num_iter=100_000)
    tv = FrameTv(1)

    def objective(x: np.ndarray) -> float:
        return 0.5 * float(((x - frame) ** 2).sum()) + 0.3 * tv.value(x[None])

    assert objective(ours) <= objective(theirs) * (1 + 1e-7)
    np.testing.assert_allclose(ours, theirs, atol=5e-5)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_extreme_weights(dtype: type) -> None:
    frames = np.random.default_rng(1).random((3, 8, 8)).astype(dtype)
    np.testing.assert_array_equal(prox(frames, 0.0), frames)
    np.testing.assert_allclose(prox(frames, 1e-30), frames, rtol=1e-6)
    flat = np.broadcast_to(frames.mean(axis=(1, 2), keepdims=True), frames.shape)
    np.testing.assert_allclose(prox(frames, 1e8), flat, rtol=2e-2)


def test_frames_are_independent_and_warm_starts_reach_the_same_point() -> None:
    frames = np.random.default_rng(2).random((4, 12, 9))
    together = prox(frames, 0.1)
    np.testing.assert_allclose(prox(frames[2:3], 0.1), together[2:3], atol=1e-12)
    warm = FrameTv(20)
    for _ in range(200):
        last = warm.prox(frames, 0.1)
    np.testing.assert_allclose(last, together, atol=1e-5)


def test_frames_with_edges_in_common_move_as_one_vector() -> None:
    """A step of (3, 4) loses height as one of 5 would, in its own direction, whatever the frames' basis."""
    step = np.zeros((1, 6, 10))
    step[:, :, 5:] = 1.0
    lower = prox(5 * step, 0.5) / 5
    tv = FrameTv(3000, joint=True)
    np.testing.assert_allclose(tv.prox(np.concatenate([3 * step, 4 * step]), 0.5)[1], 4 * lower[0], atol=1e-6)
    assert FrameTv(1, joint=True).value(np.concatenate([3 * step, 4 * step])) == pytest.approx(5 * 6)
    frames, turn = np.random.default_rng(3).random((2, 9, 8)), np.array([[0.6, -0.8], [0.8, 0.6]])
    turned = FrameTv(3000, joint=True).prox(np.tensordot(turn, frames, axes=1), 0.2)
    there = FrameTv(3000, joint=True).prox(frames, 0.2)
    np.testing.assert_allclose(turned, np.tensordot(turn, there, axes=1), atol=1e-5)
    alone = FrameTv(3000, joint=True).prox(frames[:1], 0.2)
    np.testing.assert_allclose(alone, prox(frames[:1], 0.2), atol=1e-9)


def test_frames_with_edges_in_common_minimise_what_is_said() -> None:
    generator = np.random.default_rng(4)
    frames, weights = generator.random((3, 10, 12)), np.array([0.1, 0.3, 0.05])
    value = FrameTv(1, joint=True).value

    def objective(x: np.ndarray) -> float:
        return 0.5 * float(((x - frames) ** 2).sum()) + value(weights[:, None, None] * x)

    found = FrameTv(3000, joint=True).prox(frames, weights)
    for _ in range(20):
        assert objective(found) <= objective(found + 1e-3 * generator.standard_normal(frames.shape))
    assert objective(found) < objective(prox(frames, 0.1))


def test_value_of_a_disc_edge_and_refusal() -> None:
    frame = np.zeros((2, 5, 5))
    frame[1, 2, 2] = 1.0  # three forward differences: right-below corner √2, left 1, above 1
    tv = FrameTv(1)
    assert tv.value(frame) == pytest.approx(2 + np.sqrt(2))
    with pytest.raises(UsageError, match="0 iterations"):
        FrameTv(0)
