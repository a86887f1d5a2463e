"""Level, saturation and sharpness of lines, on textures under random codes with a camera's noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from acquire.camera.gauge import Gauge
from acquire.lines import LineFlag

BLACK, WHITE = 30.0, 4095
DN_PER_E = 0.1


def lines_of(texture: np.ndarray, light: float, seed: int) -> np.ndarray:
    """Lines that weigh the texture's rows at random, with shot and read noise, in DN."""
    rng = np.random.default_rng(seed)
    codes = rng.integers(0, 2, (512, len(texture)))
    seen = codes @ texture
    electrons = rng.poisson(seen * light / seen.mean() / DN_PER_E) + rng.normal(0, 15, seen.shape)
    return np.clip(np.rint(electrons * DN_PER_E + BLACK), 0, WHITE).astype(np.uint16)


def reading(lines: np.ndarray, flags: np.ndarray | None = None, lost: int = 0):
    gauge = Gauge(BLACK, WHITE)
    gauge.keep(gauge.look(lines, np.zeros(len(lines), np.uint16) if flags is None else flags, lost))
    return gauge.take()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("light", [150.0, 1200.0])
def test_the_focus_number_is_largest_in_focus(seed: int, light: float) -> None:
    texture = np.random.default_rng(seed).random((64, 64)) < 0.3
    found = []
    for blur in (0.0, 0.4, 0.8, 1.6, 3.2):
        seen = reading(lines_of(gaussian_filter(texture.astype(float), blur), light, seed))
        assert seen.level == pytest.approx(light / (WHITE - BLACK), rel=0.01)
        found.append(seen.focus)
    assert found == sorted(found, reverse=True)
    assert found[0] > 1.1 * found[1]


def test_saturated_missing_and_dark_lines() -> None:
    lines = np.full((64, 32), 1030, np.uint16)
    lines[:16, :8] = WHITE
    flags = np.zeros(64, np.uint16)
    flags[48:] = LineFlag.MISSING
    seen = reading(lines, flags, lost=5)
    assert (seen.lines, seen.lost, seen.brightest) == (48, 21, 1.0)
    assert seen.saturated == pytest.approx(16 * 8 / (48 * 32))
    assert seen.focus is not None
    dark = reading(np.full((64, 32), 31, np.uint16))
    assert (dark.focus, dark.saturated) == (None, 0.0)
    assert reading(lines[:0]).level is None


def test_what_is_not_kept_does_not_count() -> None:
    gauge = Gauge(BLACK, WHITE)
    gauge.look(np.full((64, 32), WHITE, np.uint16), np.zeros(64, np.uint16))
    assert gauge.take().lines == 0
