"""Pixel formats, against bits packed one by one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.camera.pixels import LAYOUTS, LineReader, layout_of
from acquire.errors import CameraError


def pack(name: str, row: list[int]) -> list[int]:
    """One line as bytes, by the words of the standards."""
    layout = LAYOUTS[name]
    if name.endswith("Packed"):
        low = layout.bits - 8
        out = []
        for k in range(0, len(row), 2):
            a, b = row[k], row[k + 1] if k + 1 < len(row) else 0
            out += [a >> low, a & (1 << low) - 1 | (b & (1 << low) - 1) << 4, b >> low]
        return out if len(row) % 2 == 0 else out[:-1]
    stream = [value >> bit & 1 for value in row for bit in range(layout.stored_bits)]
    stream += [0] * (-len(stream) % 8)
    return [sum(bit << k for k, bit in enumerate(stream[at : at + 8])) for at in range(0, len(stream), 8)]


@given(
    name=st.sampled_from(sorted(LAYOUTS)),
    width=st.integers(1, 19),
    height=st.integers(1, 4),
    padding=st.integers(0, 7),
    seed=st.integers(0, 1000),
)
def test_lines_come_out_as_they_were_packed_and_padding_does_not(
    name: str, width: int, height: int, padding: int, seed: int
) -> None:
    layout = LAYOUTS[name]
    pixels = np.random.default_rng(seed).integers(0, 1 << layout.bits, (height, width))
    rows = [pack(name, row.tolist()) + [0xAA] * padding for row in pixels]
    reader = LineReader.for_frames(layout, width, padding, height, height * (len(rows[0])))
    memory = np.array([byte for row in rows for byte in row], np.uint8)
    assert reader.size(height) == len(memory)
    lines = reader.lines(memory, height)
    assert lines.dtype == layout.dtype
    np.testing.assert_array_equal(lines, pixels)


@pytest.mark.parametrize("name", ["Mono10p", "Mono12p"])
def test_packed_lines_without_padding_may_begin_inside_a_byte(name: str) -> None:
    layout, width = LAYOUTS[name], 7
    pixels = np.random.default_rng(1).integers(0, 1 << layout.bits, (6, width))
    memory = np.array(pack(name, pixels.ravel().tolist()), np.uint8)
    reader = LineReader.for_frames(layout, width, 0, 6, len(memory))
    np.testing.assert_array_equal(reader.lines(memory, 6), pixels)


def test_unpacked_lines_are_not_copied() -> None:
    memory = np.zeros(64, np.uint8)
    for name in ("Mono8", "Mono12", "Mono16"):
        assert np.shares_memory(LineReader(LAYOUTS[name], 4, 2).lines(memory, 3), memory)


def test_a_format_that_cannot_be_recorded_is_refused_with_those_that_can() -> None:
    with pytest.raises(CameraError, match=r"'RGB8' cannot be recorded; possible: Mono8, .*Mono16"):
        layout_of("RGB8")
