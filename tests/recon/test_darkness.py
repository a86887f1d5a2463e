"""A dark ground about lamps: what is held dark, and that the lines get back what is not."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from acquire.arrays import Arrays
from acquire.codes import prbs
from acquire.evaluate.metrics import psnr
from acquire.geometry import Geometry
from acquire.recon import reconstruct, settling
from acquire.recon.band import band_operator
from acquire.recon.basis import LearnedBasis, TemporalBasis
from acquire.recon.darkness import LitPixels, gains_darkness, lit_pixels, with_light_missing
from acquire.recon.patterns import PATTERNS_ALONE, Patterns
from acquire.sim.procedural import CameraNoise, record

GEOMETRY = Geometry(stages=8, substeps=3, lines=60)
N = GEOMETRY.size
ARRAYS = Arrays(dtype="float64")
LAMP, FAINT = (slice(2, 8), slice(3, 9)), (slice(15, 18), slice(17, 20))
NOISE = 2e-3


def curves() -> NDArray[np.float64]:
    basis = TemporalBasis(GEOMETRY.span, 20, ARRAYS)
    instants = np.arange(GEOMETRY.span)
    both = np.stack([np.ones(GEOMETRY.span), np.sin(2 * np.pi * 5 * instants / GEOMETRY.span)])
    return np.linalg.qr(np.asarray(basis.analyze(both[:, :, None].transpose(1, 2, 0))).reshape(20, 2))[0]


def operator() -> Any:
    code, basis = prbs(7, 3, 0, GEOMETRY.span), TemporalBasis(GEOMETRY.span, 20, ARRAYS)
    return band_operator(GEOMETRY, code, LearnedBasis(basis, curves()))


def lamp(place: tuple[slice, slice], level: float) -> NDArray[np.float64]:
    patterns = np.zeros((2, N, N))
    patterns[0][place], patterns[1][place] = level, level / 2
    return patterns


def test_a_lamp_and_the_pixels_beside_it_are_lit() -> None:
    ground = np.full((2, N, N), 0.02)
    lit = lit_pixels(Patterns(curves(), lamp(LAMP, 1) + ground))
    expected = np.zeros((N, N), np.bool_)
    expected[1:9, 2:10] = True
    corners = [(1, 2), (1, 9), (8, 2), (8, 9)]
    expected[tuple(np.transpose(corners))] = False
    np.testing.assert_array_equal(lit, expected)


def test_the_operator_of_lit_pixels_and_its_transpose() -> None:
    rng, found = np.random.default_rng(1), Patterns(curves(), lamp(LAMP, 1))
    lit = rng.random((N, N)) < 0.4
    unknowns = LitPixels(PATTERNS_ALONE, lit, ARRAYS)
    held, theta = unknowns.operator(operator(), found), rng.standard_normal((2, N, N))
    lines = rng.standard_normal(GEOMETRY.lines_shape)
    np.testing.assert_allclose(held.forward(theta), operator().forward(theta * lit), rtol=1e-12)
    there, back = float((held.forward(theta) * lines).sum()), float((theta * held.adjoint(lines)).sum())
    assert there == pytest.approx(back, rel=1e-12)
    assert not np.any(held.adjoint(lines)[:, ~lit])
    np.testing.assert_array_equal(unknowns.unstacked(theta, found).patterns, theta * lit)


def missing(truth: NDArray[np.float64], explained: NDArray[np.float64]) -> NDArray[np.bool_]:
    """The pixels that are lit beside the lamp's, for noisy lines of the truth, partly explained."""
    forward, rng = operator().forward, np.random.default_rng(2)
    exact = forward(truth)
    samples = exact + NOISE * np.abs(exact).max() * rng.standard_normal(exact.shape)
    problem = SimpleNamespace(samples=samples, weight=np.ones_like(samples))
    refinement: Any = SimpleNamespace(predict=lambda: forward(explained), taken_back=operator().adjoint)
    given: Any = SimpleNamespace(problem=problem)
    lit = lit_pixels(Patterns(curves(), lamp(LAMP, 1)))
    return with_light_missing(given, refinement, lit) & ~lit


def test_noise_lights_next_to_nothing() -> None:
    assert missing(lamp(LAMP, 1), lamp(LAMP, 1)).mean() < 0.03


def test_a_faint_lamp_that_is_held_dark_is_lit_again() -> None:
    lit = missing(lamp(LAMP, 1) + lamp(FAINT, 0.05), lamp(LAMP, 1))
    assert lit[FAINT].all()


def test_a_dim_ground_is_lit_again() -> None:
    ground = np.zeros((2, N, N))
    ground[0] = 0.02
    lit = missing(lamp(LAMP, 1) + ground, lamp(LAMP, 1))
    assert lit.mean() > 0.6


def test_only_more_darkness_is_tried() -> None:
    lit = np.zeros((N, N), np.bool_)
    lit[: N // 2] = True
    assert gains_darkness(PATTERNS_ALONE, lit)
    assert not gains_darkness(PATTERNS_ALONE, np.ones((N, N), np.bool_))
    assert not gains_darkness(LitPixels(PATTERNS_ALONE, lit, ARRAYS), lit)


def test_lamps_in_noise_gain_by_a_dark_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    recorded = record("leds", 84, stages=32, lines=160, camera=CameraNoise(1e4))
    truth = recorded.truth(3, 1)

    def quality() -> tuple[float, dict[str, Any]]:
        result = reconstruct(recorded.segment, 3, 1)
        return psnr(result.video[result.trusted], truth), result.parameters

    dark, facts = quality()
    assert 0.3 < facts["dark_share"] < 1
    monkeypatch.setattr(settling, "_on_dark_ground", lambda _given, refinement, _enough: refinement)
    free, facts = quality()
    assert "dark_share" not in facts
    # By 1.9 dB when this was written; other seeds gain less, and one of five lost 0.6 dB.
    assert dark > free + 0.5
