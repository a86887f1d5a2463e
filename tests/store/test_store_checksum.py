"""The checksum of all that is stored is CRC-32C, whatever kind of buffer it is computed of."""

from __future__ import annotations

import google_crc32c  # zarr's own, which reads what we write
import numpy as np
import pytest
from numpy.typing import NDArray

from acquire.store.shape import crc32c


def test_it_has_the_published_check_value() -> None:
    assert crc32c(b"123456789") == 0xE3069283.to_bytes(4, "little")
    assert crc32c(b"") == bytes(4)


@pytest.mark.parametrize("size", [1, 15, 16, 255, 256, 257, 4095, 65_537, 1_200_003])
def test_it_is_that_of_zarr_at_every_size(size: int) -> None:
    data = np.random.default_rng(size).bytes(size)
    assert crc32c(data) == google_crc32c.value(data).to_bytes(4, "little")
    # Unaligned, too: a chunk may begin anywhere in a file.
    assert crc32c(memoryview(data)[1:]) == google_crc32c.value(data[1:]).to_bytes(4, "little")


@pytest.mark.parametrize("dtype", ["u1", "<u2", "<u8", "<i8"])
def test_it_takes_any_buffer(dtype: str) -> None:
    rows: NDArray[np.generic] = np.arange(600, dtype=dtype).reshape(20, 30)
    plain = crc32c(rows.tobytes())
    for data in (rows, rows.data, bytearray(rows.tobytes()), memoryview(rows.tobytes())):
        assert crc32c(data) == plain
    with pytest.raises(
        (ValueError, BufferError)
    ):  # what is not contiguous is refused, not summed in another order
        crc32c(rows[:, 3:].data)
