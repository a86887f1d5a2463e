"""From a segment to a video: one function, the presets, and what comes back."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from acquire.errors import UsageError
from acquire.forward import DualArm
from acquire.geometry import is_integer
from acquire.recon.admm import Admm, AdmmParameters
from acquire.recon.band import InBasis, band_operator
from acquire.recon.basis import TemporalBasis
from acquire.recon.problem import pose
from acquire.recon.twist import Twist, TwistParameters

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon.problem import Operator, Problem

Solver = Literal["admm", "twist"]
Preset = Literal["fast", "balanced"]

ITERATIONS: dict[str, dict[str, int]] = {
    "admm": {"fast": 45, "balanced": 80},
    "twist": {"fast": 60, "balanced": 200},
}
"""Iterations per solver and preset. ADMM's are few on purpose: with this prior the best picture comes before
the minimum, which flattens fast modulation (semi-convergence)."""

BANDWIDTH = 0.13
"""Default temporal bandwidth as a share of the frames' Nyquist frequency: 6.5 kHz at 100 kHz sub-steps."""

FEWEST_COEFFICIENTS = 32
HOLD_OUT = 0.02


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a reconstruction stands after an iteration."""

    iteration: int
    iterations: int
    seconds: float


@dataclass(frozen=True, slots=True)
class Quality:
    """What can be said without the truth.

    ``misfit`` is the relative RMS residual of the samples used, ``prediction`` that of samples kept from the
    solver (NaN where none were), ``coverage`` the share of samples that were usable.
    """

    misfit: float
    prediction: float
    coverage: float


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """A reconstructed video and how it came about.

    ``video`` is (time, row, column) float32 in scene units, over the whole span; only the frames in
    ``trusted`` were sampled in full (Fig. 5). That interval is nominal: it follows from the geometry alone,
    whatever lines were lost, samples masked, or the code does; ``quality`` says how well it went.
    ``time_ns`` is the begin of each frame. Fewer ``iterations`` than ``iterations_asked``: the budget ended.
    """

    video: NDArray[np.float32]
    time_ns: NDArray[np.int64]
    trusted: slice
    seconds: float
    iterations: int
    iterations_asked: int
    solver: str
    quality: Quality
    parameters: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Request:
    """A checked call of `reconstruct`."""

    spatial_merge: int
    temporal_merge: int
    solver: Solver
    iterations: int
    bandwidth: float
    tv_weight: float | None
    budget_s: float | None

    def __post_init__(self) -> None:
        if not 0 < self.bandwidth <= 1:
            raise UsageError(f"bandwidth {self.bandwidth}", possible="more than 0, up to 1 (frames' Nyquist)")
        if self.tv_weight is not None and not 0 <= self.tv_weight < float("inf"):
            raise UsageError(f"TV weight {self.tv_weight}", possible="a finite number of at least 0")
        if self.budget_s is not None and not self.budget_s > 0:
            raise UsageError(f"budget of {self.budget_s} s", possible="more than 0")
        if not is_integer(self.iterations) or self.iterations < 1:
            raise UsageError(f"{self.iterations!r} iterations", possible="an integer of at least 1")


def reconstruct(
    segment: Segment,
    spatial_merge: int,
    temporal_merge: int,
    preset: Preset = "balanced",
    budget_s: float | None = None,
    progress: Callable[[Progress], None] | None = None,
    *,
    solver: Solver = "admm",
    bandwidth: float = BANDWIDTH,
    iterations: int | None = None,
    tv_weight: float | None = None,
    stop: Callable[[], bool] | None = None,
    observe: Callable[[Callable[[], NDArray[np.float32]]], None] | None = None,
) -> Reconstruction:
    """Reconstruct the voxels X′ of a segment at N_m = ``spatial_merge``, T_m = ``temporal_merge`` (Eq. 5).

    Parameters
    ----------
    segment : lines of both arms, code and mask; masked and non-finite samples have no influence
    preset : how many iterations
    budget_s : stop in time, before the preset's iterations if need be (at least one is made)
    progress : called after every iteration
    solver : ``"admm"`` (default) or ``"twist"``, the paper's, which knows neither bandwidth nor sign
    bandwidth : share of the frames' Nyquist frequency that the video may hold (ADMM)
    iterations, tv_weight : in place of the preset's and the solver's
    stop : asked after every iteration; once it says so, the best so far is the result
    observe : called after every iteration with a function that gives the video as it is now

    Raises
    ------
    UsageError : impossible merge, preset, solver, bandwidth or weight, or no usable sample
    NumericsError : a dark code, or iterates that are not finite
    """
    started = time.perf_counter()
    count = iterations if iterations is not None else _preset_iterations(solver, preset)
    request = Request(spatial_merge, temporal_merge, solver, count, bandwidth, tv_weight, budget_s)
    segment.geometry.check_merge(spatial_merge, temporal_merge)
    problem = pose(segment, spatial_merge, temporal_merge, hold_out=HOLD_OUT if solver == "admm" else 0.0)
    work = (_admm if solver == "admm" else _twist)(segment, problem, request)
    seen = partial(work.video, problem.scale)
    done = _iterate(work, request, started, _Watchers(progress, stop, observe and partial(observe, seen)))
    predicted = work.operator.forward(work.iterate.theta) / np.float32(problem.norm)
    return Reconstruction(
        video=work.video(problem.scale),
        time_ns=segment.frame_time_ns(temporal_merge),
        trusted=segment.geometry.trusted_frames(temporal_merge),
        seconds=time.perf_counter() - started,
        iterations=done,
        iterations_asked=request.iterations,
        solver=solver,
        quality=Quality(problem.misfit(predicted), problem.prediction_error(predicted), problem.coverage),
        parameters={
            "spatial_merge": spatial_merge,
            "temporal_merge": temporal_merge,
            "temporal_coefficients": work.basis.count,
            **asdict(work.parameters),
        },
    )


@dataclass(frozen=True, slots=True)
class _Work:
    """A solver set up on a problem."""

    iterate: Admm | Twist
    operator: Operator
    basis: TemporalBasis
    parameters: AdmmParameters | TwistParameters
    floor: float

    def video(self, scale: float) -> NDArray[np.float32]:
        video: NDArray[np.float32] = self.basis.synthesize(self.iterate.theta) * np.float32(scale)
        floored: NDArray[np.float32] = np.maximum(video, np.float32(self.floor))
        return floored


def _admm(segment: Segment, problem: Problem, request: Request) -> _Work:
    frames, side, _ = segment.geometry.video_shape(request.spatial_merge, request.temporal_merge)
    count = min(frames, max(FEWEST_COEFFICIENTS, round(request.bandwidth * frames)))
    basis = TemporalBasis(frames, count)
    operator = band_operator(
        segment.geometry, segment.code, basis, request.spatial_merge, request.temporal_merge
    )
    parameters = AdmmParameters()
    if request.tv_weight is not None:
        parameters = replace(parameters, tv_weight=request.tv_weight)
    iterate = Admm(problem.masked(operator), problem.used_samples, (count, side, side), basis, parameters)
    return _Work(iterate, operator, basis, parameters, floor=0.0)


def _twist(segment: Segment, problem: Problem, request: Request) -> _Work:
    dual_arm = DualArm(segment.geometry, segment.code, request.spatial_merge, request.temporal_merge)
    basis = TemporalBasis(dual_arm.video_shape[0], dual_arm.video_shape[0])
    operator = InBasis(dual_arm, basis)
    parameters = TwistParameters()
    if request.tv_weight is not None:
        parameters = replace(parameters, tv_weight=request.tv_weight)
    iterate = Twist(problem.masked(operator), problem.used_samples, dual_arm.video_shape, parameters)
    return _Work(iterate, operator, basis, parameters, floor=-np.inf)


@dataclass(frozen=True, slots=True)
class _Watchers:
    """Who looks on while a solver iterates."""

    progress: Callable[[Progress], None] | None
    stop: Callable[[], bool] | None
    observe: Callable[[], None] | None

    def call(self, progress: Progress) -> bool:
        """Tell everybody; whether to stop."""
        if self.progress is not None:
            self.progress(progress)
        if self.observe is not None:
            self.observe()
        return self.stop is not None and self.stop()


def _iterate(
    work: _Work,
    request: Request,
    started: float,
    watchers: _Watchers,
) -> int:
    """Iterate to the end or as far as the budget allows; the iterations made."""
    first = time.perf_counter()
    for iteration in range(1, request.iterations + 1):
        work.iterate.step()
        now = time.perf_counter()
        if watchers.call(Progress(iteration, request.iterations, now - started)):
            break
        per_iteration = (now - first) / iteration
        if request.budget_s is not None and now - started + per_iteration > request.budget_s:
            break
    return iteration


def _preset_iterations(solver: str, preset: str) -> int:
    if solver not in ITERATIONS:
        raise UsageError(f"solver {solver!r}", possible=", ".join(ITERATIONS))
    if preset not in ITERATIONS[solver]:
        raise UsageError(f"preset {preset!r}", possible=", ".join(ITERATIONS[solver]))
    return ITERATIONS[solver][preset]
