"""Plug-in point for priors: any denoiser of coefficient frames can replace total variation.

ADMM calls ``prox(frames, weight)`` once per iteration. With the proximal operator of a convex prior, it
minimises the objective of `admm`; any other denoiser makes it plug-and-play ADMM (Venkatakrishnan, Bouman and
Wohlberg, GlobalSIP 2013), which has no objective but often a good fixed point.

    class Mine:
        def prox(self, frames, weight):   # (K, row, column), strength: one number or (K,)
            return cleaned                # same shape and dtype

    reconstruct(segment, 3, 1, denoiser=Mine())

A denoiser that is an entry point of the group ``acquire.denoisers`` is created without arguments by its name:
``reconstruct(…, denoiser="haar")``, ``acquire reconstruct --denoiser haar``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

from acquire.arrays import namespace
from acquire.errors import NumericsError, UsageError
from acquire.plugins import DENOISERS

if TYPE_CHECKING:
    from acquire.arrays import Array


@runtime_checkable
class Denoiser(Protocol):
    """Denoises frames (K, row, column) with a strength ``weight``, in the units of TV's."""

    def prox(self, frames: Array, weight: float | Array, /) -> Array:
        """Return frames (K, n′, n′) without noise of standard deviation ``weight``; 0 changes nothing."""
        ...


def open_denoiser(name: str) -> Denoiser:
    """Create the installed denoiser of that name. Raises ConfigError if there is none that works."""
    found: Denoiser = DENOISERS.load(name)()
    return found


class CheckedDenoiser:
    """A denoiser whose results are checked, so that an error names the denoiser that caused it."""

    def __init__(self, denoiser: Denoiser) -> None:
        self._denoiser, self._name = denoiser, type(denoiser).__name__

    def prox(self, frames: Array, weight: float | Array) -> Array:
        """Denoise. Raises UsageError for a result of another shape, NumericsError if it is not finite."""
        cleaned = self._denoiser.prox(frames, weight)
        shape = getattr(cleaned, "shape", None)
        if shape != frames.shape:
            what = f"a {type(cleaned).__name__}" if shape is None else f"shape {tuple(shape)}"
            raise UsageError(
                f"denoiser {self._name} gave back {what} for frames of shape {tuple(frames.shape)}",
                possible="an array of the same shape",
            )
        if not bool(namespace(cleaned).all(namespace(cleaned).isfinite(cleaned))):
            raise NumericsError(
                f"denoiser {self._name} gave back values that are not finite", hint="another denoiser, or TV"
            )
        return cleaned


class HaarShrink:
    """Soft thresholding of Haar wavelets at all shifts, ``levels`` deep (Coifman and Donoho, 1995).

    One level of the undecimated transform, inverted, is the mean of the decimated one over its shifts; the
    smooth part enters the next level with twice the spacing. Edges wrap around.
    """

    def __init__(self, levels: int = 3) -> None:
        if levels < 1:
            raise UsageError(f"there cannot be {levels} wavelet levels", possible="1 or more")
        self._levels = levels

    def prox(self, frames: Array, weight: float | Array) -> Array:
        """Shrink the details by ``weight``."""
        # There is one threshold per frame, whether the weight is a number or (K,).
        threshold = (namespace(frames).zeros_like(frames[:, 0, 0]) + weight)[:, None, None]
        smooth, details = frames, namespace(frames).zeros_like(frames)
        for level in range(self._levels):
            step = 1 << level
            if step >= min(frames.shape[1:]):
                break
            a, b = smooth, namespace(smooth).roll(smooth, -step, axis=2)
            bands = []
            for part in ((a + b) / 2, (a - b) / 2):
                below = namespace(part).roll(part, -step, axis=1)
                bands += [(part + below) / 2, (part - below) / 2]
            kept = []
            for band, sign in zip(bands[1:], _SIGNS, strict=True):
                xp = namespace(band)
                # Bands are sums of four voxels over 4, not 2 as in an orthonormal transform: half of its
                # threshold.
                shrunk = xp.sign(band) * xp.maximum(xp.abs(band) - threshold / 2, 0)
                kept.append(_undo(shrunk, step, sign))
            smooth = _undo(bands[0], step, (1, 1))
            details += sum(kept[1:], kept[0])
        return smooth + details


_SIGNS = ((-1, 1), (1, -1), (-1, -1))
"""Signs of the second row and column, for vertical, horizontal and diagonal details."""


def _undo(band: Array, step: int, sign: tuple[int, int]) -> Array:
    """A band back in pixels: the mean over the shifts, which for Haar is the transposed filter."""
    rows = (band + sign[0] * namespace(band).roll(band, step, axis=1)) / 2
    return (rows + sign[1] * namespace(rows).roll(rows, step, axis=2)) / 2
