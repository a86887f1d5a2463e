"""The USAF 1951 resolution target in its true geometry, and scenes of one driven picture.

Element e of group g has f = 2^(g + (e − 1)/6) line pairs per mm (MIL-STD-150A): three horizontal and three
vertical bars, each w = 1/(2f) wide, 5w long and w apart. Groups come in pairs, each a quarter of the size of
the pair around it::

      ┌ g, 2 ─ 6 down ┐  the next pair,   ┌ g + 1, 1 ─ 6 ┐
      │               │  4 × smaller      │ down         │
      └               ┘         ■   g, 1  └              ┘

Bars are rectangles along the axes, so the covered fraction of a pixel is exact: the product of two overlaps.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field, model_validator

from acquire.config.scene import ConstantDrive, DriveConfig
from acquire.sim.drives import mean_drive
from acquire.sim.scene import MaskScene, SceneModel

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from acquire.sim.drives import Drive


class UsafSceneConfig(SceneModel):
    """USAF 1951 target (MIL-STD-150A): bars of 1/(2·2^(g + (e − 1)/6)) mm, bright on dark (Fig. 6, 8, 11)."""

    kind: Literal["usaf"]
    field_mm: float = Field(default=6.4, gt=0, description="side of the scene in the target's plane")
    groups: tuple[int, ...] = Field(
        default=(2, 3, 4, 5), min_length=1, description="pairs of groups, the outermost even one first"
    )
    dark: float = Field(default=0.0, ge=0, le=1, description="light between the bars")
    drive: DriveConfig = ConstantDrive(waveform="constant")

    @model_validator(mode="after")
    def _pairs(self) -> UsafSceneConfig:
        first = self.groups[0]
        if first % 2 or list(self.groups) != list(range(first, first + len(self.groups))):
            raise ValueError("groups must count upwards from an even one, as in 2, 3, 4, 5")
        return self

    def build(self, size: int, substep_s: float) -> TargetScene:
        picture = usaf_picture(self.groups, size, self.field_mm, self.dark)
        return TargetScene(picture, self.drive, substep_s)


@dataclass(frozen=True, slots=True)
class Bar:
    """A bright rectangle of the target, in mm from its centre; rows count downwards."""

    group: int
    element: int
    _: KW_ONLY
    top: float
    left: float
    height: float
    width: float


def line_pairs_per_mm(group: int, element: int) -> float:
    """f = 2^(g + (e − 1)/6)."""
    return float(2 ** (group + (element - 1) / 6))


def bar_width_mm(group: int, element: int) -> float:
    """w = 1 / (2f)."""
    return 0.5 / line_pairs_per_mm(group, element)


def usaf_bars(groups: tuple[int, ...]) -> list[Bar]:
    """Return all bars of the groups, which count upwards from an even one."""
    bars: list[Bar] = []
    for group in groups[::2]:
        # A pair of groups: the even one, and around the next pair the odd one next to it. Lengths are in
        # units of the bar width of (g, 1).
        unit = bar_width_mm(group, 1)
        left, right, top, bottom = -18.5 * unit, 10.0 * unit, -17.5 * unit, 11.0 * unit
        row = top
        for element in range(2, 7):
            bars += _element(group, element, row, left)
            row += 7.3 * bar_width_mm(group, element)
        bars += _element(group, 1, bottom, -1.0 * unit)
        # the square of the standard's layout, which is no element
        bars.append(Bar(group, 0, top=bottom, left=-10.5 * unit, height=5 * unit, width=5 * unit))
        row = top
        for element in range(1, 7) if group + 1 in groups else ():
            bars += _element(group + 1, element, row, right)
            row += 8.5 * bar_width_mm(group + 1, element)
    return bars


def usaf_picture(
    groups: tuple[int, ...], size: int, field_mm: float, dark: float = 0.0
) -> NDArray[np.float32]:
    """Return the light of the target in the middle of a field, as exact means over pixels: (size, size)."""
    covered = np.zeros((size, size))
    for bar in usaf_bars(groups):
        rows = overlap(size, (bar.top / field_mm + 0.5), bar.height / field_mm)
        columns = overlap(size, (bar.left / field_mm + 0.5), bar.width / field_mm)
        covered += rows[:, None] * columns
    picture: NDArray[np.float32] = (dark + (1 - dark) * covered).astype(np.float32)
    return picture


def overlap(size: int, begin: float, length: float) -> NDArray[np.float64]:
    """Return the fraction of each of ``size`` equal pixels of 0 … 1 that begin … begin + length covers."""
    # clipped to the bar, each pixel's two edges are as far apart as they are covered
    edges = np.clip(np.arange(size + 1) / size, begin, begin + length)
    return np.diff(edges) * size


class TargetScene(MaskScene):
    """One picture (n, n) with a single drive."""

    def __init__(self, picture: NDArray[np.float32], drive: Drive, substep_s: float) -> None:
        self.masks = picture[None]
        self._drive, self._substep_s = drive, substep_s

    def intensity(self, first: int, count: int, substep_s: float | None = None) -> NDArray[np.float64]:
        """Return the intensity of the picture: (1, count)."""
        return mean_drive(self._drive, first, count, substep_s or self._substep_s)[None]


def _element(group: int, element: int, top: float, left: float) -> Iterator[Bar]:
    """Three vertical bars, and three horizontal ones to the right of them."""
    w = bar_width_mm(group, element)
    for k in range(3):
        yield Bar(group, element, top=top, left=left + 2 * k * w, height=5 * w, width=w)
        yield Bar(group, element, top=top + 2 * k * w, left=left + 7 * w, height=w, width=5 * w)
