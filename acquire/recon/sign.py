"""The split of the sign: light is not negative.

    v = Dᵀ·θ ≥ 0    for coefficients θ (K, n′, n′) at the T instants of a grid D (K, T) with orthonormal rows

For a few patterns, split and multiplier are by far the largest array of a solver (K = 4, but T = 485 for the
paper's lamps on 256 stages): each temporary array of that size costs as much time as the products with D. So
both are stored as one, and all that happens to a voxel happens in a single pass of compiled loops. For many
coefficients the products of a BLAS, on some instants at a time, are faster.
"""

from __future__ import annotations

import math
from copy import copy
from typing import TYPE_CHECKING, Any, Protocol

from array_api_compat import is_numpy_array

from acquire.arrays import namespace
from acquire.recon.kernels import sign_advance, sign_pull

if TYPE_CHECKING:
    from acquire.arrays import Array

FEW = 16
"""Largest number of coefficients for which the compiled loops are used: for 16 they take half the time of a
BLAS in large frames and as long in small ones, for 24 up to twice."""
PART_PIXELS, PART_ROWS = 1 << 19, 4
"""Pixels of the instants that are handled together, 2 MB; and the fewest instants, relative to the number of
coefficients: the product of fewer spends more time on the coefficients than on the instants."""


class Sign(Protocol):
    """What `admm` needs of a split of the sign; see `SignSplit`."""

    def advance(self, theta: Array) -> None:
        """Update split and multiplier by new coefficients θ (K, n′, n′)."""

    def pull(self) -> Array:
        """Return D·(v − multiplier), the coefficients towards which the split draws."""
        ...

    def rescale(self, factor: float) -> None:
        """Multiply the multiplier, which is held divided by ρ, by ``factor``, as another ρ requires."""

    def rebase(self, grid: Array, shape: tuple[int, ...]) -> None:
        """Continue on another grid D of as many instants, for coefficients of another ``shape``."""

    def resume(self, other: Any) -> None:
        """Take over split and multiplier of another one, to continue from its solution."""

    def copied(self) -> Sign:
        """Return one that advances independently."""
        ...


class SignSplit:
    """Split and multiplier of the sign; a ``background`` (K, n′, n′) is light that is added to that of θ.

    `_signed` (T, n′, n′) is their sum, max(v, 0) plus the multiplier over ρ, min(·, 0): one is 0 where the
    other is not, so that the sum tells both. `_scale` multiplies what is negative: a change of ρ need not
    touch the array. `_pulled` is the answer of `pull`, if the pass before has found it.
    """

    def __init__(self, grid: Array, start: Array, background: Array | None) -> None:
        """Begin at the light of ``start``, not at 0, which would draw a warm start to darkness."""
        self._xp, self._background, self._scale = namespace(start), background, 1.0
        self._pulled: Array = None
        self.rebase(grid, start.shape)
        self._signed = self._xp.maximum(self._whole(start, slice(None)), 0)

    def rebase(self, grid: Array, shape: tuple[int, ...]) -> None:
        """Continue on a grid with as many instants, for coefficients of another shape."""
        self._grid, self._shape, self._pulled = grid, shape, None
        background = self._background
        self._known = None if background is None else self._xp.tensordot(grid.T, background, axes=1)
        self._is_compiled = is_numpy_array(grid) and shape[0] <= FEW and background is None
        # Temporary arrays are small in parts, where that costs no time: a product of many rows is slower in
        # parts, and so is everything on other devices.
        rows, *frame = shape
        instants = grid.shape[1]
        at_once = max(PART_PIXELS // math.prod(frame), PART_ROWS * rows)
        step = at_once if is_numpy_array(grid) else instants
        self._parts = [slice(first, first + step) for first in range(0, instants, step)]

    def advance(self, theta: Array) -> None:
        """Take the light of coefficients for v, and what of it is negative for the multiplier."""
        if self._is_compiled:
            self._pulled = self._xp.empty_like(theta)
            sign_advance(theta, self._grid, self._scale, self._signed, self._pulled)
        else:
            self._pulled = None
            for some in self._parts:
                values = self._whole(theta, some)
                values += self._negative(some)
                self._signed[some, ...] = values
        self._scale = 1.0

    def pull(self) -> Array:
        """D·(v − multiplier), without the background: the coefficients towards which the split draws.

        Not to be changed: the next call may return the same array.
        """
        if self._pulled is not None:
            return self._pulled
        pulled = self._xp.zeros(self._shape, dtype=self._signed.dtype, device=self._signed.device)
        if self._is_compiled:
            sign_pull(self._signed, self._scale, self._grid, pulled)
            return pulled
        for some in self._parts:
            signed = self._signed[some, ...]
            if self._scale == 1:
                reflected = self._xp.abs(signed)
            else:
                reflected = self._xp.maximum(signed, 0) - self._negative(some)
            if self._known is not None:
                reflected -= self._known[some, ...]
            pulled += self._xp.tensordot(self._grid[:, some], reflected, axes=1)
        return pulled

    def rescale(self, factor: float) -> None:
        """Multiply the multiplier over ρ, as another ρ requires."""
        self._scale, self._pulled = self._scale * factor, None

    def resume(self, other: SignSplit) -> None:
        """Take over the state of another split, unless it has another number of instants."""
        if other._signed.shape != self._signed.shape:
            return
        self._signed, self._scale = self._xp.asarray(other._signed, copy=True), other._scale
        self._pulled = None

    def copied(self) -> SignSplit:
        """The same split with a state of its own."""
        other = copy(self)
        other.resume(self)
        return other

    def _whole(self, theta: Array, some: slice) -> Array:
        """The light of coefficients and background at some of the instants."""
        values = self._xp.tensordot(self._grid[:, some].T, theta, axes=1)
        return values if self._known is None else values + self._known[some, ...]

    def _negative(self, some: slice) -> Array:
        negative = self._xp.minimum(self._signed[some, ...], 0)
        return negative if self._scale == 1 else self._scale * negative
