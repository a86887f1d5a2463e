"""A few rows show the extremes of many lines, by the trigger's count, for any division into blocks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from acquire.flags import LineFlag
from acquire.web.decimate import (
    BINS,
    LOST,
    MOST_COLUMNS,
    MOST_ROWS_PER_S,
    MOST_UNSEEN_ROWS,
    SEEN,
    UNSEEN,
    Decimator,
    Rows,
    Scale,
)

WHITE = 4095


def lines(first: int, count: int, width: int = 8) -> NDArray[np.uint16]:
    rng = np.random.default_rng(first)
    return rng.integers(0, WHITE + 1, (count, width), dtype=np.uint16)


def put(
    decimator: Decimator,
    first: int,
    pixels: NDArray[np.uint16],
    *,
    lost: bool = False,
    damaged: slice = slice(0),
) -> None:
    chosen = decimator.sampled_lines(first, len(pixels))
    flags = np.zeros(len(pixels), np.uint16)
    flags[damaged] = LineFlag.INCOMPLETE
    decimator.add(first, flags, chosen, pixels[chosen - first], lost=lost)


def rows_of(decimator: Decimator) -> Rows:
    found = decimator.take()
    assert found is not None
    return found


@given(st.lists(st.integers(1, 40), min_size=1, max_size=12), st.integers(1, 9), st.integers(0, 50))
def test_rows_are_the_extremes_of_their_lines_however_they_are_cut_into_blocks(
    cuts: list[int], step: int, first: int
) -> None:
    pixels = lines(7, sum(cuts))
    decimator = Decimator(Scale(step, 1, WHITE), 8)
    at, found = 0, []
    for count in cuts:
        put(decimator, first + at, pixels[at : at + count])
        at += count
        found.append(decimator.take())
    put(decimator, first + at, pixels[:1])
    put(decimator, first + at + step, pixels[:1])
    found.append(decimator.take())
    numbers = (first + np.arange(at)) // step
    rows = [(one.first + k, one.low[k], one.high[k]) for one in found if one for k in range(len(one.kind))]
    assert [number for number, _, _ in rows] == list(range(rows[0][0], rows[-1][0] + 1))
    for number, low, high in rows:
        if number < numbers[-1]:
            mine = pixels[numbers == number].astype(np.uint32)
            np.testing.assert_array_equal(low, mine.min(axis=0) * 255 // WHITE)
            np.testing.assert_array_equal(high, mine.max(axis=0) * 255 // WHITE)


@pytest.mark.parametrize(("lost", "kind"), [(True, LOST), (False, UNSEEN)])
def test_a_gap_is_shown_as_rows_of_its_kind(lost: bool, kind: int) -> None:
    decimator = Decimator(Scale(4, 1, WHITE), 8)
    put(decimator, 0, lines(0, 8))
    put(decimator, 20, lines(20, 12), lost=lost)
    rows = rows_of(decimator)
    assert rows.kind.tolist() == [SEEN, SEEN, kind, kind, kind, SEEN, SEEN]
    assert not rows.high[2:5].any()


def test_lines_without_an_image_are_shown_as_lost() -> None:
    decimator = Decimator(Scale(4, 1, WHITE), 8)
    put(decimator, 0, np.full((16, 8), 100, np.uint16))
    damaged = np.full((12, 8), 100, np.uint16)
    damaged[6:] = WHITE  # of an earlier line
    put(decimator, 16, damaged, damaged=slice(6, None))
    put(decimator, 28, np.full((8, 8), 100, np.uint16))
    rows = rows_of(decimator)
    assert rows.kind.tolist() == [*[SEEN] * 5, LOST, LOST, SEEN]
    assert rows.high.max() == 100 * 255 // WHITE
    assert rows.histogram[BINS - 1] == 0


def test_a_long_pause_is_bounded() -> None:
    decimator = Decimator(Scale(1, 1, WHITE), 8)
    put(decimator, 0, lines(0, 8))
    put(decimator, 10**9, lines(1, 8))
    assert len(rows_of(decimator).kind) <= MOST_UNSEEN_ROWS + 16


def test_many_pixels_become_few_columns_without_losing_an_extreme() -> None:
    decimator = Decimator(Scale(1, 1, WHITE), 4640)
    pixels = np.zeros((2, 4640), np.uint16)
    pixels[0, 4639] = WHITE
    put(decimator, 0, pixels)
    rows = rows_of(decimator)
    assert rows.low.shape[1] == MOST_COLUMNS
    assert rows.high[0, -1] == 255
    assert rows.high[0, :-1].max() == 0


def test_the_histogram_counts_sampled_pixels() -> None:
    decimator = Decimator(Scale(2, 2, WHITE), 8)
    pixels = np.full((8, 8), WHITE, np.uint16)
    pixels[:, 0] = 0
    put(decimator, 0, pixels)
    rows = rows_of(decimator)
    assert (rows.histogram[0], rows.histogram[BINS - 1], rows.histogram.sum()) == (4, 28, 32)
    assert rows.saturated == 28


@pytest.mark.parametrize(("rate_hz", "line_bytes"), [(1000.0, 128), (33_333.0, 128), (1e5, 4640), (6e5, 54)])
def test_the_rate_of_sampled_pixels_is_bounded(rate_hz: float, line_bytes: int) -> None:
    scale = Scale.of(rate_hz, line_bytes, 255)
    assert rate_hz / scale.step <= MOST_ROWS_PER_S
    looked_at = rate_hz / scale.stride * line_bytes
    assert looked_at < 16e6 + rate_hz / scale.step * line_bytes
    assert looked_at / scale.counted < 2e6


@given(st.integers(1, 40), st.integers(MOST_COLUMNS - 3, 3 * MOST_COLUMNS), st.integers(1, 5))
def test_a_column_has_the_extremes_of_its_pixels_for_any_width(count: int, width: int, step: int) -> None:
    pixels = lines(3, count * step + 1, width)
    decimator = Decimator(Scale(step, 1, WHITE), width)
    put(decimator, 0, pixels)
    rows = rows_of(decimator)
    edges = np.arange(min(width, MOST_COLUMNS)) * width // min(width, MOST_COLUMNS)
    whole = pixels[: count * step].reshape(count, step, width).astype(np.uint32) * 255 // WHITE
    for shown, extreme in ((rows.low, np.minimum), (rows.high, np.maximum)):
        by_row = extreme.reduce(whole, axis=1)
        np.testing.assert_array_equal(shown[:count], extreme.reduceat(by_row, edges, axis=1))


def test_the_histogram_counts_some_of_the_sampled_lines_whole_for_any_division_into_blocks() -> None:
    pixels = lines(5, 90)
    found = []
    for cut in (90, 7):
        decimator = Decimator(Scale(9, 3, WHITE, counted=2), 8)
        for first in range(0, 90, cut):
            put(decimator, first, pixels[first : first + cut])
        put(decimator, 90, pixels[:9])
        found.append(rows_of(decimator).histogram)
    expected = np.bincount(pixels[::6].ravel().astype(np.int64) * BINS // (WHITE + 1), minlength=BINS)
    expected += np.bincount(pixels[0].astype(np.int64) * BINS // (WHITE + 1), minlength=BINS)
    expected += np.bincount(pixels[6].astype(np.int64) * BINS // (WHITE + 1), minlength=BINS)
    np.testing.assert_array_equal(found[0], expected)
    np.testing.assert_array_equal(found[1], expected)
