"""Check of a segment's description where its lines are not explained: which description would explain them.

It runs only where the residual exceeds that of noise-free lines, so that good reconstructions cost nothing
more.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from acquire.recon.diagnosis import diagnose
from acquire.recon.judge import POOR_MISFIT
from acquire.recon.search import Standing

if TYPE_CHECKING:
    from acquire.lines import Segment
    from acquire.recon.clock import IterationClock
    from acquire.recon.result import Quality

SUSPICIOUS = 0.01
"""Relative residual above which the check runs: wrong descriptions end at 2 to 7 %, and so do right ones with
a camera's noise."""
SECONDS = 2.0
"""Wall time of a diagnosis: if the budget has less left, the budget is kept and the check is skipped."""


@dataclass(frozen=True, slots=True)
class DescriptionCheck:
    """``believed`` unless the lines contradict the segment's description."""

    warnings: tuple[str, ...] = ()
    believed: bool = True


def check_description(segment: Segment, quality: Quality, clock: IterationClock) -> DescriptionCheck:
    """Find a description that explains the lines better than the segment's own, if there is one."""
    # very few lines have no held-out samples, and a prediction that is NaN
    residual = float(np.nanmax([quality.misfit, quality.prediction]))
    if not residual > SUSPICIOUS or not clock.affords(SECONDS):
        return DescriptionCheck()
    found = diagnose(segment)
    # some right descriptions are unclear: what is uncertain is not a contradiction
    believed = found.standing in (Standing.RIGHT, Standing.UNCLEAR)
    words = found.sentences
    if found.standing is Standing.RIGHT and residual > POOR_MISFIT:
        words += (
            "the lines confirm the code, its position and the arms' orientation: more iterations, smaller "
            "voxels or a higher bandwidth may explain them",
        )
    return DescriptionCheck(words, believed)
