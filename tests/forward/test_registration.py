"""Arm B's image is displaced: R, its transpose in every operator, and the effect ``misregistration``."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import affine_transform, map_coordinates

from acquire.alignment import Alignment
from acquire.arrays import Arrays, Dtype
from acquire.errors import UsageError
from acquire.forward import DualArm, Registration, hold_video, interpolation, merge_video
from acquire.forward.registration import FEW, runs, sampling_matrix
from acquire.geometry import Geometry
from acquire.sim.effects.lens import LensDistortion

ALIGNMENTS = [
    Alignment(0.3, -0.2),
    Alignment(-2.5, 1.25, 1.3, 1.01),
    Alignment(1.5, -1.0, -8.0, 0.97),
    Alignment(40.0, 0.0),
]
DISTORTED = Alignment(1.5, -1.0, 0.5, 1.01, 0.04)


@pytest.mark.parametrize("alignment", ALIGNMENTS)
def test_it_interpolates_where_arm_b_looks(alignment: Alignment) -> None:
    n, middle = 20, 9.5
    frame = np.random.default_rng(0).random((n, n))
    back = np.linalg.inv(alignment.matrix)
    offset = middle - back @ (middle + np.array([alignment.rows, alignment.columns]))
    expected = affine_transform(frame, back, offset, order=1, mode="nearest")
    seen = (sampling_matrix(alignment, n) @ frame.ravel()).reshape(n, n)
    np.testing.assert_allclose(seen, expected, atol=1e-12)


def test_oblong_frames_are_interpolated() -> None:
    rng = np.random.default_rng(1)
    frame, (rows, columns) = rng.random((9, 5)), rng.uniform(-1, 9, (2, 9, 5))
    expected = map_coordinates(frame, [rows, columns], order=1, mode="nearest")
    seen = (interpolation(rows, columns) @ frame.ravel()).reshape(9, 5)
    np.testing.assert_allclose(seen, expected, atol=1e-12)


@pytest.mark.parametrize("part", [0.06, -0.05])
def test_a_distorted_image_is_that_of_the_lens(part: float) -> None:
    """The effect ``lens_distortion`` and R show the same point, where both see the scene."""
    n = 24
    effect = LensDistortion(kind="lens_distortion", arm="b", part=part)
    setting = SimpleNamespace(arm="b", scene=SimpleNamespace(size=n))
    frame = np.random.default_rng(4).random((1, n, n)).astype(np.float32)
    expected = effect.stages(setting)[0].run(frame)[0]  # type: ignore[arg-type,call-arg]
    seen = (sampling_matrix(Alignment(distortion=part), n) @ frame[0].ravel()).reshape(n, n)
    inner = slice(4, -4)
    np.testing.assert_allclose(seen[inner, inner], expected[inner, inner], atol=1e-5)


@pytest.mark.parametrize("part", [0.05, -0.06, 0.0])
def test_positions_in_either_view_are_inverse(part: float) -> None:
    alignment, half = Alignment(3.0, -2.0, 1.5, 1.02, part), 32.0
    points = np.indices((9, 9)) * 7.0 - 28.0
    np.testing.assert_allclose(alignment.to_a(alignment.to_b(points, half), half), points, atol=1e-6)


def test_an_image_shifted_by_whole_pixels_is_that_image() -> None:
    frame = np.random.default_rng(1).random((12, 12))
    seen = (sampling_matrix(Alignment(2, -3), 12) @ frame.ravel()).reshape(12, 12)
    np.testing.assert_allclose(seen[2:, :-3], frame[:-2, 3:], atol=1e-12)


def test_a_quarter_turn_is_counter_clockwise() -> None:
    frame = np.random.default_rng(2).random((9, 9))
    half = (sampling_matrix(Alignment(turn_deg=45), 9) @ frame.ravel()).reshape(9, 9)
    point = np.zeros((9, 9))
    point[4, 8] = 1  # right of the middle
    turned = (sampling_matrix(Alignment(turn_deg=45), 9) @ point.ravel()).reshape(9, 9)
    row, column = np.unravel_index(turned.argmax(), turned.shape)
    assert row < 4 < column
    assert half.min() >= 0


@pytest.mark.parametrize("merge", [1, 2, 3, 5])
@pytest.mark.parametrize("alignment", [*ALIGNMENTS, DISTORTED])
def test_rows_sum_to_one_and_nothing_is_negative(alignment: Alignment, merge: int) -> None:
    matrix = sampling_matrix(alignment, 12, merge)
    np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=1e-12)
    assert matrix.data.min() > 0


@pytest.mark.parametrize("merge", [2, 3, 5])
def test_voxels_are_held_interpolated_and_averaged(merge: int) -> None:
    geometry, alignment = Geometry(4, 3, 1), ALIGNMENTS[1]
    voxels = np.random.default_rng(3).random(geometry.video_shape(merge, geometry.span))
    fine = hold_video(voxels, geometry, merge, geometry.span)[:1]
    seen = (sampling_matrix(alignment, 12) @ fine.reshape(-1)).reshape(1, 12, 12)
    expected = merge_video(seen, merge, 1)
    found = Registration(alignment, 12, merge).forward(voxels)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@st.composite
def cases(draw: st.DrawFn) -> tuple[Geometry, int, int, Alignment, int]:
    g = Geometry(draw(st.integers(1, 4)), draw(st.integers(1, 3)), draw(st.integers(1, 5)))
    shift, turn = st.floats(-5, 5), st.floats(-30, 30)
    alignment = Alignment(draw(shift), draw(shift), draw(turn), draw(st.floats(0.8, 1.25)))
    merges = draw(st.integers(1, g.size)), draw(st.integers(1, g.span + 2))
    return g, *merges, alignment, draw(st.integers(0, 2**32 - 1))


@settings(max_examples=60, deadline=None)
@given(cases())
def test_only_arm_b_is_displaced_and_the_transpose_is_exact(
    case: tuple[Geometry, int, int, Alignment, int],
) -> None:
    g, N_m, T_m, alignment, seed = case
    rng = np.random.default_rng(seed)
    code = rng.integers(0, 2, g.span).astype(np.uint8)
    code[0] = 1
    plain, moved = (DualArm(g, code, N_m, T_m, np.float64, which) for which in (None, alignment))
    video, lines = rng.standard_normal(plain.video_shape), rng.standard_normal(g.lines_shape)
    forward = moved.forward(video)
    np.testing.assert_allclose(forward[0], plain.forward(video)[0], atol=1e-12)
    seen = sampling_matrix(alignment, g.size, N_m) @ video.reshape(len(video), -1).T
    expected = plain.forward(seen.T.reshape(video.shape))[1]
    np.testing.assert_allclose(forward[1], expected, atol=1e-10)
    assert np.vdot(forward, lines) == pytest.approx(np.vdot(video, moved.adjoint(lines)), abs=1e-9)
    some = [rng.standard_normal(video.shape) for _ in range(3)]
    bound = moved.norm_bound(5)
    assert all(np.linalg.norm(moved.forward(x)) <= bound * np.linalg.norm(x) for x in some)


@pytest.mark.parametrize(
    "values", [(np.nan, 0, 0, 1), (0, 2e4, 0, 1), (0, 0, 60, 1), (0, 0, 0, 0), (0, 0, 0, 3)]
)
def test_impossible_alignments_are_refused(values: tuple[float, float, float, float]) -> None:
    with pytest.raises(UsageError, match="alignment"):
        Alignment(*values)


@pytest.mark.parametrize(
    ("merge", "alignment"), [(1, Alignment(6.0, -4.0, 0.5)), (3, Alignment(1.4, 2.3, -12.0))]
)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_frames_are_moved_along_diagonals_as_by_the_matrix(
    merge: int, alignment: Alignment, dtype: Dtype
) -> None:
    """In parts of a frame, with runs that are interrupted at its edges, for few frames and for many."""
    size, side = 96, 96 // merge
    matrix = sampling_matrix(alignment, size, merge)
    moved = Registration(alignment, size, merge, Arrays(dtype=dtype))
    assert len(runs(matrix, dtype)[0]) > 8
    rng = np.random.default_rng(7)
    for count in (1, FEW // matrix.nnz + 1):
        frames = rng.standard_normal((count, side, side)).astype(dtype)
        for product, which in ((moved.forward, matrix), (moved.adjoint, matrix.T)):
            expected = (which @ frames.reshape(count, -1).T).T.reshape(frames.shape)
            found = product(frames)
            assert found.dtype == dtype
            np.testing.assert_allclose(found, expected, atol=1e-5 if dtype == "float32" else 1e-12)
