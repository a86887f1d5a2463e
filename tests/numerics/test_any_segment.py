"""Segments, voxels and options drawn at random: a finite video, or one of our errors; never another one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from acquire.codes import mix_seed, prbs
from acquire.errors import AcquireError
from acquire.forward import DualArm
from acquire.geometry import Geometry
from acquire.lines import Segment
from acquire.recon import reconstruct

TOP, BLACK = 4095.0, 100.0
FAULTS = (
    "none",
    "dark",
    "below black",
    "constant",
    "one sample",
    "clipped",
    "half lost",
    "a dead column",
    "a burst",
)


def record(geometry: Geometry, seed: int, noise: float) -> Segment:
    """A square that blinks and moves over a ramp, in the 12 bits of a camera."""
    rng, n = np.random.default_rng(seed), geometry.size
    code = prbs(31, mix_seed(seed, 31), 0, geometry.span)
    y, x = np.meshgrid(*[(np.arange(n) + 0.5) / n] * 2, indexing="ij")
    tau = np.linspace(0, 1, geometry.span)[:, None, None]
    light = rng.uniform(0, 1) * (1 + np.sin(2 * np.pi * rng.uniform(0, 9) * tau))
    at, side = rng.uniform(0, 1, 2), rng.uniform(0, 0.5)
    square = (abs(y - at[0]) < side) & (abs(x - at[1] - rng.uniform(-0.5, 0.5) * tau) < side)
    exact = DualArm(geometry, code).forward((x * rng.uniform(0, 1) + light * square).astype(np.float32))
    exact = BLACK + exact * (0.9 * (TOP - BLACK) / max(float(exact.max()), 1e-6))
    lines = np.clip(np.rint(exact + noise * rng.standard_normal(exact.shape)), 0, TOP).astype(np.uint16)
    return Segment(
        lines=lines,
        mask=lines < TOP,
        code=code,
        geometry=geometry,
        time_ns=np.arange(geometry.lines, dtype=np.int64) * 30_000,
        substep_ns=10_000.0,
        black_level_dn=BLACK,
    )


def damage(segment: Segment, fault: str, seed: int) -> Segment:
    rng, lines, mask = np.random.default_rng([seed, 1]), segment.lines.copy(), segment.mask.copy()
    _, count, pixels = lines.shape
    match fault:
        case "dark":
            lines[:] = BLACK
        case "below black":
            lines[:] = 0
        case "constant":
            lines[:] = 1000
        case "one sample":
            lines[:] = 0
            lines.flat[rng.integers(lines.size)] = 4000
        case "clipped":
            mask &= lines < np.median(lines)
        case "half lost":
            mask[:, rng.permutation(count)[: count // 2]] = False
        case "a dead column":
            lines[rng.integers(2), :, rng.integers(pixels)] = 0
        case "a burst":
            lines[:, rng.integers(count)] = 4000
    return replace(segment, lines=lines, mask=mask)


@given(data=st.data(), seed=st.integers(0, 2**31), fault=st.sampled_from(FAULTS))
@settings(max_examples=150, deadline=None)
def test_any_segment_is_solved_or_refused(data: st.DataObject, seed: int, fault: str) -> None:
    stages, substeps, count = (data.draw(st.integers(1, most)) for most in (8, 3, 24))
    geometry = Geometry(stages, substeps, count)
    noise = data.draw(st.sampled_from([0.0, 10.0, 300.0]))
    segment = damage(record(geometry, seed, noise), fault, seed)
    merges = data.draw(st.integers(1, geometry.size)), data.draw(st.integers(1, geometry.span))
    options = data.draw(
        st.fixed_dictionaries(
            {"preset": st.sampled_from(["fast", "best"])},
            optional={
                "budget_s": st.sampled_from([0.05, 0.5]),
                "bandwidth": st.sampled_from([1e-6, 0.1, 1.0]),
                "tv_weight": st.sampled_from([0.0, 1e-12, 1e6]),
                "dtype": st.just("float64"),
            },
        )
    )
    try:
        result = reconstruct(segment, *merges, refuse=False, **options)
    except AcquireError:
        return
    assert result.video.shape == geometry.video_shape(*merges)
    assert np.isfinite(result.video).all()
    assert result.video.min() >= 0
    assert np.isfinite(result.quality.misfit)


def test_a_single_voxel_is_solved_to_the_last_digit() -> None:
    """Its residual becomes so small that its square vanishes."""
    result = reconstruct(record(Geometry(1, 3, 2), 10, 0.0), 3, 7, "fast", refuse=False)
    assert np.isfinite(result.video).all()


def test_lines_that_do_not_determine_the_brightness_are_solved() -> None:
    geometry = Geometry(1, 3, 2)
    segment = damage(record(geometry, 8226, 0.0), "constant", 8226)
    assert np.isfinite(reconstruct(segment, 1, 1, "fast", refuse=False).video).all()


def test_curves_of_which_nothing_is_left_are_solved() -> None:
    """One bright sample among lines below the black level: the video becomes dark, and its curves 0."""
    segment = damage(record(Geometry(1, 1, 19), 19, 300.0), "one sample", 19)
    assert np.isfinite(reconstruct(segment, 1, 1, "best", refuse=False).video).all()


def test_a_spectrum_of_which_nothing_is_left_is_solved() -> None:
    """One bright sample of one line below the black level: the penalty of its energies overflowed."""
    segment = damage(record(Geometry(7, 1, 1), 1, 0.0), "one sample", 1)
    assert np.isfinite(reconstruct(segment, 6, 1, "fast", refuse=False).video).all()
