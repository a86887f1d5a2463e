"""Crossings of a level, against a walk through the means one by one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from acquire.flags import LineFlag
from acquire.stream.threshold import Threshold, ThresholdPlan


def crossings(levels: list[int], block_lines: int, damaged: Sequence[int] = (), **plan: object) -> list[int]:
    given = {"level_dn": 50.0, "hysteresis_dn": 10.0, "rising": True, "average_lines": 1}
    threshold = Threshold(ThresholdPlan("a", **(given | plan)))
    pixels = np.repeat(np.array(levels, np.uint16)[:, None], 100, axis=1)
    flags = np.zeros(len(levels), np.uint16)
    flags[list(damaged)] = LineFlag.INCOMPLETE
    found: list[int] = []
    for at in range(0, len(levels), block_lines):
        part = slice(at, at + block_lines)
        found += threshold.crossings(1000 + at, pixels[part], flags[part])
    return found


def test_noise_at_the_level_is_one_event() -> None:
    assert crossings([0, 49, 50, 49, 51, 45, 50, 41, 60], 4) == [1002]
    assert crossings([0, 50, 39, 50, 40, 50], 4) == [1001, 1003]


def test_what_was_beyond_from_the_start_is_none() -> None:
    assert crossings([80, 90, 20, 60], 2) == [1003]


def test_falling() -> None:
    assert crossings([80, 50, 45, 59, 61, 50], 3, rising=False) == [1001, 1005]


def test_means_of_lines() -> None:
    assert crossings([0, 0, 90, 0, 90, 90], 6, average_lines=2) == [1004]
    assert crossings([0, 0, 90, 0, 90], 5, average_lines=2) == [1004]  # what remains counts, too


def test_lines_without_an_image_cross_nothing() -> None:
    assert crossings([0, 90, 0, 0, 90, 0], 3, damaged=[1]) == [1004]
    assert crossings([90, 0, 0, 90, 90, 90], 6, damaged=[0], average_lines=2) == [1004]
    assert crossings([0, 40, 50, 90], 4, damaged=range(4)) == []


@given(st.lists(st.integers(0, 100), max_size=60), st.integers(1, 20), st.booleans())
def test_blocks_make_no_difference(levels: list[int], block_lines: int, rising: bool) -> None:
    beyond: bool | None = None
    expected = []
    for number, level in enumerate(levels):
        above = (level - 50) if rising else (50 - level)
        if above >= 0:
            if beyond is False:
                expected.append(1000 + number)
            beyond = True
        elif beyond is None or above < -10:
            beyond = False
    assert crossings(levels, block_lines, rising=rising) == expected
