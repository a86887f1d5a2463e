"""Lamps beside something that moves: both parts in one solver, and whole reconstructions with noise."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from recon_cases import given_for

from acquire.arrays import Arrays
from acquire.codes import prbs
from acquire.evaluate.metrics import psnr
from acquire.forward import merge_video
from acquire.geometry import Geometry
from acquire.recon import blinking, reconstruct, settling
from acquire.recon.admm import Admm, AdmmParameters
from acquire.recon.band import band_operator
from acquire.recon.basis import LearnedBasis, TemporalBasis
from acquire.recon.beside_motion import beside_motion, find_lamps
from acquire.recon.clock import IterationClock
from acquire.recon.joined import JoinedLayout, JoinedOperator, JoinedPrior, JoinedSign
from acquire.recon.patterns import ROUND
from acquire.recon.problem import build_problem
from acquire.recon.sign import SignSplit
from acquire.recon.tv import FrameTv
from acquire.recon.volume import VolumeTv
from acquire.sim.procedural import CLEAN, record

GEOMETRY = Geometry(stages=4, substeps=3, lines=20)
LAYOUT = JoinedLayout((5, 4, 4), (3, 12, 12), 3.0)
RNG = np.random.default_rng(0)


def parts() -> tuple[np.ndarray, np.ndarray]:
    return RNG.standard_normal(LAYOUT.volume), RNG.standard_normal(LAYOUT.patterns)


def test_what_is_joined_comes_apart_again() -> None:
    first, second = parts()
    theta = LAYOUT.joined(first, second)
    assert theta.shape == LAYOUT.shape
    np.testing.assert_allclose(LAYOUT.parts(theta)[0], first, rtol=1e-15)
    np.testing.assert_array_equal(LAYOUT.parts(theta)[1], second)


def joined_operator() -> JoinedOperator:
    code, arrays = prbs(7, 3, 0, GEOMETRY.span), Arrays(dtype="float64")
    volume = band_operator(GEOMETRY, code, TemporalBasis(GEOMETRY.span, 5, arrays), 3, 1)
    curves = np.linalg.qr(RNG.standard_normal((20, 3)))[0]
    patterns = band_operator(GEOMETRY, code, LearnedBasis(TemporalBasis(GEOMETRY.span, 20, arrays), curves))
    return JoinedOperator(LAYOUT, volume, patterns)


def test_the_joined_operator_and_its_transpose() -> None:
    operator, theta = joined_operator(), LAYOUT.joined(*parts())
    lines = RNG.standard_normal(GEOMETRY.lines_shape)
    there, back = float((operator.forward(theta) * lines).sum()), float(theta @ operator.adjoint(lines))
    assert there == pytest.approx(back, rel=1e-12)


def test_each_part_has_the_prior_and_the_sign_that_it_has_alone() -> None:
    first, second = parts()
    theta, weights = LAYOUT.joined(first, second), np.array([0.1, 0.2, 0.3])
    prior = JoinedPrior(LAYOUT, (VolumeTv(2.0), FrameTv(10, joint=True)), (0.5, weights))
    moved, still = LAYOUT.parts(prior.prox(theta, 0.4))
    np.testing.assert_allclose(moved, VolumeTv(2.0).prox(first, 0.2), atol=1e-14)
    np.testing.assert_allclose(still, FrameTv(10, joint=True).prox(second, 0.4 * weights), atol=1e-14)

    grids = [np.linalg.qr(RNG.standard_normal((30, len(part))))[0].T.copy() for part in (first, second)]

    def splits() -> list[SignSplit]:
        return [SignSplit(grid, part, None) for grid, part in zip(grids, (first, second), strict=True)]

    alone, together = splits(), JoinedSign(LAYOUT, *splits())
    for _ in range(2):
        together.advance(theta)
        for split, part in zip(alone, (first, second), strict=True):
            split.advance(part)
    copied = together.copied()
    together.rescale(0.5)
    for split in alone:
        split.rescale(0.5)
    for found, split in zip(LAYOUT.parts(together.pull()), alone, strict=True):
        np.testing.assert_allclose(found, split.pull(), atol=1e-13)
    assert not np.allclose(copied.pull(), together.pull())  # a state of its own


def test_without_priors_the_data_step_is_that_of_ridge_regression() -> None:
    """θ = argmin ½‖B·θ − y‖² + ρ/2·‖θ‖², where the scale weighs the volume's voxels more."""
    operator, rho = joined_operator(), 0.3
    lines = RNG.standard_normal(GEOMETRY.lines_shape)
    dense = np.stack([operator.forward(unit) for unit in np.eye(LAYOUT.shape[0])], axis=-1)
    dense = dense.reshape(lines.size, -1)
    exact = np.linalg.solve(dense.T @ dense + rho * np.eye(dense.shape[1]), dense.T @ lines.ravel())

    class Free:
        def advance(self, theta: np.ndarray) -> None: ...

        def pull(self) -> np.ndarray:
            return np.zeros(LAYOUT.shape)

    parameters = AdmmParameters(tv_penalty=rho / 2, sign_penalty=rho / 2, gradient_steps=400)
    basis = TemporalBasis(GEOMETRY.span, 20, Arrays(dtype="float64"))
    admm = Admm(operator, lines, LAYOUT.shape, basis, parameters, sign=Free())  # type: ignore[arg-type]
    np.testing.assert_allclose(admm._data_step(), exact, atol=1e-9)


