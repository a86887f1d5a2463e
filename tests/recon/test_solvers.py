"""The solvers against closed forms and against each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acquire.arrays import open_arrays
from acquire.errors import NumericsError
from acquire.forward import DualArm
from acquire.geometry import Geometry
from acquire.recon.admm import Admm, AdmmParameters
from acquire.recon.band import InBasis
from acquire.recon.basis import TemporalBasis
from acquire.recon.problem import MaskedOperator
from acquire.recon.tv import FrameTv
from acquire.recon.twist import Twist, TwistParameters

DOUBLE = open_arrays(dtype="float64")


class Small:
    """A problem small enough for its matrix: M = 3, S = 2, 9 lines, N_m = 2, T_m = 3, noise-free."""

    def __init__(self) -> None:
        rng = np.random.default_rng(3)
        self.geometry = Geometry(3, 2, 9)
        code = rng.integers(0, 2, self.geometry.span).astype(np.uint8)
        whole = DualArm(self.geometry, code, 2, 3, np.float64)
        self.shape = whole.video_shape
        self.basis = TemporalBasis(self.shape[0], self.shape[0], DOUBLE)
        mask = np.ones(whole.lines_shape)
        mask[0, 2] = mask[1, 5, 1] = 0.0
        self.operator = MaskedOperator(
            InBasis(self.geometry, code, self.basis, 2, 3), mask / whole.norm_bound()
        )
        truth = self.basis.analyze(1 + rng.random(self.shape))
        self.samples = np.where(mask > 0, self.operator.forward(truth), 0.0)
        unit = np.eye(truth.size).reshape(-1, *self.shape)
        self.matrix = np.stack([self.operator.forward(e).ravel() for e in unit], axis=1)

    def objective(self, theta: np.ndarray, weight: float) -> float:
        gap = self.samples - self.operator.forward(theta)
        return 0.5 * float(np.vdot(gap, gap)) + weight * FrameTv(1).value(theta)


@pytest.fixture(scope="module")
def small() -> Small:
    return Small()


def test_admm_data_step_is_the_ridge_solution(small: Small) -> None:
    parameters = AdmmParameters(tv_penalty=0.3, sign_penalty=0.2, gradient_steps=60)
    solver = Admm(small.operator, small.samples, small.shape, small.basis, parameters)
    rng = np.random.default_rng(1)
    solver.theta = rng.standard_normal(small.shape)
    centre = 0.3 * solver.theta.ravel() / 0.5
    normal = small.matrix.T @ small.matrix + 0.5 * np.eye(small.matrix.shape[1])
    expected = np.linalg.solve(normal, small.matrix.T @ small.samples.ravel() + 0.5 * centre)
    np.testing.assert_allclose(solver._data_step().ravel(), expected, atol=1e-8)


def test_twist_without_a_prior_solves_the_data_and_leaves_the_null_space_alone(small: Small) -> None:
    parameters = TwistParameters(tv_weight=0.0, smallest_eigenvalue=1e-2)
    solver = Twist(small.operator, small.samples, small.shape, parameters)
    start = solver.objective
    for _ in range(500):
        solver.step()
    assert solver.objective < 1e-6 * start
    seen = np.linalg.pinv(small.matrix, rcond=1e-10) @ small.matrix
    theta = solver.theta.ravel()
    np.testing.assert_allclose(seen @ theta, theta, atol=1e-9)


def test_twist_never_rises_above_the_mean_of_its_past(small: Small) -> None:
    solver = Twist(
        small.operator, small.samples, small.shape, TwistParameters(tv_weight=0.05, tv_iterations=3)
    )
    start, ceiling = solver.objective, solver.ceiling
    for _ in range(100):
        solver.step()
        assert solver.objective <= solver.ceiling <= ceiling
        ceiling = solver.ceiling
    assert solver.objective < 0.1 * start
    assert solver.objective == pytest.approx(small.objective(solver.theta, 0.05))


def test_both_solvers_find_the_same_minimum(small: Small) -> None:
    """The truth is bright everywhere, so ADMM's sign constraint is idle and both minimise Eq. (5)."""
    weight = 0.02
    twist = Twist(
        small.operator, small.samples, small.shape, TwistParameters(tv_weight=weight, tv_iterations=60)
    )
    admm = Admm(
        small.operator,
        small.samples,
        small.shape,
        small.basis,
        AdmmParameters(tv_weight=weight, tv_penalty=0.1, sign_penalty=0.03, tv_iterations=60),
    )
    for _ in range(500):
        twist.step()
        admm.step()
    found = small.objective(admm.theta, weight)
    assert found == pytest.approx(small.objective(twist.theta, weight), rel=1e-3)
    nudged = admm.theta + 1e-2 * np.random.default_rng(4).standard_normal(small.shape)
    assert found < small.objective(nudged, weight)


@pytest.mark.parametrize("how", ["reweigh", "resume"])
def test_a_minimum_stays_one_with_other_penalties(small: Small, how: str) -> None:
    """Penalties are no part of Eq. (5): w, the residual divided by them, was left as it was."""
    first = AdmmParameters(tv_weight=0.02, tv_penalty=0.1, sign_penalty=0.03, tv_iterations=60)
    other = replace(first, tv_penalty=0.02, sign_penalty=0.006)
    admm = Admm(small.operator, small.samples, small.shape, small.basis, first)
    for _ in range(1500):
        admm.step()
    found = admm.theta.copy()
    if how == "reweigh":
        admm.reweigh(other)
    else:
        # the dual field of total variation is the denoiser's, which the trials of a search may share
        resumed = Admm(small.operator, small.samples, small.shape, small.basis, other)
        resumed._denoiser = admm._denoiser
        resumed.resume(admm)
        admm = resumed
    for _ in range(3):
        admm.step()
        assert np.abs(admm.theta - found).max() < 1e-6 * np.abs(found).max()


def test_samples_that_are_not_finite_stop_the_solvers(small: Small) -> None:
    samples = small.samples.copy()
    samples[0, 0, 0] = np.inf
    admm = Admm(small.operator, samples, small.shape, small.basis, AdmmParameters())
    with pytest.raises(NumericsError, match="finite"):
        admm.step()
    with pytest.raises(NumericsError, match="finite"):
        Twist(small.operator, samples, small.shape, TwistParameters())
