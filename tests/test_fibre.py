"""The fibre's table: every pixel of the scene is once on each sensor, wherever the bands lie."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.errors import UsageError
from acquire.fibre import Fibre, Tile


@st.composite
def fibres(draw: st.DrawFn) -> Fibre:
    """Draw a fibre of up to 4 × 4 tiles, with bands in any order and gaps of any width."""
    stages, substeps = draw(st.integers(1, 4)), draw(st.integers(1, 3))
    tall, wide = draw(st.tuples(st.integers(1, 4), st.integers(1, 4)).filter(lambda tiles: tiles != (1, 1)))
    n, bands = stages * substeps, {}
    for arm, count, along in (("a", tall, wide), ("b", wide, tall)):
        width, first, places = along * stages, 0, []
        for _ in range(count):
            first += draw(st.integers(0, 3))
            places.append(first)
            first += width
        bands[arm] = tuple(draw(st.permutations(places)))
        bands[arm + "_end"] = (first,)
    width = max(bands["a_end"][0], bands["b_end"][0]) + draw(st.integers(0, 3))
    return Fibre(stages, substeps, tall * n, wide * n, width, bands["a"], bands["b"])


@given(fibres())
def test_every_pixel_of_the_scene_lies_once_on_either_sensor_and_tiles_find_it(fibre: Fibre) -> None:
    n, S = fibre.size, fibre.substeps
    scene = np.arange(1, fibre.rows * fibre.columns + 1).reshape(1, fibre.rows, fibre.columns)
    for arm in "ab":
        laid = fibre.lay_out(scene, arm)
        assert laid.shape == (1, n, S * fibre.sensor_pixels)
        assert np.array_equal(np.sort(laid[laid > 0]), scene.ravel())
        lit = (laid[0] > 0).all(axis=0).reshape(-1, S)
        table = fibre.table(arm)
        assert np.array_equal(lit.all(axis=1), table[:, 0] >= 0)
        assert np.array_equal(lit.any(axis=1), table[:, 1] >= 0)
    for tile in fibre.tiles:
        part = scene[:, tile.row * n : (tile.row + 1) * n, tile.column * n : (tile.column + 1) * n]
        a, b = fibre.pixels(tile)
        np.testing.assert_array_equal(fibre.lay_out(scene, "a")[:, :, S * a.start : S * a.stop], part)
        turned = np.rot90(part, axes=(1, 2))
        np.testing.assert_array_equal(fibre.lay_out(scene, "b")[:, :, S * b.start : S * b.stop], turned)


@given(fibres())
def test_the_table_says_what_the_tiles_say_and_travels_as_attributes(fibre: Fibre) -> None:
    for arm in "ab":
        table = fibre.table(arm)
        for tile in fibre.tiles:
            band, place = (tile.row, tile.column) if arm == "a" else (tile.column, tile.row)
            seen = table[fibre.pixels(tile)["ab".index(arm)]]
            np.testing.assert_array_equal(seen[:, 0], band)
            np.testing.assert_array_equal(seen[:, 1], place * fibre.stages + np.arange(fibre.stages))
        profile = np.arange(fibre.sensor_pixels)
        summed = [profile[fibre.pixels(tile)["ab".index(arm)]] for tile in fibre.tiles]
        np.testing.assert_array_equal(fibre.folded(profile, arm), np.sum(summed, axis=0))
    sizes = {"stages": fibre.stages, "substeps": fibre.substeps, "pixels": fibre.sensor_pixels}
    assert Fibre.of({**sizes, "fibre": fibre.to_attrs()}) == fibre
    assert Fibre.of(sizes) is None


def test_the_paper_s_sizes_lie_side_by_side_in_the_middle_of_the_sensor() -> None:
    fibre = Fibre.side_by_side(256, 1, 768, 1536, 4640)
    assert fibre.bands_a == (16, 16 + 1536, 16 + 2 * 1536)
    assert fibre.bands_b == tuple(16 + 768 * band for band in range(6))
    assert len(fibre.tiles) == 18
    assert fibre.tiles[-1] == Tile(2, 5)
    assert fibre.pixels(Tile(1, 2)) == (slice(16 + 1536 + 512, 16 + 1536 + 768), slice(1808, 2064))
    assert fibre.field() == (slice(384, 1152), slice(0, 1536))


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ((64, 1, 100, 192, 640), r"100 rows is not a whole number of bands of n = 64; possible: a multiple"),
        ((64, 1, 128, 200, 640), "200 columns is not a whole number"),
        ((64, 1, 64, 64, 640), "a single band; possible: more rows or columns, or no fibre"),
        ((64, 1, 128, 192, 383), "sensor A with 383 columns is too narrow .* possible: 384 columns or more"),
        ((64, 3, 384, 0, 640), "0 columns is not a whole number"),
    ],
)
def test_scenes_that_do_not_fit_are_refused(sizes: tuple[int, ...], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        Fibre.side_by_side(*sizes)


@pytest.mark.parametrize(
    ("bands", "words"),
    [
        ({"a": (0,)}, "1 bands on sensor A cannot show .* possible: 2 bands of 64 rows each"),
        ({"a": (0, 191)}, "192 columns that begin at 0, 191 overlap or .* at least 192 apart"),
        (
            {"b": (0, 128, 513)},
            "128 columns that begin at 0, 128, 513 .* possible: first columns from 0 to 512",
        ),
    ],
)
def test_bands_that_overlap_or_leave_the_sensor_are_refused(bands: dict, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        Fibre.side_by_side(64, 1, 128, 192, 640, **bands)


def test_tiles_outside_the_scene_are_refused() -> None:
    fibre = Fibre.side_by_side(64, 1, 128, 192, 640)
    for tile in (Tile(2, 0), Tile(0, 3), Tile(-1, 0)):
        with pytest.raises(UsageError, match="possible: ROW,COLUMN from 0,0 to 1,2"):
            fibre.pixels(tile)
