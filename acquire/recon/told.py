"""What a reconstruction says where its lines are not explained: which description would explain them.

Asked only where lines are missed by more than noise-free ones are: good runs cost nothing more.
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
"""Of the lines, missed: wrong descriptions end at 2 to 7 %, and so do right ones with a camera's noise."""
SECONDS = 2.0
"""Of wall time that a diagnosis takes: a budget with less left is kept instead."""


@dataclass(frozen=True, slots=True)
class Told:
    """``believed``: nothing says that the segment is not what its description says."""

    warnings: tuple[str, ...] = ()
    believed: bool = True


def tell(segment: Segment, quality: Quality, clock: IterationClock) -> Told:
    """The description that explains the lines better than the segment's own, where one does."""
    missed = float(np.nanmax([quality.misfit, quality.prediction]))
    if not missed > SUSPICIOUS or not clock.affords(SECONDS):
        return Told()
    found = diagnose(segment)
    believed = found.standing in (Standing.RIGHT, Standing.UNCLEAR)
    words = found.sentences
    if found.standing is Standing.RIGHT and missed > POOR_MISFIT:
        words += (
            "code, its place and the arms' orientation are borne out by the lines: more iterations, smaller "
            "voxels or a higher bandwidth may explain them",
        )
    return Told(words, believed)
