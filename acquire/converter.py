"""Non-linearity of a camera: by how much its readings exceed those of a linear one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class ConverterCurve:
    """Readings of the camera and their excess over a linear camera's: one rising curve per arm.

    Attributes
    ----------
    dn : (arm, knot) readings, rising
    excess_dn : (arm, knot) by how much they are too high; linear between knots, constant beyond them

    Raises UsageError for a curve that does not rise, since two amounts of light would then read alike.
    """

    dn: NDArray[np.float64]
    excess_dn: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.dn.shape != self.excess_dn.shape or not np.isfinite(self.excess_dn).all():
            raise UsageError(
                f"the curve has {self.excess_dn.shape} excesses for {self.dn.shape} readings",
                possible="one finite number for each",
            )
        if (np.diff(self.dn) <= 0).any() or (np.diff(self.dn - self.excess_dn) <= 0).any():
            raise UsageError(
                "the curve of the camera does not rise: two amounts of light would read alike",
                possible="a curve that rises from black to white",
            )

    def straight(self, dn: NDArray[Any]) -> NDArray[Any]:
        """Return the readings of a linear camera; ``dn`` (arm, …) of floats keep their type."""
        arms = zip(dn, self.dn, self.excess_dn, strict=True)
        return np.stack([each - np.interp(each, *knots).astype(dn.dtype) for each, *knots in arms])

    def slope(self, dn: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivative of `straight` at ``dn`` (arm, …)."""
        found = []
        for each, knots, excess in zip(dn, self.dn, self.excess_dn, strict=True):
            # The index of the interval; readings beyond the knots get one, too, which `inside` discards.
            at = np.clip(np.searchsorted(knots, each) - 1, 0, len(knots) - 2)
            inside = (each > knots[0]) & (each < knots[-1])
            found.append(1 - np.where(inside, (np.diff(excess) / np.diff(knots))[at], 0.0))
        return np.stack(found)

    def swapped(self) -> ConverterCurve:
        """Return the curve with the arms exchanged."""
        return ConverterCurve(self.dn[::-1], self.excess_dn[::-1])
