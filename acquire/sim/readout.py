"""The lines that a simulated sensor reads out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.lines import LineFlag

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Readout:
    """Lines as a camera delivers them: pixels (count, M), and which of the lines are missing (count,)."""

    pixels: NDArray[Any]
    missing: NDArray[np.bool_]

    @property
    def flags(self) -> NDArray[np.uint16]:
        return np.where(self.missing, np.uint16(LineFlag.MISSING), np.uint16(0))
