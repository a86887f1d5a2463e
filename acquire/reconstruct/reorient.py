"""A calibration whose arms have been turned or mirrored since it was made.

Offsets and gains belong to the cameras' pixels and stay with them. The alignment belongs to the arrangement:
whichever arm was turned, it holds in another frame, mirrored or turned by right angles, or the other way
round if the arms are exchanged. Which one is not known beforehand, but there are few, and the lines show it:
where arm B is laid correctly, what one arm saw predicts the other best.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from acquire.alignment import Alignment
from acquire.calibrate import AlignmentFound, calibrated
from acquire.calibrate.apply import belongs_to_flat
from acquire.cores import limit_threads
from acquire.recon.diagnosis import undo_turn
from acquire.recon.hypotheses import Hypothesis, LineModel
from acquire.recon.search import CLEAR

if TYPE_CHECKING:
    from acquire.calibrate import Calibration
    from acquire.lines import Segment
    from acquire.recon.hypotheses import Turn

ALIKE = 0.3
"""Fine pixels, in the field's corner, by which two alignments differ that the lines need not distinguish."""


@dataclass(frozen=True, slots=True)
class Reoriented:
    """A calibration for turned arms; ``lost``, in words, what it had of the arms as they were before."""

    calibration: Calibration
    lost: tuple[str, ...] = ()

    @property
    def aligned(self) -> bool:
        """Whether the lines show where arm B lies now."""
        return self.calibration.alignment is not None

    @property
    def words(self) -> str:
        """What of the calibration is used, and what is not."""
        used = "its offsets and gains belong to the cameras' pixels, and stay"
        if self.aligned:
            used += "; its alignment was turned with the arms, as the lines show"
        if not self.lost:
            return used
        return (
            f"{used}; not used: {' and '.join(self.lost)}, since the lines do not show where it is now "
            "(`acquire calibrate orientation` and `align` measure it, with a target)"
        )


def reoriented(segment: Segment, calibration: Calibration, turn: Turn) -> Reoriented:
    """Return the calibration for arms that are ``turn``-ed against it, judged by a segment as recorded.

    Its alignment is that of the arms after `acquire.recon.diagnosis.undo_turn`.
    """
    rest = {name: each for name, each in calibration.quantities.items() if name != "shading"}
    lost = ("the lens's light",) if belongs_to_flat(calibration) else ()
    bare, found = replace(calibration, alignment=None, quantities=rest), calibration.alignment
    if found is None:
        return Reoriented(bare, lost)
    with limit_threads(1):
        alignment = _clearest(undo_turn(calibrated(segment, bare), turn), found.alignment)
    if alignment is None:
        return Reoriented(bare, ("the alignment", *lost))
    return Reoriented(replace(bare, alignment=AlignmentFound(alignment, found.uncertainty)), lost)


def arrangements(alignment: Alignment) -> list[Alignment]:
    """Return the alignment in every frame that right angles and mirrors lead to, and with exchanged arms."""
    shift = np.array([alignment.rows, alignment.columns])
    inverse = np.linalg.inv(alignment.matrix) @ -shift
    found = []
    # The inverse of a distortion is its opposite, to the first order: a tenth of a pixel at 2 %.
    for turn_deg, magnification, distortion, moved in (
        (alignment.turn_deg, alignment.magnification, alignment.distortion, shift),
        (-alignment.turn_deg, 1 / alignment.magnification, -alignment.distortion, inverse),
    ):
        for quarter in range(4):
            angle = quarter * np.pi / 2
            rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            rows, columns = (rotation @ moved).tolist()
            # a mirrored frame turns the other way
            found.append(Alignment(rows, columns, turn_deg, magnification, distortion))
            found.append(Alignment(rows, -columns, -turn_deg, magnification, distortion))
    return found


def _clearest(segment: Segment, alignment: Alignment) -> Alignment | None:
    """Return the arrangement with which the arms predict each other best; None if others do as well."""
    model, size = LineModel(segment), segment.geometry.size
    model.fit_prior()

    def gain(each: Alignment | None) -> float:
        model.alignment = each
        return float(model.evidence(Hypothesis()).mutual.sum())

    gains = {each: gain(each) for each in arrangements(alignment)}
    best = max(gains, key=lambda each: gains[each])
    corners = (np.array([[[-1.0, -1, 1, 1]], [[-1.0, 1, -1, 1]]])) * size / 2
    where = best.to_b(corners, size / 2)
    others = [gains[each] for each in gains if np.abs(each.to_b(corners, size / 2) - where).max() > ALIKE]
    rival = max([gain(None), *others])
    return best if gains[best] > rival + CLEAR else None
