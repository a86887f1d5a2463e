"""The split of the sign against its definition, with and without compiled loops."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from acquire.arrays import Arrays
from acquire.recon import sign
from acquire.recon.basis import LearnedBasis, TemporalBasis
from acquire.recon.sign import SignSplit

SHAPES = [(4, 40, (6, 7)), (sign.FEW, 20, (45, 45)), (3, 130, (2, 1500)), (24, 24, (5, 5))]
"""Coefficients, instants, frames: of one block of the loops, of several, wider than a block; for a BLAS."""


def grid_of(count: int, instants: int, seed: int = 0) -> NDArray[Any]:
    curves = np.linalg.qr(np.random.default_rng(seed).standard_normal((instants, count)))[0]
    return LearnedBasis(TemporalBasis(instants, instants, Arrays(dtype="float64")), curves).matrix()


def some(shape: tuple[int, ...], seed: int) -> NDArray[Any]:
    return np.random.default_rng(seed).standard_normal(shape)


@pytest.mark.parametrize(("count", "instants", "frame"), SHAPES)
@pytest.mark.parametrize("lit", [False, True])
def test_split_and_multiplier_follow_their_definition(
    count: int, instants: int, frame: tuple[int, int], lit: bool
) -> None:
    grid, start = grid_of(count, instants), some((count, *frame), 1)
    background = some(start.shape, 2) if lit else None
    split = SignSplit(grid, start, background)
    known = 0.0 if background is None else np.tensordot(grid.T, background, axes=1)
    v, multiplier = np.maximum(np.tensordot(grid.T, start, axes=1) + known, 0), 0.0
    for seed, factor in enumerate((1.0, 0.5, 3.0), 3):
        pulled = np.tensordot(grid, v - multiplier - known, axes=1)
        np.testing.assert_allclose(split.pull(), pulled, atol=1e-11)
        theta = some(start.shape, seed)
        light = np.tensordot(grid.T, theta, axes=1) + known + multiplier
        v, multiplier = np.maximum(light, 0), np.minimum(light, 0)
        split.advance(theta)
        split.rescale(factor)
        multiplier = factor * multiplier
        if seed == 4:
            grid = grid_of(count, instants, seed)
            known = 0.0 if background is None else np.tensordot(grid.T, background, axes=1)
            split.rebase(grid, start.shape)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_loops_and_blas_agree(monkeypatch: pytest.MonkeyPatch, dtype: str) -> None:
    grid, start, theta = grid_of(5, 300).astype(dtype), some((5, 70, 70), 1), some((5, 70, 70), 2)
    pulled = []
    for few in (5, 4):
        monkeypatch.setattr(sign, "FEW", few)
        split = SignSplit(grid, start.astype(dtype), None)
        split.advance(theta.astype(dtype))
        split.rescale(0.7)
        split.advance(start.astype(dtype))
        pulled.append(split.pull())
    assert pulled[0].dtype == dtype
    np.testing.assert_allclose(*pulled, atol=1e-12 if dtype == "float64" else 2e-5)


def test_copies_go_their_own_ways() -> None:
    grid, start = grid_of(3, 30), some((3, 4, 4), 1)
    split = SignSplit(grid, start, None)
    split.advance(some(start.shape, 2))
    split.rescale(2.0)
    other, before = split.copied(), split.pull()
    np.testing.assert_array_equal(other.pull(), before)
    other.advance(start)
    np.testing.assert_array_equal(split.pull(), before)
    assert np.abs(other.pull() - before).max() > 0.1
