"""Contrast of the bars of a target, as Fig. 6c plots it."""

from __future__ import annotations

import numpy as np
import pytest

from acquire.evaluate.paper.bars import contrasts, last_resolved
from acquire.sim.targets import usaf_picture

GROUPS, FIELD_MM = (2, 3), 6.4


def test_a_sharp_target_is_resolved_and_a_blurred_one_is_not():
    sharp = usaf_picture((2, 3, 4, 5), 768, FIELD_MM)
    assert last_resolved(contrasts(sharp, FIELD_MM, GROUPS)) == "3/6"
    coarse = sharp.reshape(64, 12, 64, 12).mean(axis=(1, 3))
    contrast = contrasts(coarse, FIELD_MM, GROUPS)
    assert contrast["2/1"] > 0.3
    assert contrast["3/4"] < 0.1
    assert contrasts(np.ones((192, 192)), FIELD_MM, GROUPS)["2/1"] == pytest.approx(0, abs=1e-6)
