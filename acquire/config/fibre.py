"""Model of a rig's ``[fibre]``: the bands of a scene that is larger than the number of stages."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from acquire.config.base import FrozenModel
from acquire.fibre import LARGEST, Fibre

FirstColumn = Annotated[int, Field(ge=0, lt=LARGEST)]


class FibreConfig(FrozenModel):
    """An image-transmitting fibre before the cameras, ``cameras.layout = "fibre"``; see `acquire.fibre`."""

    rows: int = Field(ge=1, le=LARGEST, description="rows of the scene in fine pixels, a multiple of M x S")
    columns: int = Field(
        ge=1, le=LARGEST, description="columns of the scene in fine pixels, a multiple of M x S"
    )
    sensor_pixels: int = Field(ge=2, le=LARGEST, description="pixels of a line of either camera")
    bands_a: tuple[FirstColumn, ...] = Field(
        default=(),
        description="first column on camera A of each band of rows, from the top of the scene; absent: next "
        "to each other in the middle of the sensor",
    )
    bands_b: tuple[FirstColumn, ...] = Field(
        default=(), description="first column on camera B of each band of columns, from the left"
    )

    def build(self, stages: int, substeps: int) -> Fibre:
        """Return the fibre for sensors of M stages with S sub-steps. Raises UsageError if it does not fit."""
        return Fibre.side_by_side(
            stages,
            substeps,
            self.rows,
            self.columns,
            self.sensor_pixels,
            a=self.bands_a,
            b=self.bands_b,
        )
