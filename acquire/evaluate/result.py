"""The result of a demo run: the facts behind the report, independent of how they are shown.

:class:`DemoResult` holds the arrays and facts of one run and checks that they fit together;
:func:`evaluate_solver` prepares each reconstruction for it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import UsageError
from acquire.evaluate import metrics
from acquire.evaluate.curves import CurveComparison, compare_curve, region_mean
from acquire.lines import ARMS

if TYPE_CHECKING:
    from collections.abc import Mapping
    from datetime import datetime
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.evaluate.host import Busyness
    from acquire.lines import Segment


@dataclass(frozen=True, slots=True)
class RigFacts:
    """The rig of the recording. ``code`` and ``scene`` are one line of text each."""

    name: str
    code: str
    scene: str
    simulated: bool


@dataclass(frozen=True, slots=True)
class ArmAccount:
    """Account of one arm's lines since it was armed.

    The camera ``delivered`` lines, of which ``preroll`` were exposed before the start and ``discarded``
    arrived while nothing was recorded; ``lost`` counts lost lines by cause. The recording has ``recorded``
    rows, of which ``missing`` hold no line. At most ``ring_peak`` of ``ring_slots`` blocks were waiting in
    the ring.
    """

    delivered: int
    preroll: int
    discarded: int
    recorded: int
    missing: int
    ring_peak: int
    ring_slots: int
    lost: Mapping[str, int] = field(default_factory=dict)

    @property
    def lost_lines(self) -> int:
        """Lines lost for any cause."""
        return sum(self.lost.values())


@dataclass(frozen=True, slots=True)
class CaptureFacts:
    """The recording and how it was made; ``arms`` maps each arm to its ledger."""

    recording: Path
    condition: str
    end_reason: str
    seconds: float
    size_bytes: int
    arms: Mapping[str, ArmAccount]


# Not compared by value: `==` of two arrays is an array.
@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """An area whose intensity is evaluated: ``mask`` (row, column) bool, ``theory`` (t,) in the scene's
    units.

    ``set_hz`` is the frequency set in the scene, None for a constant.
    """

    name: str
    mask: NDArray[np.bool_]
    theory: NDArray[np.float64]
    set_hz: float | None = None


@dataclass(frozen=True, slots=True)
class TimedStep:
    """One step of the run and its duration."""

    name: str
    seconds: float
    detail: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class SolverResult:
    """One reconstruction of the segment, compared with the truth by :func:`evaluate_solver`.

    ``video`` (t, row, column) and ``psnr_per_frame`` (t,) cover the trusted frames only; ``curves`` has one
    entry per region. With fewer ``iterations`` than ``requested_iterations`` the solver was stopped by
    ``budget_s``, so the result does not show what it can reach.
    """

    label: str
    video: NDArray[Any]
    seconds: float
    iterations: int
    requested_iterations: int
    budget_s: float | None
    psnr_db: float
    ssim: float
    psnr_per_frame: NDArray[np.float64]
    curves: tuple[CurveComparison, ...]


def evaluate_solver(
    label: str,
    video: NDArray[Any],
    truth: NDArray[Any],
    regions: tuple[Region, ...],
    frame_interval_s: float,
    *,
    seconds: float,
    iterations: int,
    requested_iterations: int,
    budget_s: float | None = None,
) -> SolverResult:
    """Compare the trusted frames of a reconstruction with the truth. Raises as the metrics and fits do."""
    return SolverResult(
        label=label,
        video=video,
        seconds=seconds,
        iterations=iterations,
        requested_iterations=requested_iterations,
        budget_s=budget_s,
        psnr_db=metrics.psnr(video, truth),
        ssim=metrics.ssim(video, truth),
        psnr_per_frame=metrics.psnr_per_frame(video, truth),
        curves=tuple(
            compare_curve(region.name, region.theory, region_mean(video, region.mask), frame_interval_s)
            for region in regions
        ),
    )


@dataclass(frozen=True, slots=True, eq=False)
class DemoResult:
    """Everything that the report shows.

    ``frame_time_ns`` (t,) are the UTC times of the trusted frames, the frames of ``truth`` and of every
    solver's video; ``start_ns`` is the time of the recording's first line, from which the figures count.
    ``solvers[0]`` is the default solver, which the headline quotes; ``host`` is the load of the machine.
    Raises UsageError if the arrays do not fit together.
    """

    title: str
    when: datetime
    command: str
    seed: int
    rig: RigFacts
    capture: CaptureFacts
    segment: Segment
    start_ns: int
    frame_time_ns: NDArray[np.int64]
    truth: NDArray[Any]
    solvers: tuple[SolverResult, ...]
    regions: tuple[Region, ...]
    stages: tuple[TimedStep, ...]
    host: Busyness

    def __post_init__(self) -> None:
        frames = len(self.frame_time_ns)
        # The interval of the frames, a fact of the report, takes two.
        if self.truth.ndim != 3 or self.truth.shape[0] != frames or frames < 2:
            raise UsageError(
                f"a report cannot have a truth {self.truth.shape} with {frames} time stamps",
                possible="2 or more frames (time, row, column), with one time stamp each",
            )
        if not self.solvers:
            raise UsageError("a report needs a reconstruction", possible="one or more")
        if set(self.capture.arms) != set(ARMS):
            raise UsageError(
                f"a report cannot have ledgers of {sorted(self.capture.arms)}", possible=f"{list(ARMS)}"
            )
        for region in self.regions:
            found = (region.mask.shape, region.theory.shape)
            self._check(f"region {region.name!r}", found, (self.truth.shape[1:], (frames,)))
        for solver in self.solvers:
            names = tuple(curve.name for curve in solver.curves)
            expected = (self.truth.shape, tuple(region.name for region in self.regions))
            self._check(f"solver {solver.label!r}", (solver.video.shape, names), expected)

    @staticmethod
    def _check(what: str, found: tuple[Any, ...], expected: tuple[Any, ...]) -> None:
        if found != expected:
            raise UsageError(
                f"a report cannot have {what} with {found}", possible=f"{expected}, like the truth"
            )

    @property
    def frame_ms(self) -> NDArray[np.float64]:
        """Time of each frame after the recording's first line."""
        return (self.frame_time_ns - self.start_ns) / 1e6

    @property
    def line_ms(self) -> NDArray[np.float64]:
        """Start of each line's read-out, after the recording's first line."""
        return (self.segment.time_ns - self.start_ns) / 1e6

    @property
    def frame_interval_us(self) -> float:
        """Mean time from one frame to the next."""
        return float(np.diff(self.frame_ms).mean()) * 1e3

    @property
    def peak(self) -> float:
        """Brightest value of the truth, which the figures show as white."""
        return metrics.checked_peak(self.truth)
