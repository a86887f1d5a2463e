"""Shortest possible duration of a reconstruction on this machine, so that an impossible budget is refused.

The work that every solver does whatever its iterations (the operator's norm, one iteration, the video) scales
with one pass of the operator over all lines. A pass over some lines of the same geometry is timed under the
machine's present load and multiplied by the number of passes that this work was measured to take.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from acquire.cores import slowness
from acquire.errors import UsageError
from acquire.forward import DualArm
from acquire.geometry import Geometry
from acquire.plugins import SOLVERS

if TYPE_CHECKING:
    from acquire.recon.clock import IterationClock

PROBED_SHARE = 6
"""The timed pass covers one sixth of the lines."""
PROBE_S = 0.005
"""Processor time for which the pass is repeated."""
OVERRUN_SHARE, OVERRUN_S = 0.1, 0.3
"""A budget may be exceeded by this share of it plus this many seconds."""


def least_seconds(geometry: Geometry, spatial_merge: int, temporal_merge: int, solver: str) -> float:
    """Wall time of the shortest reconstruction of such a segment, within a factor of two."""
    few = Geometry(geometry.stages, geometry.substeps, max(1, geometry.lines // PROBED_SHARE))
    code = np.random.default_rng(0).integers(0, 2, few.span).astype(np.uint8)
    # A sixth of the lines may be shorter than a voxel.
    operator = DualArm(few, code, spatial_merge, min(temporal_merge, few.span))
    video = np.ones(operator.video_shape, np.float32)
    operator.adjoint(operator.forward(video))  # loads the compiled loops
    # A busy machine does not stretch processor time; `slowness` says by how much wall time is longer.
    used, passes = time.thread_time(), 0
    while passes < 1 or time.thread_time() - used < PROBE_S:
        operator.adjoint(operator.forward(video))
        passes += 1
    once_s = (time.thread_time() - used) / passes
    passes_of_all: float = SOLVERS.load(solver).passes
    return passes_of_all * once_s * geometry.lines / few.lines * slowness()


def check_budget(clock: IterationClock, budget_s: float, least_s: float) -> None:
    """Raise UsageError unless ``budget_s`` can be kept when the remaining work takes ``least_s``."""
    needed = clock.seconds + least_s
    if needed > (1 + OVERRUN_SHARE) * budget_s + OVERRUN_S:
        raise UsageError(
            f"a budget of {budget_s:g} s cannot be kept: this segment needs at least {needed:.2g} s here",
            possible="a longer budget, fewer lines, larger voxels, or a machine that is less busy",
        )
