"""The same solvers on another array library.

array-api-strict has the standard's operations and no other, and a device whose arrays refuse to meet those of
the host: what passes here neither calls numpy behind the solver's back nor copies between host and device.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace

import array_api_strict
import numpy as np
import pytest
from hypothesis import given, settings
from recon_cases import cases, given_for

from acquire import arrays
from acquire.alignment import Alignment
from acquire.arrays import Arrays, dot, host, open_arrays
from acquire.blur import Blur
from acquire.codes import mix_seed, prbs
from acquire.errors import UsageError
from acquire.evaluate.metrics import psnr
from acquire.forward import DualArm, GatheredArms, merge_video
from acquire.geometry import Geometry
from acquire.lines import Segment
from acquire.recon import HaarShrink, Reconstruction, reconstruct
from acquire.recon.band import BandOperator
from acquire.recon.basis import TemporalBasis
from acquire.recon.beside_motion import beside_motion
from acquire.recon.patterns import ROUND, Refinement, find_patterns
from acquire.recon.problem import build_problem
from acquire.recon.tv import FrameTv
from acquire.sim.procedural import record

GEOMETRY = Geometry(16, 3, 80)
DEVICE = array_api_strict.Device("device1")
DOUBLE = open_arrays(dtype="float64")
STRICT = Arrays(array_api_strict, DEVICE, "float64")
ROUNDING = 1e-9
"""Relative tolerance in float64 over ten iterations."""


@pytest.fixture(params=["strict", pytest.param("gpu", marks=pytest.mark.needs_gpu)])
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """That device, and a GPU if there is one, by the name that `reconstruct` takes."""
    monkeypatch.setitem(arrays.DEVICES, "strict", lambda: (array_api_strict, DEVICE))
    return str(request.param)


@pytest.fixture(scope="module")
def segment() -> Segment:
    """Two blinking squares, with some missing samples."""
    code = prbs(64, mix_seed(5, 64), 0, GEOMETRY.span)
    mask = np.ones(GEOMETRY.lines_shape, bool)
    mask[0, 30], mask[1, 5, 3] = False, False
    return Segment(
        lines=DualArm(GEOMETRY, code).forward(scene()),
        mask=mask,
        code=code,
        geometry=GEOMETRY,
        time_ns=np.arange(GEOMETRY.lines, dtype=np.int64) * 30_000,
        substep_ns=10_000.0,
    )


def scene() -> np.ndarray:
    n, t = GEOMETRY.size, np.arange(GEOMETRY.span)
    video = np.zeros((GEOMETRY.span, n, n), np.float32)
    video[:, 6:24, 6:24] = (0.6 + 0.3 * np.sin(2 * np.pi * t / 140))[:, None, None]
    video[:, 30:42, 12:24] += (0.5 + 0.4 * np.sin(2 * np.pi * t / 60))[:, None, None]
    return video


def error(result: Reconstruction) -> float:
    """Relative error against the truth at N_m = 3."""
    truth = merge_video(scene(), 3, 1)[result.trusted]
    return float(np.linalg.norm(result.video[result.trusted] - truth) / np.linalg.norm(truth))


def difference(a: Reconstruction, b: Reconstruction) -> float:
    return float(np.linalg.norm(a.video - b.video) / np.linalg.norm(b.video))


@settings(max_examples=60, deadline=None)
@given(cases())
def test_the_gathered_shear_is_the_compiled_one(case: tuple[Geometry, int, int, int, int]) -> None:
    g, N_m, T_m, _, seed = case
    rng = np.random.default_rng(seed)
    code = rng.integers(0, 2, g.span).astype(np.uint8)
    off = Alignment(*rng.uniform(-2, 2, 2), *rng.uniform(-9, 9, 1)) if seed % 2 else None
    blur = Blur((0.7, 0.2), (1.1, 0.9), veil=(0.1, 0.02)) if seed % 4 > 1 else None
    compiled = DualArm(g, code, N_m, T_m, np.float64, off, blur)
    gathered = GatheredArms(g, code, N_m, T_m, STRICT, off, blur)
    video, lines = rng.standard_normal(compiled.video_shape), rng.standard_normal(g.lines_shape)
    there = STRICT.asarray(video), STRICT.asarray(lines)
    forward, adjoint = gathered.forward(there[0]), gathered.adjoint(there[1])
    np.testing.assert_allclose(host(forward), compiled.forward(video), atol=1e-11)
    np.testing.assert_allclose(host(adjoint), compiled.adjoint(lines), atol=1e-11)
    assert float(dot(forward, there[1])) == pytest.approx(float(dot(there[0], adjoint)), abs=1e-9)


@settings(max_examples=30, deadline=None)
@given(cases())
def test_the_band_operator_and_its_transpose(case: tuple[Geometry, int, int, int, int]) -> None:
    g, N_m, T_m, K, seed = case
    rng = np.random.default_rng(seed)
    code = rng.integers(0, 2, g.span).astype(np.uint8)
    frames = g.video_shape(N_m, T_m)[0]
    off = Alignment(*rng.uniform(-2, 2, 2), *rng.uniform(-9, 9, 1)) if seed % 2 else None
    blur = Blur((0.7, 0.2), (1.1, 0.9), veil=(0.1, 0.02)) if seed % 4 > 1 else None
    there = BandOperator(g, code, TemporalBasis(frames, K, STRICT), N_m, T_m, alignment=off, blur=blur)
    here = BandOperator(g, code, TemporalBasis(frames, K, DOUBLE), N_m, T_m, alignment=off, blur=blur)
    theta, lines = rng.standard_normal(here.theta_shape), rng.standard_normal(g.lines_shape)
    np.testing.assert_allclose(host(there.forward(STRICT.asarray(theta))), here.forward(theta), atol=1e-11)
    np.testing.assert_allclose(host(there.adjoint(STRICT.asarray(lines))), here.adjoint(lines), atol=1e-11)


@pytest.mark.parametrize("joint", [False, True])
@pytest.mark.parametrize("weight", [0.0, 1e-30, 0.1, np.array([0.0, 0.05, 3.0]), 1e8])
def test_total_variation_is_that_of_the_compiled_loops(weight: float | np.ndarray, *, joint: bool) -> None:
    """It is compared over three calls, each of which continues the dual field of the last."""
    frames = np.random.default_rng(2).random((3, 9, 7))
    here, there = FrameTv(10, joint=joint), FrameTv(10, joint=joint)
    given = weight if isinstance(weight, float) else STRICT.asarray(weight)
    assert there.value(STRICT.asarray(frames)) == pytest.approx(here.value(frames))
    for shift in (0.0, 0.1, 0.2):
        moved = frames + shift * frames[::-1]
        found = there.prox(STRICT.asarray(moved), given)
        np.testing.assert_allclose(host(found), here.prox(moved, weight), atol=1e-12)


@pytest.mark.parametrize("solver", ["admm", "twist", "twist-band"])
@pytest.mark.parametrize("merges", [(3, 1), (1, 60)])
def test_a_whole_reconstruction(device: str, segment: Segment, solver: str, merges: tuple[int, int]) -> None:
    options = {"solver": solver, "iterations": 10, "bandwidth": 0.2, "dtype": "float64"}
    here = reconstruct(segment, *merges, **options)
    there = reconstruct(segment, *merges, **options, device=device)
    assert difference(there, here) < ROUNDING
    assert there.quality.misfit == pytest.approx(here.quality.misfit, rel=1e-6)


def test_every_stage_of_the_default(device: str, segment: Segment) -> None:
    """The bandwidth, the cosines, then patterns and curves.

    Over so many steps rounding grows to what a change of the samples by 1e-7 does: both are right as far.
    """
    for where in ("cpu", device):
        result = reconstruct(segment, 3, 1, iterations=120, device=where)
        assert "patterns" in result.parameters
        assert result.video.dtype == np.float32
        assert error(result) < 0.2


@pytest.mark.parametrize(("scene", "least_db"), [("flicker", 24), ("leds", 26)])
def test_every_trial_of_the_choice(device: str, scene: str, least_db: float) -> None:
    """Still, volumes, free brightness and a glance at the cosines: the choice is the same everywhere.

    Patterns and curves are not to the last digit, as above.
    """
    given = record(scene, 3, stages=8, lines=60)
    results = [reconstruct(given.segment, 2, 1, "fast", dtype="float64", device=on) for on in ("cpu", device)]
    assert results[0].parameters["prior"] == results[1].parameters["prior"]
    for result in results:
        assert psnr(result.video[result.trusted], given.truth(2, 1)) > least_db


@pytest.mark.parametrize("kind", [Refinement, beside_motion])
def test_patterns_and_curves(segment: Segment, kind: Callable[..., Refinement]) -> None:
    """Two rounds from the same patterns, alone and beside a volume."""
    noise = 1e-2 * np.random.default_rng(0).standard_normal((GEOMETRY.span, 16, 16))
    theta = TemporalBasis(GEOMETRY.span, 32, DOUBLE).analyze(merge_video(scene(), 3, 1) + noise)
    found, videos = find_patterns(theta), []
    assert found is not None
    if kind is beside_motion:
        found = replace(found, motion=0.1 * theta[:12])
    for where in (DOUBLE, STRICT):
        problem = build_problem(segment, 3, 1, hold_out=0.02, arrays=where)
        cosines = TemporalBasis(GEOMETRY.span, 32, where)
        refinement = kind(given_for(segment, problem, (3, 1)), cosines, found)
        for _ in range(2 * ROUND):
            refinement.step()
        videos.append(refinement.video())
        assert problem.prediction_error(refinement.predict()) < 0.1
    np.testing.assert_allclose(*videos, atol=1e-7)


def test_a_warm_start_and_a_denoiser(device: str, segment: Segment) -> None:
    first = reconstruct(segment, 3, 1, iterations=5, bandwidth=0.2)
    options = {
        "iterations": 5,
        "bandwidth": 0.2,
        "initial": first.video,
        "denoiser": HaarShrink(2),
        "dtype": "float64",
    }
    here, there = (reconstruct(segment, 3, 1, **options, device=where) for where in ("cpu", device))
    assert difference(there, here) < ROUNDING


def test_double_precision(segment: Segment) -> None:
    """float32 is that of float64 up to its rounding, and the whole way is computed in what is asked."""
    options = {"iterations": 10, "bandwidth": 0.2}
    single, double = (reconstruct(segment, 3, 1, **options, dtype=kind) for kind in ("float32", "float64"))
    assert (single.video.dtype, double.video.dtype) == (np.float32, np.float64)
    assert single.parameters["dtype"] == "float32"
    assert 1e-8 < difference(single, double) < 1e-4
    with pytest.raises(UsageError, match="dtype 'float16'"):
        reconstruct(segment, 3, 1, dtype="float16")


@pytest.mark.parametrize("solver", ["admm", "twist", "twist-band"])
def test_every_solver_is_as_good_in_either_precision(segment: Segment, solver: str) -> None:
    single, double = (
        reconstruct(segment, 3, 1, solver=solver, iterations=100, dtype=kind)
        for kind in ("float32", "float64")
    )
    assert double.video.dtype == np.float64
    assert error(single) == pytest.approx(error(double), rel=0.1, abs=0.05)


def test_devices_that_are_not_there(monkeypatch: pytest.MonkeyPatch, segment: Segment) -> None:
    with pytest.raises(UsageError, match="device 'tpu'"):
        reconstruct(segment, 3, 1, device="tpu")
    monkeypatch.setitem(sys.modules, "cupy", None)
    with pytest.raises(UsageError, match="needs CuPy") as refused:
        reconstruct(segment, 3, 1, device="gpu")
    assert "tdi-acquire[gpu]" in str(refused.value.hint)
