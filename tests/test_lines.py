"""Segments: lines in DN, and what they say of the scene."""

from __future__ import annotations

import numpy as np
import pytest

from acquire.geometry import Geometry
from acquire.lines import Segment

GEOMETRY = Geometry(3, 2, 4)
LIGHT = np.random.default_rng(0).random(GEOMETRY.lines_shape)
COLUMNS = np.arange(6.0).reshape(2, 3)


@pytest.mark.parametrize(
    ("black", "gain"),
    [(5.0, 2.0), ((5.0, 7.0), (2.0, 3.0)), (10 + COLUMNS, 2 + COLUMNS), (5.0, 2 + COLUMNS)],
)
def test_samples_are_the_light_whoever_has_an_offset_and_a_gain(black: object, gain: object) -> None:
    beside = [np.asarray(each) if np.ndim(each) < 2 else np.asarray(each)[:, None] for each in (black, gain)]
    offset, factor = (each.reshape(-1, 1, 1) if each.ndim == 1 else each for each in beside)
    mask = np.ones(GEOMETRY.lines_shape, bool)
    mask[1, 2] = False
    segment = Segment(
        lines=offset + factor * LIGHT,
        mask=mask,
        code=np.ones(GEOMETRY.span, np.uint8),
        geometry=GEOMETRY,
        time_ns=np.arange(4),
        black_level_dn=black,  # type: ignore[arg-type]
        responsivity_dn=gain,  # type: ignore[arg-type]
    )
    np.testing.assert_allclose(segment.samples(np.float64), np.where(mask, LIGHT, 0), atol=1e-12)
