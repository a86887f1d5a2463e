"""Fig. 9's table from a video of four lamps: they are identified by their light alone."""

from __future__ import annotations

import numpy as np
import pytest

from acquire.evaluate.paper.fig9_recorded import _lamps, _rows

INTERVAL_S = 1e-5
FREQUENCIES_HZ = (5000.0, 2500.0, 1000.0, 0.0)


def video(order: tuple[int, ...], seed: int) -> np.ndarray:
    """A lamp in every quarter of 32 × 32 voxels, in this order, with noise and a veil."""
    rng = np.random.default_rng(seed)
    t = np.arange(598) * INTERVAL_S
    frames = 0.02 + 0.05 * rng.standard_normal((598, 32, 32))
    for place, lamp in enumerate(order):
        hz = FREQUENCIES_HZ[lamp]
        swing = 0.4 if hz else 0.0
        light = 0.5 + swing * np.sin(2 * np.pi * hz * t + rng.uniform(0, 6))
        row, column = 16 * (place // 2), 16 * (place % 2)
        frames[:, row + 4 : row + 12, column + 5 : column + 11] += light[:, None, None]
    return frames


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 2, 1, 0), (1, 3, 0, 2)])
def test_lamps_are_identified_by_their_light_wherever_they_are(order: tuple[int, ...]) -> None:
    lamps = list(_lamps(video(order, 5), INTERVAL_S))
    names = ("x", "triangle", "circle", "equals")
    assert [lamp.name for lamp in lamps] == [names[lamp] for lamp in order]
    for lamp, known in zip(lamps, order, strict=True):
        assert lamp.fit.frequency_hz == pytest.approx(FREQUENCIES_HZ[known], abs=5)
    rows = {row.what: row.ours for row in _rows(lamps)}
    assert "not found" not in rows.values()
    assert rows["equals: constant"].startswith("constant, ripple")


def test_dark_lamps_and_wrong_frequencies_are_reported() -> None:
    frames = video((0, 0, 2, 3), 6)
    frames[:, 16:, 16:] = 0.0
    t = np.arange(598) * INTERVAL_S
    frames[:, 4:12, 5:11] = 0.5 + 0.4 * np.sin(2 * np.pi * 3300.0 * t)[:, None, None]
    rows = {row.what: row.ours for row in _rows(list(_lamps(frames, INTERVAL_S)))}
    assert rows["equals: constant"] == "not found"
    assert rows["upper left: none of these"].startswith("3300")
    assert rows["x: 5000 Hz"].endswith("upper right")


@pytest.mark.parametrize("light", [0.0, -0.1])
def test_a_dark_field_has_no_lamps(light: float) -> None:
    assert list(_lamps(np.full((598, 32, 32), light), INTERVAL_S)) == []
