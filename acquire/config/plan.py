"""Model of a plan file: the sub-segments of a combinatorial reconstruction, each with its own voxels.

::

    fade_substeps = 48

    [[segments]]                 # one after another, from the beginning of the reconstructed range
    name = "A"
    substeps = 2136              # or lines = 712, or seconds = 1.187e-3
    spatial_merge = 3
    temporal_merge = 4

    [[segments]]
    name = "B"
    spatial_merge = 1            # the last may omit its length and takes the rest
    temporal_merge = 230
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from acquire.config.base import MOST_LINES, FrozenModel, Seconds

FADE_SUBSTEPS = 32
"""Sub-steps on either side of a seam over which one sub-segment fades into the next."""


class SegmentPlan(FrozenModel):
    """One sub-segment: its length and its voxels."""

    name: str = ""
    substeps: int | None = Field(default=None, ge=1, le=MOST_LINES)
    lines: int | None = Field(default=None, ge=1, le=MOST_LINES)
    seconds: Seconds | None = Field(default=None, gt=0)
    spatial_merge: int = Field(ge=1, le=2**16, description="N_m, side of a voxel in fine pixels")
    temporal_merge: int = Field(ge=1, le=2**40, description="T_m, sub-steps of a voxel")
    why: str = Field(default="", description="a comment; `--auto` states its reasons here")

    @model_validator(mode="after")
    def _one_length(self) -> SegmentPlan:
        given = [key for key in ("substeps", "lines", "seconds") if getattr(self, key) is not None]
        if len(given) > 1:
            raise ValueError(
                f"{' and '.join(given)} exclude each other; possible: one of substeps, lines or seconds"
            )
        return self

    @property
    def is_open(self) -> bool:
        """True if no length is given: the sub-segment then takes the rest."""
        return self.substeps is None and self.lines is None and self.seconds is None

    @property
    def length(self) -> str:
        """The length as text."""
        given = (("lines", self.lines), ("sub-steps", self.substeps), ("s", self.seconds))
        return next((f"{value:g} {unit}" for unit, value in given if value is not None), "the rest")

    def length_substeps(self, substeps_per_line: int, substep_s: float) -> int | None:
        """Return the length in whole sub-steps; None if it is open."""
        if self.lines is not None:
            return self.lines * substeps_per_line
        # A time below half a sub-step would otherwise round to a sub-segment of no length.
        return self.substeps if self.seconds is None else max(1, round(self.seconds / substep_s))


class ReconstructionPlan(FrozenModel):
    """The whole of a plan file."""

    title: str = ""
    ends: Literal["trusted", "whole"] = Field(
        default="trusted",
        description="'whole': also the frames that the first and the last lines sample only in part",
    )
    fade_substeps: int = Field(default=FADE_SUBSTEPS, ge=0, le=1_000_000)
    segments: tuple[SegmentPlan, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _only_the_last_is_open(self) -> ReconstructionPlan:
        names = [segment.name or f"segment {i}" for i, segment in enumerate(self.segments[:-1])]
        still_open = [name for name, segment in zip(names, self.segments, strict=False) if segment.is_open]
        if still_open:
            raise ValueError(f"{', '.join(still_open)} must have a length: only the last segment may omit it")
        return self
