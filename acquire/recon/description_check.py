"""Check of a segment's description where its lines are not explained: which description would explain them.

It runs only where the residual exceeds that of noise-free lines, so that good reconstructions cost nothing
more.
"""

from __future__ import annotations

import math
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
PREDICTED_NOISE = 0.03
"""Relative noise up to which the held-out samples show that a code is not foreign. What is missed beyond the
noise is a difference of squares: at this noise, a figure of it that is a tenth too large hides 1.4 % of the
light, less than a foreign code misses. In less light, a foreign code's lines would look predicted, too."""
DIAGNOSIS_S = 2.0
"""Wall time of a diagnosis: if the budget has less left, the budget is kept and the check is skipped."""


@dataclass(frozen=True, slots=True)
class DescriptionCheck:
    """``believed`` unless the lines contradict the segment's description."""

    warnings: tuple[str, ...] = ()
    believed: bool = True


def check_description(segment: Segment, quality: Quality, clock: IterationClock) -> DescriptionCheck:
    """Find a description that explains the lines better than the segment's own, if there is one."""
    # Very few lines have no held-out samples, and a prediction that is NaN.
    residual = float(np.nanmax([quality.misfit, quality.prediction]))
    if not residual > SUSPICIOUS or not clock.affords(DIAGNOSIS_S):
        return DescriptionCheck()
    found = diagnose(segment)
    # Some right descriptions are unclear: what is uncertain is not a contradiction.
    believed = found.standing in (Standing.RIGHT, Standing.UNCLEAR)
    words = found.sentences
    # The used samples would not do: a video has voxels enough to follow their noise.
    predicted = (
        0 < quality.noise <= PREDICTED_NOISE
        and not math.isnan(quality.prediction)
        and quality.prediction**2 - quality.noise**2 < SUSPICIOUS**2
    )
    if found.standing is Standing.UNEXPLAINED and predicted:
        # The video shows what the diagnosis, whose model is simpler, could not: the code does explain them.
        words, believed = tuple(each for each in words if each != found.sentence), True
    if found.standing is Standing.RIGHT and residual > POOR_MISFIT:
        words += (
            "the lines confirm the code, its position and the arms' orientation: more iterations, smaller "
            "voxels or a higher bandwidth may explain them",
        )
    return DescriptionCheck(words, believed)
