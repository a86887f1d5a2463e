"""Columns that are defective, and columns that are bright because a lamp is there."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from acquire.codes import mix_seed, prbs
from acquire.forward import DualArm
from acquire.geometry import Geometry
from acquire.recon.outliers import outliers

GEOMETRY = Geometry(64, 3, 200)
SIZE = GEOMETRY.size
CODE = prbs(31, mix_seed(3, 31), 0, GEOMETRY.span)
ELECTRONS = 1000.0
"""Of a hot column's line."""
WHERE = np.hypot(*(np.indices((SIZE, SIZE)) / SIZE - np.array([[[0.4]], [[0.6]]])))


def lines_of(picture: NDArray[Any], brightest_e: float) -> NDArray[Any]:
    """Lines of a still in electrons, with shot noise and a read noise of 10."""
    rng = np.random.default_rng(5)
    still = np.broadcast_to(picture, (GEOMETRY.span, SIZE, SIZE)).astype(np.float32)
    exact = DualArm(GEOMETRY, CODE).forward(still).astype(np.float64)
    return np.asarray(
        rng.poisson(exact * (brightest_e / exact.max())) + 10 * rng.standard_normal(exact.shape)
    )


def hot_columns(lines: NDArray[Any]) -> list[list[int]]:
    found = outliers(lines, np.ones(lines.shape, np.bool_)).get("hot column", np.zeros(lines.shape, np.bool_))
    return [np.flatnonzero(arm.all(axis=0)).tolist() for arm in found]


def make_hot(lines: NDArray[Any], arm: int, column: int) -> None:
    lines[arm, :, column] += np.random.default_rng(column).poisson(ELECTRONS, GEOMETRY.lines)


@pytest.mark.parametrize("radius", [0.02, 0.03, 0.045, 0.06])
def test_a_small_lamp_on_dark_ground_is_no_defect(radius: float) -> None:
    """It was masked: of an arm's columns, nearly all were ten times darker than its own."""
    assert hot_columns(lines_of(radius > WHERE, 1e4)) == [[], []]


@pytest.mark.parametrize("axis", [0, 1])
def test_a_slit_that_is_narrow_in_one_arm_is_no_defect(axis: int) -> None:
    slit = np.zeros((SIZE, SIZE))
    np.moveaxis(slit, axis, 0)[90:96] = 1
    assert hot_columns(lines_of(slit, 1e4)) == [[], []]


def test_hot_columns_are_found_in_both_arms_and_beside_a_lamp() -> None:
    dim = lines_of(np.ones((SIZE, SIZE)), 40.0)
    for arm, column in ((0, 5), (1, 40)):
        make_hot(dim, arm, column)
    assert hot_columns(dim) == [[5], [40]]
    lamp = lines_of(WHERE < 0.03, 1e4)
    make_hot(lamp, 0, 5)
    assert hot_columns(lamp) == [[5], []]


@pytest.mark.parametrize("radius", [0.004, 0.008, 0.015])
def test_a_lamp_of_a_few_rows_has_no_spikes(radius: float) -> None:
    """Neighbouring lines share hardly any of its light: up to two fifths of what it lit were masked."""
    for brightest_e in (1e4, 1e6):
        lines = lines_of(radius > WHERE, brightest_e)
        assert outliers(lines, np.ones(lines.shape, np.bool_)) == {}


def test_spikes_are_found_in_many_lines_of_a_column_and_on_a_lamp() -> None:
    lines = lines_of(WHERE < 0.3, 1e4)
    wild = np.zeros(lines.shape, np.bool_)
    wild[0, 3::10, 20] = True  # a tenth of a column's lines
    wild[1, 50, 30] = wild[1, 120, 2] = True
    found = outliers(np.where(wild, 3e4, lines), np.ones(lines.shape, np.bool_))
    assert list(found) == ["spike"]
    assert (found["spike"] == wild).all()
