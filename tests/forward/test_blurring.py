"""The optics' blur of either arm in Λ′: its kernel, its transpose, and the effect ``psf``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d

from acquire.alignment import Alignment
from acquire.arrays import Arrays, Dtype
from acquire.blur import Blur
from acquire.errors import UsageError
from acquire.forward import (
    DualArm,
    GatheredArms,
    blur_matrices,
    hold_video,
    interpolation_variance,
    mean_weights,
    merge_video,
)
from acquire.forward.blurring import Blurring, blur_matrix, kernel
from acquire.forward.registration import sampling_matrix
from acquire.geometry import Geometry

if TYPE_CHECKING:
    from numpy.typing import NDArray

BLUR = Blur((0.7, 0.4), (1.3, 0.9))


@pytest.mark.parametrize("sigma", [0.15, 0.3, 0.6, 1.0, 3.0])
def test_a_kernel_is_as_wide_as_was_measured(sigma: float) -> None:
    weights = kernel(sigma)
    at = np.arange(len(weights)) - len(weights) // 2
    assert weights.sum() == pytest.approx(1)
    assert (weights * at**2).sum() == pytest.approx(sigma**2, rel=1e-6)
    np.testing.assert_array_equal(weights, weights[::-1])


SHADED = Blur((0.7, 0.0), (0.0, 0.9), (0.1, -0.2, 0.0, -0.15), (0.0, -0.3, -0.05, -0.1))


@pytest.mark.parametrize("merge", [1, 3])
def test_what_a_lens_takes_of_the_light_is_in_the_operator(merge: int) -> None:
    """Relative to the brightest point, and with an exact transpose."""
    geometry = Geometry(stages=8, substeps=3, lines=20)
    code = np.random.default_rng(5).integers(0, 2, geometry.span).astype(np.uint8)
    bare = DualArm(geometry, code, merge, 4, np.float64)
    shaded = DualArm(geometry, code, merge, 4, np.float64, Alignment(0.4, -0.3), SHADED)
    rng = np.random.default_rng(6)
    video, lines = rng.random(bare.video_shape), rng.random(bare.lines_shape)
    assert (shaded.forward(video) * lines).sum() == pytest.approx((video * shaded.adjoint(lines)).sum())
    assert shaded.norm_bound() <= bare.norm_bound() * 1.01
    x = (np.arange(24) - 11.5) / 12
    rows, columns = 1 + 0.1 * x - 0.2 * x**2, 1 - 0.15 * x**2
    only = Blur((0.0, 0.0), (0.0, 0.0), SHADED.shade_a, SHADED.shade_b)
    fine = DualArm(geometry, code, 1, 4, np.float64, blur=only)
    video = rng.random(fine.video_shape)
    dimmed = video * (rows / rows.max())[:, None] * columns / columns.max()
    expected = DualArm(geometry, code, 1, 4, np.float64).forward(dimmed)[0]
    np.testing.assert_allclose(fine.forward(video)[0], expected)
    assert SHADED.swapped().shade_a == SHADED.shade_b


def test_light_that_is_not_above_0_is_refused() -> None:
    with pytest.raises(UsageError, match="light on the field is impossible"):
        Blur((0.0, 0.0), (0.0, 0.0), (0.0, -1.0, 0.0, 0.0))


def test_an_image_without_blur_is_unchanged() -> None:
    np.testing.assert_array_equal(blur_matrix(0.0, 12), np.eye(12))
    np.testing.assert_array_equal(blur_matrix(0.0, 12, 3), np.eye(4))


def test_inside_the_field_it_is_the_simulators_gaussian() -> None:
    frame = np.random.default_rng(0).random((40, 40))
    at = np.arange(-6, 7)
    weights = np.exp(-0.5 * (at / 1.4) ** 2)
    sigma = float(np.sqrt((weights * at**2).sum() / weights.sum()))
    expected = gaussian_filter1d(frame, 1.4, axis=0, mode="nearest")
    np.testing.assert_allclose(blur_matrix(sigma, 40) @ frame, expected, atol=1e-6)


@pytest.mark.parametrize("merge", [1, 2, 3, 5])
def test_rows_sum_to_one_and_nothing_is_negative(merge: int) -> None:
    for pair in blur_matrices(BLUR, 12, merge):
        for matrix in pair:
            np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=1e-12)
            assert matrix.min() >= 0


@pytest.mark.parametrize("merge", [2, 3, 5])
def test_voxels_are_held_blurred_and_averaged(merge: int) -> None:
    geometry = Geometry(4, 3, 1)
    voxels = np.random.default_rng(3).random(geometry.video_shape(merge, geometry.span))
    fine = hold_video(voxels, geometry, merge, geometry.span)[:1]
    for (rows, columns), (by_row, by_column) in zip(
        blur_matrices(BLUR, 12), blur_matrices(BLUR, 12, merge), strict=True
    ):
        expected = merge_video(rows @ fine @ columns.T, merge, 1)
        np.testing.assert_allclose(by_row @ voxels @ by_column.T, expected, rtol=1e-6)


def test_each_arm_is_blurred_along_and_across_its_own_transfer() -> None:
    """In arm A a point spreads vertically by the width along the transfer, in arm B horizontally."""
    g = Geometry(8, 3, 40)
    code = np.random.default_rng(0).integers(0, 2, g.span).astype(np.uint8)
    video = np.zeros((1, 24, 24))
    video[0, 11, 13] = 1
    tall, wide = np.zeros_like(video), np.zeros_like(video)
    tall[0, :, 13] = wide[0, 11, :] = 1
    tall[0] *= blur_matrix(1.2, 24)[11][:, None]
    wide[0] *= blur_matrix(0.8, 24)[13]
    sharp = DualArm(g, code, 1, g.span, np.float64)
    blurred = DualArm(g, code, 1, g.span, np.float64, blur=Blur((1.2, 0), (0.8, 0)))
    seen = blurred.forward(video)
    np.testing.assert_allclose(seen[0], sharp.forward(tall)[0], atol=1e-12)
    np.testing.assert_allclose(seen[1], sharp.forward(wide)[1], atol=1e-12)


@st.composite
def cases(draw: st.DrawFn) -> tuple[Geometry, int, int, Blur, Alignment | None, int]:
    g = Geometry(draw(st.integers(1, 4)), draw(st.integers(1, 3)), draw(st.integers(1, 5)))
    sigma = st.floats(0, 3)
    veil = st.sampled_from([0.0, 0.02, 0.4])
    blur = Blur((draw(sigma), draw(sigma)), (draw(sigma), draw(sigma)), veil=(draw(veil), draw(veil)))
    off = Alignment(draw(st.floats(-3, 3)), 0.4, draw(st.floats(-20, 20))) if draw(st.booleans()) else None
    merges = draw(st.integers(1, g.size)), draw(st.integers(1, g.span + 2))
    return g, *merges, blur, off, draw(st.integers(0, 2**32 - 1))


@settings(max_examples=60, deadline=None)
@given(cases())
def test_the_transpose_is_exact_and_the_bound_holds(
    case: tuple[Geometry, int, int, Blur, Alignment | None, int],
) -> None:
    g, N_m, T_m, blur, off, seed = case
    rng = np.random.default_rng(seed)
    code = rng.integers(0, 2, g.span).astype(np.uint8)
    code[0] = 1
    sharp, model = (DualArm(g, code, N_m, T_m, np.float64, off, each) for each in (None, blur))
    video, lines = rng.standard_normal(model.video_shape), rng.standard_normal(g.lines_shape)
    forward = model.forward(video)
    assert np.vdot(forward, lines) == pytest.approx(np.vdot(video, model.adjoint(lines)), abs=1e-9)
    (rows, columns), (rows_b, columns_b) = blur_matrices(blur, g.size, N_m)
    mean = mean_weights(g.size, N_m)

    def on_sensor(rows: NDArray[Any], frames: NDArray[Any], columns: NDArray[Any], arm: int) -> NDArray[Any]:
        image, veil = rows @ frames @ columns.T, blur.veil[arm]
        return np.asarray((1 - veil) * image + veil * (image @ mean @ mean)[:, None, None])

    np.testing.assert_allclose(forward[0], sharp.forward(on_sensor(rows, video, columns, 0))[0], atol=1e-10)
    seen = video
    if off is not None:
        moved = sampling_matrix(off, g.size, N_m) @ video.reshape(len(video), -1).T
        seen = moved.T.reshape(video.shape)
    plain = DualArm(g, code, N_m, T_m, np.float64)
    seen = on_sensor(rows_b, seen, columns_b, 1)
    np.testing.assert_allclose(forward[1], plain.forward(seen)[1], atol=1e-10)
    bound = model.norm_bound(5)
    some = [rng.standard_normal(video.shape) for _ in range(3)]
    assert all(np.linalg.norm(model.forward(x)) <= bound * np.linalg.norm(x) for x in some)
    gathered = GatheredArms(g, code, N_m, T_m, Arrays(dtype="float64"), off, blur)
    np.testing.assert_allclose(gathered.forward(video), forward, atol=1e-10)
    np.testing.assert_allclose(gathered.adjoint(lines), model.adjoint(lines), atol=1e-10)


def test_registration_blurs_by_its_interpolation_variance() -> None:
    """The image of a point displaced by a third and a half of a pixel has the variance f·(1 − f)."""
    rows, columns = interpolation_variance(Alignment(1 / 3, 0.5), 30)
    assert (rows, columns) == pytest.approx((2 / 9, 1 / 4))
    assert interpolation_variance(Alignment(2, -1), 30) == pytest.approx((0, 0))


@pytest.mark.parametrize("values", [(-0.1, 0), (np.nan, 0), (0, 17)])
def test_impossible_widths_are_refused(values: tuple[float, float]) -> None:
    with pytest.raises(UsageError, match="blur is impossible"):
        Blur((0, 0), values)


@pytest.mark.parametrize("veil", [-0.1, 0.6, float("nan")])
def test_impossible_veils_are_refused(veil: float) -> None:
    with pytest.raises(UsageError, match="veil is impossible"):
        Blur((0, 0), (0, 0), veil=(0.0, veil))


def test_the_arms_exchange_their_veils() -> None:
    assert Blur((0, 0), (0, 0), veil=(0.01, 0.03)).swapped().veil == (0.03, 0.01)


@pytest.mark.parametrize("merge", [1, 3])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_frames_are_blurred_along_diagonals_as_by_the_matrices(merge: int, dtype: Dtype) -> None:
    """Narrow bands by compiled loops, wide ones by products, with a lens and a veil."""
    size, side = 96, 96 // merge
    mean = mean_weights(size, merge)
    rng = np.random.default_rng(8)
    frames = rng.standard_normal((3, side, side)).astype(dtype)
    for sigma in (0.6, 15.0):
        blur = Blur((sigma, 0.4), (0.9, sigma), (0.1, -0.2, 0.0, -0.15), veil=(0.03, 0.0))
        model = Blurring(blur, size, merge, Arrays(dtype=dtype))
        for arm, (rows, columns) in enumerate(blur_matrices(blur, size, merge)):
            image = rows @ frames @ columns.T
            veil = blur.veil[arm]
            expected = (1 - veil) * image + veil * (image @ mean @ mean)[:, None, None]
            found, given = model.forward(arm, frames), rng.standard_normal(frames.shape).astype(dtype)
            assert found.dtype == dtype
            tolerance = 1e-5 if dtype == "float32" else 1e-12
            np.testing.assert_allclose(found, expected, atol=tolerance)
            back = model.adjoint(arm, given)
            scale = np.linalg.norm(found) * np.linalg.norm(given)
            assert abs(np.vdot(found, given) - np.vdot(frames, back)) < tolerance * scale
