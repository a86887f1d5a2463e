"""The intensity of a still picture from its lines, against the light that made them."""

from __future__ import annotations

import numpy as np
import pytest

from acquire.errors import NumericsError, UsageError
from acquire.forward import DualArm
from acquire.geometry import Geometry
from acquire.lines import Segment
from acquire.recon.still import intensity

GEOMETRY = Geometry(6, 3, 40)


def lines_of(still, light, code):
    lines = DualArm(GEOMETRY, code, dtype=np.float64).forward(light[:, None, None] * still)
    return Segment(lines, np.ones(lines.shape, bool), code, GEOMETRY, np.zeros(GEOMETRY.lines, np.int64))


def test_light_comes_back_wherever_the_code_is_lit():
    generator = np.random.default_rng(3)
    code = generator.integers(0, 2, GEOMETRY.span).astype(np.uint8)
    still, light = generator.random((18, 18)), (np.arange(GEOMETRY.span) % 6 < 3).astype(float)
    found = intensity(lines_of(still, light, code), still)
    assert np.isnan(found[code == 0]).all()
    inner = GEOMETRY.trusted
    np.testing.assert_allclose(found[inner][code[inner] > 0], light[inner][code[inner] > 0], atol=2e-2)


def test_masked_lines_have_no_influence():
    generator = np.random.default_rng(4)
    code = np.ones(GEOMETRY.span, np.uint8)
    still, light = generator.random((18, 18)), generator.random(GEOMETRY.span)
    segment = lines_of(still, light, code)
    segment.lines[0, 7] = 1e9
    segment.mask[0, 7] = False
    found = intensity(segment, still)[GEOMETRY.trusted]
    assert np.corrcoef(found, light[GEOMETRY.trusted])[0, 1] > 0.98


def test_what_has_no_answer_is_refused():
    segment = lines_of(np.ones((18, 18)), np.ones(GEOMETRY.span), np.ones(GEOMETRY.span, np.uint8))
    with pytest.raises(UsageError, match="18, 18"):
        intensity(segment, np.ones((6, 6)))
    with pytest.raises(NumericsError):
        intensity(segment, np.zeros((18, 18)))
