"""From a segment to a video: one function."""

from __future__ import annotations

import time
from contextlib import nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.arrays import Dtype, open_arrays
from acquire.cores import idle_cores, limit_threads
from acquire.recon.balance import balance_of, divided
from acquire.recon.clock import IterationClock
from acquire.recon.clues import AS_LONG_AS, estimate_error
from acquire.recon.denoisers import open_denoiser
from acquire.recon.faster import tell_faster_light
from acquire.recon.judge import frame_error, judge
from acquire.recon.least import check_budget, least_seconds
from acquire.recon.options import SolveOptions, Stop
from acquire.recon.problem import build_problem
from acquire.recon.result import Look, Progress, Quality, Reconstruction
from acquire.recon.solve import KnownImage
from acquire.recon.solver import Preset, Solver, open_solver, preset_iterations
from acquire.recon.told import Told, tell

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon.denoisers import Denoiser
    from acquire.recon.error import VideoError
    from acquire.recon.estimates import Estimate
    from acquire.recon.handed import Choice
    from acquire.recon.problem import Problem

HOLD_OUT = 0.08
"""Share of the samples kept from the default solver, to judge its prediction."""


def reconstruct(
    segment: Segment,
    spatial_merge: int,
    temporal_merge: int,
    preset: Preset = "balanced",
    budget_s: float | None = None,
    progress: Callable[[Progress], None] | None = None,
    *,
    solver: str = "admm",
    solver_options: Mapping[str, Any] | None = None,
    bandwidth: float | None = None,
    iterations: int | None = None,
    tv_weight: float | None = None,
    initial: NDArray[Any] | None = None,
    static_image: NDArray[Any] | None = None,
    denoiser: Denoiser | str | None = None,
    choice: Choice | None = None,
    dtype: Dtype = "float32",
    device: str = "cpu",
    stop: Stop | None = None,
    refuse: bool = True,
    look: Callable[[Look], object] | None = None,
    check: bool = True,
    error: bool = True,
) -> Reconstruction:
    """Reconstruct the voxels X′ of a segment at N_m = ``spatial_merge``, T_m = ``temporal_merge`` (Eq. 5).

    Parameters
    ----------
    segment : lines of both arms, code and mask; masked samples and outliers have no influence. Unless it is
        `balanced`, arms that get clearly different shares of the light are made equal, and it is said
    preset : how many iterations at most: ``"fast"``, ``"balanced"``, ``"best"``
    budget_s : the answer is there after so much wall time, within 10 % + 0.3 s, with fewer iterations than
        the preset's if need be (at least one is made). Compiling (once after installation) is no part of it
    progress : called after every iteration
    solver : ``"admm"`` (default), ``"twist"``, the paper's, which knows neither bandwidth nor sign, or
        ``"twist-band"``, which knows both; or one that is installed (``acquire plugins``)
    solver_options : of that solver, where it has some
    bandwidth : share of the frames' Nyquist frequency that the video may hold; found from the lines unless
        given (not TwIST)
    iterations, tv_weight : in place of the preset's and the solver's
    initial : a video (⌈T/T_m⌉, ⌈n/N_m⌉, ⌈n/N_m⌉) in scene units to start from: a warm start (ADMM)
    static_image : (n, n), the scene at rest: only its light s(t) is solved for, in any units
    denoiser : in place of total variation (ADMM), itself or the name of an installed one; see
        `acquire.recon.denoisers`
    choice : of prior, weight and band that another part of the scene led to, to be tried before all is
        searched (ADMM); see `acquire.recon.handed`
    dtype : of the video and all that leads to it; sums that need it are float64 anyway
    device : ``"cpu"`` or ``"gpu"``, where iterations are made; see `acquire.arrays`
    stop : asked after every iteration; once set, the best so far is returned
    refuse : a budget that cannot be kept here; else as little as possible is done
    check : where the lines are not explained, ask what would explain them (a second); see `recon.told`
    error : estimate how far the video is from the truth, for which up to 15 % of a budget are kept; see
        `recon.error`
    look : called after iterations, with what the answer would be if it ended there; its time does not count

    Raises
    ------
    UsageError : impossible merge, preset, solver, bandwidth, weight, array, dtype, device or budget; no
        usable sample
    NumericsError : a dark code, or iterates that are not finite
    """
    began = time.monotonic()
    chosen = open_solver(solver, solver_options)
    count = preset_iterations(solver, preset)
    if iterations is not None:
        count = iterations
    options = SolveOptions(
        spatial_merge,
        temporal_merge,
        solver,
        count,
        bandwidth,
        tv_weight,
        budget_s,
        initial,
        static_image,
        open_denoiser(denoiser) if isinstance(denoiser, str) else denoiser,
        choice,
    )
    arrays = open_arrays(device, dtype)
    options.check_shapes(segment.geometry.size, segment.geometry.video_shape(spatial_merge, temporal_merge))
    clock = IterationClock(count, budget_s, progress, stop, began)
    segment, warnings, balance = _balanced(segment)
    held_out = HOLD_OUT if chosen.holds_out and static_image is None else 0.0
    # threads that wait for a core that others use make times that nobody can foresee
    with limit_threads(idle_cores()) if budget_s is not None else nullcontext():
        if budget_s is not None and refuse and arrays.compiled:
            least_s = least_seconds(segment.geometry, spatial_merge, temporal_merge, solver)
            check_budget(clock, budget_s, least_s)
        problem = build_problem(segment, spatial_merge, temporal_merge, hold_out=held_out, arrays=arrays)
        if error and chosen.goes_on and static_image is None:
            clock.reserve(AS_LONG_AS)
        if look is not None:
            clock.looks = _looking(look, problem, chosen)
        estimate = _solve(segment, problem, options, chosen, clock)
        # A number of iterations that was asked for cuts as a budget does; with a preset's, solvers are about
        # where they would end.
        cut = clock.ended == "budget" or (clock.ended == "done" and iterations is not None)
        result = _finish(
            segment, problem, options, chosen, estimate, clock, check=check, error=error, cut=cut
        )
    return replace(
        result,
        warnings=(*warnings, *result.warnings),
        parameters={**result.parameters, **({} if balance is None else {"balance": balance})},
    )


