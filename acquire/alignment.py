"""Position of arm B's image relative to arm A's: a similarity of the plane and a radial distortion.

Positions are in fine pixels of the scene, from the centre of the field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

LARGEST_SHIFT_PIXELS = 1e4
LARGEST_TURN_DEG = 45.0
LARGEST_MAGNIFICATION = 2.0
LARGEST_DISTORTION = 0.06
"""With 0.07, the field's corners are at the largest distance from the axis that can be imaged."""
ROUNDS = 12
"""Newton's steps to a distorted position; each doubles the digits, except near that distance."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """Maps the point p of arm A's view to m·Q·p + (rows, columns) in arm B's, both from the field's centre.

    ``rows`` and ``columns`` are fine pixels downwards and to the right in camera A's view, ``turn_deg`` is
    counter-clockwise, ``magnification`` is m. The effect ``misregistration`` uses the same convention.

    ``distortion`` is k: what would be at q is at p in arm B's view, with p·(1 − k·|p/h|²) = q and h half the
    field's side. It is the outward displacement of the middle of a side, relative to h, by the lens of arm B,
    or less that by the lens of arm A, as the effect ``lens_distortion`` has it.

    Raises UsageError for values beyond the limits above.
    """

    rows: float = 0.0
    columns: float = 0.0
    turn_deg: float = 0.0
    magnification: float = 1.0
    distortion: float = 0.0

    def __post_init__(self) -> None:
        values = (self.rows, self.columns, self.turn_deg, self.magnification, self.distortion)
        if not all(map(math.isfinite, values)):
            raise UsageError(f"the alignment is impossible: {self}", possible="finite numbers")
        low = 1 / LARGEST_MAGNIFICATION
        if not (
            max(abs(self.rows), abs(self.columns)) <= LARGEST_SHIFT_PIXELS
            and abs(self.turn_deg) <= LARGEST_TURN_DEG
            and low <= self.magnification <= LARGEST_MAGNIFICATION
            and abs(self.distortion) <= LARGEST_DISTORTION
        ):
            raise UsageError(
                f"the alignment is impossible: {self}",
                possible=f"shifts up to {LARGEST_SHIFT_PIXELS:g} fine pixels, turns up to "
                f"{LARGEST_TURN_DEG:g} degrees, magnification {low:g} to {LARGEST_MAGNIFICATION:g}, "
                f"distortion up to {LARGEST_DISTORTION:g}",
            )

    @property
    def matrix(self) -> NDArray[np.float64]:
        """m·Q, which acts on (row, column): (2, 2)."""
        angle = math.radians(self.turn_deg)
        rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        return self.magnification * rotation

    def to_b(self, points: NDArray[np.float64], half: float) -> NDArray[np.float64]:
        """Return where points (2, m, n) of arm A's view are in arm B's; ``half`` is h."""
        found: NDArray[np.float64] = np.tensordot(self.matrix, points, axes=1) + self._shift
        if not self.distortion:
            return found
        k, aim = self.distortion / half**2, np.hypot(*found)
        if k > 0:
            # q = r·(1 − k·r²) is at most 2/3/√(3k), at r = 1/√(3k): beyond this distance nothing is imaged,
            # and at it the step below would divide by 0.
            aim = np.minimum(aim, 0.999 * 2 / 3 / np.sqrt(3 * k))
        radius = aim
        for _ in range(ROUNDS):
            radius = radius - (radius * (1 - k * radius**2) - aim) / (1 - 3 * k * radius**2)
        return np.asarray(found / (1 - k * radius**2))

    def to_a(self, points: NDArray[np.float64], half: float) -> NDArray[np.float64]:
        """Return where points (2, m, n) of arm B's view are in arm A's; ``half`` is h."""
        if self.distortion:
            points = points * (1 - self.distortion / half**2 * (points**2).sum(axis=0))
        return np.tensordot(np.linalg.inv(self.matrix), points - self._shift, axes=1)

    @property
    def _shift(self) -> NDArray[np.float64]:
        return np.array([[[self.rows]], [[self.columns]]])

    def sources(self, size: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the row and column (size, size) of arm A's view that each fine pixel of arm B's shows."""
        centre = (size - 1) / 2
        rows, columns = self.to_a(np.indices((size, size), np.float64) - centre, size / 2)
        return rows + centre, columns + centre

    def facts(self) -> dict[str, Any]:
        """Return the alignment as JSON."""
        return {
            "rows": self.rows,
            "columns": self.columns,
            "turn_deg": self.turn_deg,
            "magnification": self.magnification,
            "distortion": self.distortion,
        }
