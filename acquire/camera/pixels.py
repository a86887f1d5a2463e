"""Pixel formats in a camera's buffer, and their conversion to (line, pixel) arrays.

::

    Mono8, Mono16           a byte, two bytes (lowest first)
    Mono10, Mono12          in two bytes, lowest first
    Mono10p, Mono12p        PFNC: a stream of bits, lowest first; 4 pixels in 5 bytes, 2 in 3
    Mono10/12Packed         GigE Vision: two pixels in three bytes, high 8 bits outside, the rest between

Unpacked formats are views of the buffer without a copy. Row padding is never part of the result.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import CameraError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class PixelLayout:
    """``bits``: significant bits; ``stored_bits``: bits of a pixel in the buffer."""

    name: str
    bits: int
    stored_bits: int

    @property
    def dtype(self) -> str:
        """Type of unpacked pixels."""
        return "uint8" if self.bits <= 8 else "uint16"

    def row_bytes(self, width: int) -> int:
        """Return the bytes of a row; a last byte that is only partly used counts."""
        return -(-width * self.stored_bits // 8)


LAYOUTS = {
    layout.name: layout
    for layout in (
        PixelLayout("Mono8", 8, 8),
        PixelLayout("Mono10", 10, 16),
        PixelLayout("Mono10p", 10, 10),
        PixelLayout("Mono10Packed", 10, 12),
        PixelLayout("Mono12", 12, 16),
        PixelLayout("Mono12p", 12, 12),
        PixelLayout("Mono12Packed", 12, 12),
        PixelLayout("Mono16", 16, 16),
    )
}


def layout_of(name: str) -> PixelLayout:
    """Return the layout of an SFNC PixelFormat. Raises CameraError for one that cannot be recorded."""
    if name not in LAYOUTS:
        raise CameraError(f"pixel format {name!r} cannot be recorded", possible=", ".join(LAYOUTS))
    return LAYOUTS[name]


class LineReader:
    """Reads lines of ``width`` pixels from buffers; ``padding`` bytes follow each line.

    ``joined``: a packed line may begin inside the byte in which the previous one ends, without a gap.
    """

    def __init__(self, layout: PixelLayout, width: int, padding: int = 0, *, joined: bool = False) -> None:
        self._layout, self._width = layout, width
        self._row = layout.row_bytes(width)
        self._joined = joined
        self.pitch = self._row + padding

    def lines(self, memory: NDArray[np.uint8], count: int) -> NDArray[Any]:
        """Return (count, width) pixels from the beginning of ``memory`` (bytes)."""
        layout = self._layout
        if self._joined:
            pixels = count * self._width
            run = memory[: self.size(count)].reshape(1, -1)
            return _UNPACK[self._layout.name](run, pixels).reshape(count, self._width)
        rows = memory[: count * self.pitch].reshape(count, self.pitch)[:, : self._row]
        if layout.stored_bits == 8:
            return rows
        if layout.stored_bits == 16:
            # A view although rows may have padding: numpy needs only the bytes of a row to be contiguous.
            return rows.view("<u2")
        return _UNPACK[layout.name](rows, self._width)

    def size(self, count: int) -> int:
        """Return the bytes of ``count`` lines."""
        if self._joined:
            return -(-count * self._width * self._layout.stored_bits // 8)
        return count * self.pitch

    @classmethod
    def for_frames(
        cls, layout: PixelLayout, width: int, padding: int, height: int, filled: int
    ) -> LineReader:
        """Return the reader for a camera whose frame of ``height`` lines fills ``filled`` bytes."""
        # Standards leave open whether a packed line begins at a byte boundary; the size of a frame shows it.
        joined, aligned = cls(layout, width, joined=True), cls(layout, width, padding)
        return joined if filled == joined.size(height) != aligned.size(height) else aligned


def _groups(rows: NDArray[np.uint8], group: int) -> NDArray[np.uint16]:
    """Divide rows into groups of ``group`` bytes, padding the last: (row, group, byte) as uint16."""
    short = -rows.shape[1] % group
    if short:
        rows = np.pad(rows, ((0, 0), (0, short)))
    return rows.reshape(len(rows), -1, group).astype(np.uint16)


def _join(parts: list[NDArray[Any]], width: int) -> NDArray[np.uint16]:
    out: NDArray[np.uint16] = np.stack(parts, axis=-1)
    return out.reshape(len(out), -1)[:, :width]


def _mono12p(rows: NDArray[np.uint8], width: int) -> NDArray[np.uint16]:
    b = _groups(rows, 3)
    return _join([b[..., 0] | (b[..., 1] & 0xF) << 8, b[..., 1] >> 4 | b[..., 2] << 4], width)


def _mono10p(rows: NDArray[np.uint8], width: int) -> NDArray[np.uint16]:
    b = _groups(rows, 5)
    # Pixel k has its low 8 − 2k bits in byte k, and its high 2k + 2 bits in byte k + 1.
    parts = [b[..., k] >> (2 * k) | (b[..., k + 1] & (1 << (2 * k + 2)) - 1) << (8 - 2 * k) for k in range(4)]
    return _join(parts, width)


def _mono12packed(rows: NDArray[np.uint8], width: int) -> NDArray[np.uint16]:
    # The middle byte has the first pixel's low bits in its lower half, the second's in its upper half.
    b = _groups(rows, 3)
    return _join([b[..., 0] << 4 | b[..., 1] & 0xF, b[..., 2] << 4 | b[..., 1] >> 4], width)


def _mono10packed(rows: NDArray[np.uint8], width: int) -> NDArray[np.uint16]:
    b = _groups(rows, 3)
    # As Mono12Packed, but only two of the four bits in each half of the middle byte are used.
    return _join([b[..., 0] << 2 | b[..., 1] & 3, b[..., 2] << 2 | b[..., 1] >> 4 & 3], width)


_UNPACK: dict[str, Callable[[NDArray[np.uint8], int], NDArray[np.uint16]]] = {
    "Mono12p": _mono12p,
    "Mono10p": _mono10p,
    "Mono12Packed": _mono12packed,
    "Mono10Packed": _mono10packed,
}