def look(fast_lamps: int, slow_lamps: int = 0, faint: float = 0.0) -> tuple[np.ndarray, LearnedBasis]:
    """Coefficients of a ground, lamps and something that moves, in 32 slow cosines and eight fast ones."""
    kept = np.concatenate([np.arange(32), np.arange(60, 68)])
    basis = LearnedBasis(TemporalBasis(200, 100), np.eye(100)[:, kept])
    theta = np.zeros((40, 256))
    theta[0] = 90 * np.abs(RNG.standard_normal(256))
    for lamp in range(fast_lamps):
        theta[32 + 3 * lamp : 35 + 3 * lamp] += RNG.standard_normal((3, 1)) * RNG.standard_normal(256)
    for lamp in range(slow_lamps):
        theta[20 + 3 * lamp] += 20 * RNG.standard_normal(256)
    theta[:20] += RNG.standard_normal((20, 256))
    theta[32:] += faint * RNG.standard_normal((8, 256))
    return theta.reshape(40, 16, 16), basis


def test_the_patterns_of_fast_cosines_and_the_ground_are_lamps_and_the_rest_moves() -> None:
    theta, basis = look(2, 1, 0.05)
    found = find_lamps(theta, basis)
    assert [each.curves.shape[1] for each in found] == [3, 4, 5, 6]
    for each in found:
        lamps = np.tensordot(each.curves, each.patterns, axes=1)
        assert each.motion is not None
        np.testing.assert_allclose(lamps[:32] + each.motion, theta[:32], atol=1e-10)
        np.testing.assert_allclose(each.curves.T @ each.curves, np.eye(each.curves.shape[1]), atol=1e-10)
    # the slow lamp comes before what moves, which is weaker
    assert np.linalg.norm(found[0].motion[20]) > 10  # type: ignore[index]
    assert np.linalg.norm(found[1].motion[20]) < 2  # type: ignore[index]


def test_without_fast_lamps_there_are_none_beside_motion() -> None:
    assert find_lamps(*look(0, 2, 0.05)) == []
    theta, basis = look(2)
    slow = LearnedBasis(TemporalBasis(200, 100), np.eye(100)[:, :32])
    assert find_lamps(theta[:32], slow) == []
    dark = np.zeros_like(theta)
    assert find_lamps(dark, basis) == []


def test_a_refinement_keeps_both_parts_when_it_returns_continues_and_drops_a_pattern() -> None:
    given = record("leds_dot", 3, stages=8, lines=60)
    problem = build_problem(given.segment, 2, 1, hold_out=0.08)
    frames = given.segment.geometry.span
    theta = TemporalBasis(frames, 40).analyze(merge_video(given.light, 2, 1) / problem.scale)
    found = find_lamps(theta, TemporalBasis(frames, 40))[0]
    asked = given_for(given.segment, problem, (2, 1))
    refinement = beside_motion(asked, TemporalBasis(frames, 40), found)
    for _ in range(2 * ROUND):
        refinement.step()
    kept, video, lines = refinement.found, refinement.video(), refinement.predict()
    continued = refinement.with_problem(problem.with_all_samples())
    np.testing.assert_allclose(continued.video(), video, atol=1e-6)
    fewer = refinement.restricted(refinement.needed())
    for each in (refinement, continued, fewer):
        for _ in range(ROUND):
            each.step()
        assert np.isfinite(each.video()).all()
    refinement.return_to(kept)
    np.testing.assert_allclose(refinement.video(), video, atol=1e-6)
    np.testing.assert_allclose(refinement.predict(), lines, atol=1e-6)


@pytest.mark.parametrize(
    ("errors", "bound", "chosen"),
    [
        ((5.0, 3.0, 2.9, 1.0), 9.0, 1),  # one that is hardly better ends the search
        ((5.0, 3.0, 2.0, 1.0), 9.0, 3),
        ((5.0, 3.0, 3.5), 4.0, 1),
        ((5.0, 4.5), 4.0, None),
        ((), 4.0, None),
    ],
)
def test_the_number_of_patterns_rises_as_long_as_it_pays(
    errors: tuple[float, ...], bound: float, chosen: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(settling, "early_error", lambda _, each: errors[each])
    rivals = [lambda each=each: each for each in range(len(errors))]
    asked: Any = SimpleNamespace(clock=IterationClock(1))
    found = settling.better_than(asked, bound, rivals)  # type: ignore[arg-type]
    assert found == chosen


@pytest.mark.parametrize("seed", [81, 82])
def test_lamps_beside_a_dot_that_moves(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    given = record("leds_dot", seed, stages=32, lines=160)
    both = reconstruct(given.segment, 3, 1)
    assert both.parameters["motion_coefficients"] > 0
    monkeypatch.setattr(blinking, "find_lamps", lambda *_: [])
    alone = reconstruct(given.segment, 3, 1)
    assert "motion_coefficients" not in alone.parameters
    truth = given.truth(3, 1)
    quality = [psnr(each.video[each.trusted], truth) for each in (both, alone)]
    assert quality[0] > quality[1] + 2
    assert both.quality.prediction < 0.8 * alone.quality.prediction


def test_lamps_alone_have_nothing_beside_them() -> None:
    given = record("leds", 83, stages=32, lines=160, camera=CLEAN)
    assert "motion_coefficients" not in reconstruct(given.segment, 3, 1, error=False).parameters
