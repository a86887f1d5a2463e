"""The temporal basis, and Λ′ restricted to it."""

from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from recon_cases import cases

from acquire.alignment import Alignment
from acquire.arrays import open_arrays
from acquire.blur import Blur
from acquire.cores import side_by_side
from acquire.errors import UsageError
from acquire.forward import DualArm
from acquire.geometry import Geometry
from acquire.recon import band
from acquire.recon.band import BandOperator, InBasis, band_operator
from acquire.recon.basis import TemporalBasis

DOUBLE = open_arrays(dtype="float64")


def test_basis_is_orthonormal_and_transforms_agree_with_its_matrix() -> None:
    basis = TemporalBasis(50, 12, DOUBLE)
    D = basis.matrix()
    np.testing.assert_allclose(D @ D.T, np.eye(12), atol=1e-12)
    np.testing.assert_allclose(basis.matrix(24) @ basis.matrix(24).T, np.eye(12), atol=1e-12)
    theta = np.random.default_rng(0).standard_normal((12, 3, 4))
    video = basis.synthesize(theta)
    np.testing.assert_allclose(video, np.tensordot(D.T, theta, 1), atol=1e-12)
    np.testing.assert_allclose(basis.analyze(video), theta, atol=1e-12)


def test_the_coarse_grid_samples_the_same_function() -> None:
    """A video at twice as many instants samples the same band-limited signal."""
    basis = TemporalBasis(60, 10, DOUBLE)
    theta = np.random.default_rng(1).standard_normal(10)
    coarse = basis.matrix(20).T @ theta * np.sqrt(20 / 60)
    fine = basis.synthesize(theta)
    np.testing.assert_allclose(coarse, fine[1::3], atol=1e-12)


def test_basis_refuses_more_cosines_than_instants() -> None:
    with pytest.raises(UsageError, match="1 to 5"):
        TemporalBasis(5, 6)
    with pytest.raises(UsageError, match="3 instants are too few for 4"):
        TemporalBasis(5, 4).matrix(3)


def test_long_segments_do_without_the_dense_factors(monkeypatch: pytest.MonkeyPatch) -> None:
    g = Geometry(2, 2, 10)
    code, basis = np.ones(g.span, np.uint8), TemporalBasis(g.span, 4)
    assert isinstance(band_operator(g, code, basis), BandOperator)
    monkeypatch.setattr(band, "LARGEST_FACTORS_BYTES", 100)
    assert isinstance(band_operator(g, code, basis), InBasis)


def test_arms_side_by_side_are_the_same_to_the_last_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    g, rng = Geometry(5, 3, 20), np.random.default_rng(2)
    operator = BandOperator(g, rng.integers(0, 2, g.span).astype(np.uint8), TemporalBasis(g.span, 9), 2)
    theta, lines = rng.standard_normal(operator.theta_shape), rng.standard_normal(g.lines_shape)
    alone = operator.forward(theta), operator.adjoint(lines)
    monkeypatch.setattr(band, "WORTH_A_THREAD", 0)
    monkeypatch.setattr(band, "granted_threads", lambda: 2)
    together = Mock(side_effect=side_by_side)
    monkeypatch.setattr(band, "side_by_side", together)
    for one, other in zip(alone, (operator.forward(theta), operator.adjoint(lines)), strict=True):
        np.testing.assert_array_equal(one, other)
    assert together.call_count == 2


@settings(max_examples=60, deadline=None)
@given(cases())
def test_band_operator_is_the_sensing_matrix_in_the_basis(case: tuple[Geometry, int, int, int, int]) -> None:
    g, N_m, T_m, K, seed = case
    rng = np.random.default_rng(seed)
    code = rng.integers(0, 2, g.span).astype(np.uint8)
    whole = DualArm(g, code, N_m, T_m, np.float64)
    basis = TemporalBasis(whole.video_shape[0], K, DOUBLE)
    off = Alignment(*rng.uniform(-2, 2, 2), *rng.uniform(-9, 9, 1)) if seed % 2 else None
    a, b = rng.uniform(0, 2, (2, 2)).tolist()
    veil = ((0.0, 0.0), (0.03, 0.0), (0.1, 0.2))[seed % 3]
    blur = Blur(tuple(a), tuple(b), veil=veil) if seed % 4 > 1 else None
    band, composed = (
        each(g, code, basis, N_m, T_m, alignment=off, blur=blur) for each in (BandOperator, InBasis)
    )
    theta = rng.standard_normal(band.theta_shape)
    lines = rng.standard_normal(g.lines_shape)
    np.testing.assert_allclose(band.forward(theta), composed.forward(theta), atol=1e-11)
    np.testing.assert_allclose(band.adjoint(lines), composed.adjoint(lines), atol=1e-11)
    left, right = np.vdot(band.forward(theta), lines), np.vdot(theta, band.adjoint(lines))
    assert left == pytest.approx(right, abs=1e-9)