def _balanced(segment: Segment) -> tuple[Segment, tuple[str, ...], dict[str, Any] | None]:
    """The segment with arms of the same light, what to say of it, and what was found, as JSON."""
    balance = None if segment.balanced else balance_of([segment])
    if balance is None:
        return segment, (), None
    if not balance.clear:
        return segment, (), balance.facts(corrected=False)
    return divided(segment, balance), (balance.corrected_words,), balance.facts(corrected=True)


def _solve(
    segment: Segment, problem: Problem, options: SolveOptions, solver: Solver, clock: IterationClock
) -> Estimate:
    if options.static_image is not None:
        return KnownImage(segment, problem, options, np.asarray(options.static_image), clock)
    return solver.solve(segment, problem, options, clock)


def _looking(look: Callable[[Look], object], problem: Problem, solver: Solver) -> Callable[[Look], object]:
    """``look`` for videos in scene units."""
    return lambda seen: look(replace(seen, video=lambda: _scaled(seen.video(), problem, solver)))


def _scaled(video: NDArray[Any], problem: Problem, solver: Solver) -> NDArray[Any]:
    """In scene units, and not negative where the solver knows the sign."""
    video = video * problem.scale
    return video if solver.signed else np.maximum(video, 0, out=video)


def _error(
    segment: Segment,
    problem: Problem,
    options: SolveOptions,
    estimate: Estimate,
    video: NDArray[Any],
    quality: Quality,
    clock: IterationClock,
    told: Told,
    faster: tuple[str, ...],
    *,
    cut: bool,
) -> VideoError | str:
    """Not of what the lines contradict: what it is estimated from shows nothing of either."""
    if not told.believed:
        return "the lines are not what is said of them"
    if faster:
        return "light changes faster than the video resolves"
    if clock.ended == "stopped":
        return "the reconstruction was stopped"
    merges = (options.spatial_merge, options.temporal_merge)
    return estimate_error(segment, problem, estimate, video, quality, merges, clock, cut=cut)


def _finish(
    segment: Segment,
    problem: Problem,
    options: SolveOptions,
    solver: Solver,
    estimate: Estimate,
    clock: IterationClock,
    *,
    check: bool,
    error: bool,
    cut: bool,
) -> Reconstruction:
    T_m = options.temporal_merge
    predicted = estimate.predict()
    video = _scaled(estimate.video(), problem, solver)
    held_out = estimate.held_out_error
    prediction = problem.prediction_error(predicted) if held_out is None else held_out
    noise = problem.noise(segment)
    quality = Quality(problem.misfit(predicted), prediction, problem.coverage, noise)
    trusted = segment.geometry.trusted_frames(T_m)
    asked = check and options.static_image is None and clock.ended != "stopped"
    told = tell(segment, quality, clock) if asked else Told()
    facts = estimate.facts()
    cosines = facts.get("temporal_coefficients", len(video))
    resolved_hz = cosines / (2e-9 * segment.substep_ns * T_m * len(video))
    faster: tuple[str, ...] = ()
    if asked and told.believed:
        faster = tell_faster_light(segment, problem, predicted, video, resolved_hz, clock)
    off: VideoError | str = "it was not asked for"
    if error:
        off = _error(segment, problem, options, estimate, video, quality, clock, told, faster, cut=cut)
    return Reconstruction(
        video=video,
        time_ns=segment.frame_time_ns(T_m),
        trusted=trusted,
        seconds=clock.seconds,
        compiled_s=clock.compiled_s,
        processor_s=clock.processor_s,
        iterations=clock.made,
        iterations_asked=clock.iterations,
        solver=options.solver,
        quality=quality,
        frame_error=frame_error(problem, predicted, segment.geometry, T_m),
        error=off,
        ended=clock.ended,
        believed=told.believed,
        masked=problem.masked_by,
        warnings=(*judge(segment, problem, quality, trusted), *told.warnings, *faster, *clock.shortcuts),
        parameters={
            "spatial_merge": options.spatial_merge,
            "temporal_merge": T_m,
            "dtype": problem.arrays.dtype,
            **solver.model_dump(mode="json"),
            **facts,
            "resolved_hz": resolved_hz,
        },
    )
