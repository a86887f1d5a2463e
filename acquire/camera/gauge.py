"""Brightness and sharpness of an image from its lines as they come, for adjusting a lens or a lamp."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.flags import NO_IMAGE

if TYPE_CHECKING:
    from numpy.typing import NDArray

MOST_PIXELS = 2**15
"""Number of pixels of a block that are used, in whole lines spread over it."""
FAINT = 0.01
"""Level, relative to white, below which sharpness would be that of the noise."""


@dataclass(frozen=True, slots=True)
class Reading:
    """Brightness and sharpness of some lines of one arm.

    ``level`` and ``brightest`` are fractions of the range from black to white; ``saturated`` is the fraction
    of white pixels; ``focus`` is the RMS difference of neighbouring pixels relative to the mean light, None
    if there is too little light. All are None if there was no line. ``lost`` lines did not come, or not
    whole.
    """

    lines: int
    lost: int = 0
    level: float | None = None
    brightest: float | None = None
    saturated: float | None = None
    focus: float | None = None


@dataclass(slots=True)
class Sums:
    """Sums over the pixels of some lines, in DN and DN²."""

    lines: int = 0
    lost: int = 0
    samples: int = 0
    total: int = 0
    brightest: int = 0
    saturated: int = 0
    steps: int = 0
    energy: int = 0

    def add(self, other: Sums) -> None:
        self.brightest = max(self.brightest, other.brightest)
        for name in ("lines", "lost", "samples", "total", "saturated", "steps", "energy"):
            setattr(self, name, getattr(self, name) + getattr(other, name))


class Gauge:
    """Gauge of one arm: blocks go in by `look` and `keep`, `take` returns the reading since its last call.

    Focus is √⟨(y_{j+1} − y_j)²⟩ / ⟨y − black⟩ over pixels j and lines. A lens out of focus moves light to the
    neighbouring pixels without losing any, so that at steady light the number is largest in focus; noise and
    the columns' gains add the same to it at any focus.
    """

    def __init__(self, black_dn: float, white_dn: int) -> None:
        self._black_dn, self._white_dn = black_dn, white_dn
        self._sums = Sums()

    def look(self, pixels: NDArray[Any], flags: NDArray[np.uint16], lost: int = 0) -> Sums:
        """Return the sums of consecutive lines (line, pixel) and flags (line) after ``lost`` lost ones."""
        good = (flags & NO_IMAGE) == 0
        sums = Sums(int(good.sum()), lost + int(len(flags) - good.sum()))
        stride = max(1, -(-pixels.size // MOST_PIXELS))
        # Signed and wider than the samples, since differences of unsigned numbers would wrap.
        seen = pixels[::stride][good[::stride]].astype(np.int32)
        if seen.size:
            steps = np.diff(seen, axis=1)
            sums.samples, sums.total, sums.brightest = seen.size, int(seen.sum()), int(seen.max())
            sums.saturated = int((seen >= self._white_dn).sum())
            # The square of a 16-bit difference exceeds the range of int32.
            sums.steps, sums.energy = steps.size, int((steps.astype(np.int64) ** 2).sum())
        return sums

    def keep(self, sums: Sums) -> None:
        """Add sums to the reading."""
        self._sums.add(sums)

    def take(self) -> Reading:
        """Return the reading of the sums kept since the last call."""
        sums, self._sums = self._sums, Sums()
        if not sums.samples:
            return Reading(sums.lines, sums.lost)
        span = self._white_dn - self._black_dn
        light = sums.total / sums.samples - self._black_dn
        bright = light > FAINT * span and sums.steps > 0
        return Reading(
            sums.lines,
            sums.lost,
            level=light / span,
            brightest=(sums.brightest - self._black_dn) / span,
            saturated=sums.saturated / sums.samples,
            focus=(sums.energy / sums.steps) ** 0.5 / light if bright else None,
        )
