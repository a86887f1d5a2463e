"""Position of arm B's image relative to arm A's: a similarity of the plane, in fine pixels of the scene."""

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


@dataclass(frozen=True, slots=True)
class Alignment:
    """Maps the point p of arm A's view to m·Q·p + (rows, columns) in arm B's, both from the field's centre.

    ``rows`` and ``columns`` are fine pixels downwards and to the right in camera A's view, ``turn_deg`` is
    counter-clockwise, ``magnification`` is m. The effect ``misregistration`` uses the same convention.

    Raises UsageError for values beyond the limits above.
    """

    rows: float = 0.0
    columns: float = 0.0
    turn_deg: float = 0.0
    magnification: float = 1.0

    def __post_init__(self) -> None:
        values = (self.rows, self.columns, self.turn_deg, self.magnification)
        if not all(map(math.isfinite, values)):
            raise UsageError(f"the alignment is impossible: {self}", possible="finite numbers")
        low = 1 / LARGEST_MAGNIFICATION
        if not (
            max(abs(self.rows), abs(self.columns)) <= LARGEST_SHIFT_PIXELS
            and abs(self.turn_deg) <= LARGEST_TURN_DEG
            and low <= self.magnification <= LARGEST_MAGNIFICATION
        ):
            raise UsageError(
                f"the alignment is impossible: {self}",
                possible=f"shifts up to {LARGEST_SHIFT_PIXELS:g} fine pixels, turns up to "
                f"{LARGEST_TURN_DEG:g} degrees, magnification {low:g} to {LARGEST_MAGNIFICATION:g}",
            )

    @property
    def matrix(self) -> NDArray[np.float64]:
        """m·Q, which acts on (row, column): (2, 2)."""
        angle = math.radians(self.turn_deg)
        rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        return self.magnification * rotation

    def to_b(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where points (2, m, n) of arm A's view are in arm B's, from the centre of the field."""
        found: NDArray[np.float64] = np.tensordot(self.matrix, points, axes=1) + self._shift
        return found

    def to_a(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where points (2, m, n) of arm B's view are in arm A's, from the centre of the field."""
        return np.tensordot(np.linalg.inv(self.matrix), points - self._shift, axes=1)

    @property
    def _shift(self) -> NDArray[np.float64]:
        return np.array([[[self.rows]], [[self.columns]]])

    def sources(self, size: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the row and column (size, size) of arm A's view that each fine pixel of arm B's shows."""
        centre = (size - 1) / 2
        rows, columns = self.to_a(np.indices((size, size), np.float64) - centre)
        return rows + centre, columns + centre

    def facts(self) -> dict[str, Any]:
        """Return the alignment as JSON."""
        return {
            "rows": self.rows,
            "columns": self.columns,
            "turn_deg": self.turn_deg,
            "magnification": self.magnification,
        }
