"""The plug-in point for priors: anything that cleans coefficient frames can stand where TV stands.

ADMM calls ``prox(frames, weight)`` once an iteration. A convex prior's proximal operator keeps the minimum
of `admm`; any other denoiser makes it plug-and-play ADMM (Venkatakrishnan, Bouman and Wohlberg, GlobalSIP
2013), which has no objective but often a good fixed point.

    class Mine:
        def prox(self, frames, weight):   # (K, row, column), strength: one number or (K,)
            return cleaned                # same shape and dtype

    reconstruct(segment, 3, 1, denoiser=Mine())
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from acquire.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Denoiser(Protocol):
    """Cleans frames (K, row, column); ``weight`` says how strongly, in the units of TV's."""

    def prox(self, frames: NDArray[Any], weight: float | NDArray[Any], /) -> NDArray[Any]: ...


class HaarShrink:
    """Soft thresholding of Haar wavelets at all shifts, ``levels`` deep (Coifman and Donoho, 1995).

    One level of the undecimated transform, rebuilt, is the mean over its shifts of the decimated one; the
    smooth part goes on to the next level with twice the spacing. Edges wrap around.
    """

    def __init__(self, levels: int = 3) -> None:
        if levels < 1:
            raise UsageError(f"{levels} wavelet levels", possible="1 or more")
        self._levels = levels

    def prox(self, frames: NDArray[Any], weight: float | NDArray[Any]) -> NDArray[Any]:
        """Details are shrunk by ``weight``."""
        threshold = np.broadcast_to(np.asarray(weight, frames.dtype), len(frames)).reshape(-1, 1, 1)
        smooth, details = frames, np.zeros_like(frames)
        for level in range(self._levels):
            step = 1 << level
            if step >= min(frames.shape[1:]):
                break
            smooth, kept = _level(smooth, step, threshold)
            details += kept
        cleaned: NDArray[Any] = smooth + details
        return cleaned


def _level(smooth: NDArray[Any], step: int, threshold: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """The next smooth part and the kept details, which add up to ``smooth`` where nothing is shrunk."""
    a, b = smooth, np.roll(smooth, -step, axis=2)
    parts = [(a + b) / 2, (a - b) / 2]
    bands = []
    for part in parts:
        below = np.roll(part, -step, axis=1)
        bands += [(part + below) / 2, (part - below) / 2]
    kept = [
        _undo(_soft(band, threshold / 2), step, sign) for band, sign in zip(bands[1:], _SIGNS, strict=True)
    ]
    return _undo(bands[0], step, (1, 1)), sum(kept[1:], kept[0])


_SIGNS = ((-1, 1), (1, -1), (-1, -1))
"""Of the second row and column, for the details down, across and diagonal."""


def _undo(band: NDArray[Any], step: int, sign: tuple[int, int]) -> NDArray[Any]:
    """Back to pixels: the mean over the shifts, which for Haar is the transposed filter."""
    rows = (band + sign[0] * np.roll(band, step, axis=1)) / 2
    back: NDArray[Any] = (rows + sign[1] * np.roll(rows, step, axis=2)) / 2
    return back


def _soft(band: NDArray[Any], threshold: NDArray[Any]) -> NDArray[Any]:
    shrunk: NDArray[Any] = np.sign(band) * np.maximum(np.abs(band) - threshold, 0)
    return shrunk
