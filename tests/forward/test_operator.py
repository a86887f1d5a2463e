"""The matrix-free operator against Eq. (1) written out and against the explicit matrices of Eq. (4)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acquire.errors import NumericsError, UsageError
from acquire.forward import DualArm, hold_video, merge_video
from acquire.forward.kernels import blocks_to_pixels, pixels_to_blocks
from acquire.geometry import Geometry


def eq1(X: np.ndarray, E: np.ndarray, g: Geometry) -> np.ndarray:
    """Eq. (1) as printed, 1-based."""
    M, S, L_R = g.stages, g.substeps, g.lines
    Y = np.zeros((L_R, M))
    for i in range(1, L_R + 1):
        for j in range(1, M + 1):
            for c in range((j - 1) * S + 1, j * S + 1):
                for u in range(S):
                    for r in range(1, M * S + 1):
                        t = r + u + (i - 1) * S
                        Y[i - 1, j - 1] += X[t - 1, r - 1, c - 1] * E[t - 1]
    return Y


def explicit_eq4(E: np.ndarray, g: Geometry, N_m: int, T_m: int) -> np.ndarray:
    """Λ′ of Eq. (4) from its factors (A, M_T, M_N, C_N, fliplr, P), acting on vec(X′_B)."""
    M, S, L_R, n, T = g.stages, g.substeps, g.lines, g.size, g.span
    A = np.zeros((L_R, T * n))
    for i in range(L_R):
        for u in range(S):
            for r in range(n):
                A[i, (r + u + i * S) * n + r] += E[r + u + i * S]
    A_B = A.reshape(L_R, T, n)[:, :, ::-1].reshape(L_R, T * n)
    frames, side, _ = g.video_shape(N_m, T_m)
    M_T = np.kron(np.equal.outer(np.arange(T) // T_m, np.arange(frames)), np.eye(n))
    M_N = np.kron(np.eye(frames), np.equal.outer(np.arange(n) // N_m, np.arange(side)))
    C = np.kron(np.eye(M), np.ones((S, 1)))
    C_N = np.equal.outer(np.arange(side), np.arange(n) // N_m) @ C
    index = np.arange(frames * side * side).reshape(frames, side, side)
    P = np.eye(index.size)[index.transpose(0, 2, 1).ravel()]
    return np.vstack([np.kron(A @ M_T @ M_N, C_N.T) @ P, np.kron(A_B @ M_T @ M_N, C_N.T)])


@st.composite
def cases(draw: st.DrawFn) -> tuple[Geometry, int, int, int]:
    g = Geometry(draw(st.integers(1, 4)), draw(st.integers(1, 3)), draw(st.integers(1, 5)))
    return g, draw(st.integers(1, g.size)), draw(st.integers(1, g.span + 2)), draw(st.integers(0, 2**32 - 1))


@settings(max_examples=60, deadline=None)
@given(cases())
def test_operator_equals_eq1_on_held_voxels(case: tuple[Geometry, int, int, int]) -> None:
    g, N_m, T_m, seed = case
    rng = np.random.default_rng(seed)
    E = rng.integers(0, 2, g.span).astype(np.uint8)
    op = DualArm(g, E, N_m, T_m, np.float64)
    voxels = rng.standard_normal(op.video_shape)
    X = hold_video(voxels, g, N_m, T_m)
    expected = np.stack([eq1(X, E, g), eq1(np.rot90(X, 1, axes=(1, 2)), E, g)])
    np.testing.assert_allclose(op.forward(voxels), expected, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(cases())
def test_operator_equals_explicit_eq4(case: tuple[Geometry, int, int, int]) -> None:
    g, N_m, T_m, seed = case
    rng = np.random.default_rng(seed)
    E = rng.integers(0, 2, g.span).astype(np.uint8)
    op = DualArm(g, E, N_m, T_m, np.float64)
    video = rng.standard_normal(op.video_shape)  # X′_A; X′_B is its transpose by frame
    matrix = explicit_eq4(E, g, N_m, T_m)
    expected = matrix @ video.transpose(0, 2, 1).ravel()
    np.testing.assert_allclose(op.forward(video).ravel(), expected, atol=1e-12)
    lines = rng.standard_normal(op.lines_shape)
    back = (matrix.T @ lines.ravel()).reshape(op.video_shape).transpose(0, 2, 1)
    np.testing.assert_allclose(op.adjoint(lines), back, atol=1e-12)


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 1e-6), (np.float64, 1e-12)])
@pytest.mark.parametrize(("N_m", "T_m"), [(1, 1), (3, 1), (3, 4), (5, 7), (1, 820)])
def test_adjoint(dtype: type, tolerance: float, N_m: int, T_m: int) -> None:
    rng = np.random.default_rng(7)
    g = Geometry(16, 3, 90)
    op = DualArm(g, rng.integers(0, 2, g.span).astype(np.uint8), N_m, T_m, dtype)
    x = rng.standard_normal(op.video_shape).astype(dtype)
    y = rng.standard_normal(op.lines_shape).astype(dtype)
    forward, adjoint = op.forward(x), op.adjoint(y)
    left = np.vdot(forward.astype(np.float64), y.astype(np.float64))
    right = np.vdot(x.astype(np.float64), adjoint.astype(np.float64))
    scale = np.linalg.norm(forward) * np.linalg.norm(y)
    assert abs(left - right) < tolerance * scale
    assert forward.dtype == adjoint.dtype == dtype


@settings(max_examples=30, deadline=None)
@given(cases())
def test_norm_bound_is_above_the_norm_and_tight(case: tuple[Geometry, int, int, int]) -> None:
    g, N_m, T_m, seed = case
    E = np.random.default_rng(seed).integers(0, 2, g.span).astype(np.uint8)
    E[0] = 1
    op = DualArm(g, E, N_m, T_m, np.float64)
    norm = np.linalg.norm(explicit_eq4(E, g, N_m, T_m), 2)
    rounding = 1 + 1e-9
    assert norm <= op.norm_bound(steps=5) * rounding
    assert op.norm_bound(steps=400) <= 1.05 * norm


def test_lines_of_one_arm_share_no_voxel_at_full_resolution() -> None:
    g = Geometry(3, 2, 4)
    E = np.ones(g.span, np.uint8)
    one_arm = explicit_eq4(E, g, 1, 1)[: g.lines * g.stages]
    gram = one_arm @ one_arm.T
    assert np.count_nonzero(gram - np.diag(np.diag(gram))) == 0


def test_merge_inverts_hold_and_weights_short_blocks_correctly() -> None:
    g = Geometry(2, 2, 3)
    rng = np.random.default_rng(0)
    voxels = rng.random(g.video_shape(3, 4))
    np.testing.assert_allclose(merge_video(hold_video(voxels, g, 3, 4), 3, 4), voxels, rtol=1e-6)


def test_columns_are_weighted_by_the_overlap_of_block_and_pixel() -> None:
    """C_N of Eq. (3), and its transpose: N_m·I where N_m = S, true overlap counts elsewhere."""
    np.testing.assert_array_equal(blocks_to_pixels(np.eye(2), 4, 2, 3), [[2, 1], [0, 1]])
    np.testing.assert_array_equal(blocks_to_pixels(np.eye(2), 4, 2, 2), 2 * np.eye(2))
    np.testing.assert_array_equal(pixels_to_blocks(np.eye(2), 4, 2, 3), [[2, 0], [1, 1]])


def test_refusals_name_what_is_possible() -> None:
    g = Geometry(2, 2, 3)
    code = np.ones(g.span, np.uint8)
    with pytest.raises(UsageError, match="1 to 4"):
        DualArm(g, code, spatial_merge=5)
    with pytest.raises(UsageError, match="T_m = 0"):
        DualArm(g, code, temporal_merge=0)
    with pytest.raises(UsageError, match=r"T = S·\(M \+ L_R\) − 1"):
        DualArm(g, code[:-1])
    with pytest.raises(UsageError, match=r"E ∈ \{0, 1\}"):
        DualArm(g, code * 2)
    with pytest.raises(UsageError, match="float32, float64"):
        DualArm(g, code, dtype=np.float16)
    with pytest.raises(UsageError, match="video of shape"):
        DualArm(g, code).forward(np.zeros((1, 1, 1)))
    with pytest.raises(NumericsError, match="dark"):
        DualArm(g, 0 * code).norm_bound()
