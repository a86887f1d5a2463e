"""Parts of blocks; segments: lines in DN, and their conversion to the scene's units."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.errors import UsageError
from acquire.forward import DualArm
from acquire.geometry import Geometry
from acquire.lines import LineBlock, Segment, merged
from acquire.noise import Noise

GEOMETRY = Geometry(3, 2, 4)
LIGHT = np.random.default_rng(0).random(GEOMETRY.lines_shape)
COLUMNS = np.arange(6.0).reshape(2, 3)


@given(first=st.integers(0, 20), end=st.integers(0, 20) | st.just(1 << 62))
def test_a_part_of_a_block_is_its_lines_within_the_range(first: int, end: int) -> None:
    line = np.arange(5, 12)
    block = LineBlock(5, np.repeat(line[:, None], 3, axis=1), line.astype(np.uint16))
    part = block.part(first, end)
    inside = [number for number in line.tolist() if first <= number < end]
    assert part.flags.tolist() == part.pixels[:, 0].tolist() == inside
    assert len(part) == part.end_line - part.first_line == len(inside)
    if inside:
        assert part.first_line == inside[0]
        assert np.shares_memory(part.pixels, block.pixels)


@pytest.mark.parametrize(
    ("black", "gain"),
    [(5.0, 2.0), ((5.0, 7.0), (2.0, 3.0)), (10 + COLUMNS, 2 + COLUMNS), (5.0, 2 + COLUMNS)],
)
def test_samples_are_the_light_for_any_shape_of_offset_and_gain(black: object, gain: object) -> None:
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


M, S, LINES = 4, 3, 10
RAW, MERGED = Geometry(M * S, 1, S * LINES), Geometry(M, S, LINES)
CODE = np.random.default_rng(1).integers(0, 2, MERGED.span).astype(np.uint8)
SCENE = np.random.default_rng(2).random((MERGED.span, M * S, M * S))


def raw(**changes: object) -> Segment:
    light = DualArm(RAW, CODE, dtype=np.float64).forward(SCENE)
    facts = {
        "lines": np.rint(20 + 50 * light).astype(np.uint16),
        "mask": np.ones(RAW.lines_shape, bool),
        "code": CODE,
        "geometry": RAW,
        "time_ns": 100 * np.arange(S * LINES),
        "first_line": 6,
        "black_level_dn": 20.0,
        "responsivity_dn": 50.0,
    }
    return Segment(**(facts | changes))  # type: ignore[arg-type]


def test_merged_lines_are_those_of_a_sensor_with_intra_line_steps() -> None:
    """Eq. (1) with S = 3 follows from Eq. (1) with S = 1, in whole DN."""
    assert RAW.span == MERGED.span
    found = merged(raw(), S)
    expected = DualArm(MERGED, CODE, dtype=np.float64).forward(SCENE)
    np.testing.assert_allclose(found.samples(np.float64), expected, atol=9 * 0.5 / 50)
    assert (found.geometry, found.first_line, found.black_level_dn) == (MERGED, 2, 180.0)
    assert found.lines.dtype == np.uint32
    np.testing.assert_array_equal(found.time_ns, 300 * np.arange(LINES))
    np.testing.assert_array_equal(found.frame_time_ns(1), raw().frame_time_ns(1))


def test_columns_are_corrected_before_they_are_added_up() -> None:
    gain = 50 * np.random.default_rng(3).uniform(0.9, 1.1, (2, M * S))
    black = np.random.default_rng(4).uniform(10, 30, (2, M * S))
    light = DualArm(RAW, CODE, dtype=np.float64).forward(SCENE)
    segment = raw(lines=black[:, None] + gain[:, None] * light, black_level_dn=black, responsivity_dn=gain)
    expected = DualArm(MERGED, CODE, dtype=np.float64).forward(SCENE)
    np.testing.assert_allclose(merged(segment, S).samples(np.float64), expected, atol=1e-9)


def test_a_merged_sample_needs_all_of_its_raw_ones() -> None:
    mask = np.ones(RAW.lines_shape, bool)
    mask[1, 4, 7] = False
    found = merged(raw(mask=mask), S).mask
    assert not found[1, 1, 2]
    assert found.sum() == found.size - 1


INTRA_LINE = {
    "geometry": MERGED,
    "lines": np.zeros(MERGED.lines_shape),
    "mask": np.ones(MERGED.lines_shape, bool),
    "time_ns": np.arange(LINES),
}


@pytest.mark.parametrize("changes", [{"first_line": 7}, INTRA_LINE])
def test_segments_that_cannot_be_merged_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="cannot be merged"):
        merged(raw(**changes), S)


OF_COLUMNS = np.arange(2 * RAW.stages, dtype=float).reshape(2, -1) + 1


def test_columns_keep_their_corrections_when_arms_are_turned() -> None:
    segment = raw(responsivity_dn=OF_COLUMNS, black_level_dn=(3.0, 5.0), noise=Noise((0.1, 0.2), (1.0, 2.0)))
    for arm in (0, 1):
        turned = segment.mirrored(arm)
        np.testing.assert_array_equal(turned.samples()[arm], segment.samples()[arm, :, ::-1])
        np.testing.assert_array_equal(turned.samples()[1 - arm], segment.samples()[1 - arm])
        np.testing.assert_array_equal(turned.mirrored(arm).responsivity_dn, OF_COLUMNS)
    swapped = segment.swapped()
    np.testing.assert_array_equal(swapped.samples(), segment.samples()[::-1])
    np.testing.assert_array_equal(swapped.variance(), segment.variance()[::-1])
    assert swapped.black_level_dn == (5.0, 3.0)
