"""Reconstruction of a segment to a video, in one function."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.arrays import Dtype, open_arrays
from acquire.cores import granted_threads, idle_cores, limit_blas, limit_threads
from acquire.errors import UsageError
from acquire.lines import Segment
from acquire.recon.aliasing import detect_unresolved_light, name_gaps
from acquire.recon.balance import balance_of, divided
from acquire.recon.basis import cosine_hz
from acquire.recon.clock import IterationClock
from acquire.recon.cycle import describe_cycle
from acquire.recon.denoisers import open_denoiser
from acquire.recon.description_check import DescriptionCheck, check_description
from acquire.recon.error_estimation import RESERVED_ITERATIONS, estimate_error
from acquire.recon.estimates import checked_answer
from acquire.recon.feasibility import check_budget, least_seconds
from acquire.recon.given import Given
from acquire.recon.judge import frame_error, judge
from acquire.recon.options import SolveOptions, Stop, check_hooks, check_table
from acquire.recon.problem import build_problem
from acquire.recon.result import Look, Progress, Quality, Reconstruction
from acquire.recon.solve import KnownImage
from acquire.recon.solver import Preset, Solver, open_solver, preset_iterations
from acquire.recon.unseen import trusted_frames

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from acquire.recon.denoisers import Denoiser
    from acquire.recon.error import VideoError
    from acquire.recon.estimates import Estimate
    from acquire.recon.reuse import Choice

HOLD_OUT = 0.08
"""Share of the samples that are held out, to judge a solver by its prediction."""


def reconstruct(
    segment: Segment,
    spatial_merge: int,
    temporal_merge: int,
    preset: Preset = "balanced",
    *,
    budget_s: float | None = None,
    progress: Callable[[Progress], None] | None = None,
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
        `balanced`, arms that get clearly different shares of the light are balanced, with a warning
    preset : limit on the iterations of each stage: ``"fast"``, ``"balanced"``, ``"best"``
    budget_s : wall time within which the answer is returned, exceeded by at most 10 % + 0.3 s, with fewer
        iterations than the preset's if necessary (at least one). Compilation (once after installation) is not
        part of it
    progress : called after every iteration
    solver : ``"admm"`` (default), ``"twist"``, the paper's, which uses neither bandwidth nor sign, or
        ``"twist-band"``, which uses both; or an installed one (``acquire plugins``)
    solver_options : options of that solver, if it has any
    bandwidth : share of the frames' Nyquist frequency that the video may hold; estimated from the lines if
        None (not TwIST)
    iterations, tv_weight : override the preset's and the solver's
    initial : a video (⌈T/T_m⌉, ⌈n/N_m⌉, ⌈n/N_m⌉) in scene units to start from: a warm start (ADMM)
    static_image : (n, n), the scene at rest, in any units: only its light s(t) is solved for
    denoiser : replaces total variation (ADMM); an object, or the name of an installed one; see
        `acquire.recon.denoisers`
    choice : prior, weight and band chosen on another part of the scene, to be tried before a full search
        (ADMM); see `acquire.recon.reuse`
    dtype : of the video and the iterates; sums that need float64 use it anyway
    device : ``"cpu"`` or ``"gpu"``, where the iterations run; see `acquire.arrays`
    stop : checked after every iteration; once it is set, the best estimate so far is returned
    refuse : refuse a budget that cannot be kept on this machine; otherwise do as little as possible
    check : if the lines are not explained, find out what would explain them (a second); see
        `acquire.recon.description_check`
    error : estimate how far the video is from the truth, for which up to 15 % of a budget are reserved; see
        `acquire.recon.error`
    look : called after iterations with the answer so far; its time does not count

    Raises
    ------
    UsageError : impossible merge, preset, solver, bandwidth, weight, array, dtype, device or budget; no
        usable sample
    NumericsError : a dark code, or iterates that are not finite
    """
    # A budget covers the whole call.
    began = time.monotonic()
    if not isinstance(segment, Segment):
        raise UsageError(
            f"a {type(segment).__name__} cannot be reconstructed",
            possible="a segment of a recording",
            hint="recording.cut(first_line=..., lines=...)",
        )
    check_hooks(stop, progress=progress, look=look)
    check_table("solver_options", solver_options)
    chosen = open_solver(solver, solver_options)
    count = preset_iterations(solver, preset)
    if iterations is not None:
        count = iterations
    options = SolveOptions(
        spatial_merge=spatial_merge,
        temporal_merge=temporal_merge,
        solver=solver,
        iterations=count,
        bandwidth=bandwidth,
        tv_weight=tv_weight,
        budget_s=budget_s,
        initial=initial,
        static_image=static_image,
        denoiser=open_denoiser(denoiser) if isinstance(denoiser, str) else denoiser,
        choice=choice,
    )
    arrays = open_arrays(device, dtype)
    options.check_shapes(segment.geometry.size, segment.geometry.video_shape(spatial_merge, temporal_merge))
    clock = IterationClock(count, budget_s, progress, stop, began)
    segment, balance_warnings, balance_facts = _balanced(segment)
    held_out = HOLD_OUT if chosen.holds_out and static_image is None else 0.0
    # BLAS's threads busy-wait for a core that others use; the arms are computed side by side instead.
    threads = 1 if granted_threads() == 1 else idle_cores()
    with limit_threads(threads), limit_blas(1):
        # The probe times the compiled loops, which tell nothing about other arrays.
        if budget_s is not None and refuse and arrays.compiled:
            least_s = least_seconds(segment.geometry, spatial_merge, temporal_merge, solver)
            check_budget(clock, budget_s, least_s)
        # It comes after the check, because posing the problem (the operator's norm) takes time itself.
        problem = build_problem(segment, spatial_merge, temporal_merge, hold_out=held_out, arrays=arrays)
        given = Given(segment, problem, options, clock)
        run = _Run(given, chosen)
        # The time is reserved before the solver runs, which would otherwise use the whole budget.
        if error and chosen.goes_on and static_image is None:
            clock.reserve(RESERVED_ITERATIONS)
        if look is not None:
            clock.on_look = lambda view: look(replace(view, video=lambda: run.in_scene_units(view.video())))
        estimate: Estimate
        if static_image is not None:
            estimate = KnownImage(given, np.asarray(static_image))
        else:
            estimate = chosen.solve(segment, problem, options, clock)
        # A requested number of iterations cuts a solver short, as a budget does; with that of a preset,
        # solvers are about where they would end.
        cut = clock.ended == "budget" or (clock.ended == "done" and iterations is not None)
        result = run.result(estimate, check=check, error=error, cut=cut)
    return replace(
        result,
        denoiser=denoiser if denoiser is None or isinstance(denoiser, str) else type(denoiser).__name__,
        warnings=(*balance_warnings, *result.warnings),
        parameters={**result.parameters, **balance_facts},
    )


def _balanced(segment: Segment) -> tuple[Segment, tuple[str, ...], dict[str, Any]]:
    """The segment with balanced arms, warnings about it, and the measured balance as parameters."""
    balance = None if segment.balanced else balance_of([segment])
    if balance is None:
        return segment, (), {}
    if not balance.clear:
        return segment, (), {"balance": balance.facts(corrected=False)}
    return divided(segment, balance), (balance.corrected_words,), {"balance": balance.facts(corrected=True)}


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """A posed problem with its solver; turns an estimate into a result."""

    given: Given
    solver: Solver

    def in_scene_units(self, video: NDArray[Any]) -> NDArray[Any]:
        """A dimensionless video in scene units, clipped at 0 unless the solver may find negative light."""
        video = video * self.given.problem.scale
        return video if self.solver.signed else np.maximum(video, 0, out=video)

    def result(self, estimate: Estimate, *, check: bool, error: bool, cut: bool) -> Reconstruction:
        """The video with its quality, its estimated error and warnings."""
        segment, problem, clock = self.given.segment, self.given.problem, self.given.clock
        options, T_m = self.given.options, self.given.options.temporal_merge
        predicted, dimensionless, facts = checked_answer(
            options.solver, estimate, np.shape(problem.samples), self.given.video_shape
        )
        video = self.in_scene_units(dimensionless)
        held_out = estimate.held_out_error
        prediction = problem.prediction_error(predicted) if held_out is None else held_out
        quality = Quality(problem.misfit(predicted), prediction, problem.coverage, self.given.noise)
        trusted, withdrawn = trusted_frames(segment, T_m)
        # Whoever stops a run wants the answer now.
        check = check and options.static_image is None and clock.ended != "stopped"
        checked = check_description(segment, quality, clock) if check else DescriptionCheck()
        one_hz = cosine_hz(segment.substep_ns * T_m, len(video))
        # Solvers without a band are free in every frame.
        whole = [(0, facts.get("temporal_coefficients", len(video)))]
        bands_hz = [(a * one_hz, b * one_hz) for a, b in facts.pop("bands", whole)]
        resolved_hz = bands_hz[-1][1]
        unresolved: tuple[str, ...] = ()
        if check and checked.believed:
            unresolved = detect_unresolved_light(self.given, predicted, video, resolved_hz)
        video_error: VideoError | str = "it was not requested"
        # The lines that an error would be estimated from show neither of the first two.
        if error and not checked.believed:
            video_error = "the lines contradict their description"
        elif error and unresolved:
            video_error = "light changes faster than the video resolves"
        elif error and clock.ended == "stopped":
            video_error = "the reconstruction was stopped"
        elif error:
            video_error = estimate_error(self.given, estimate, video=video, quality=quality, cut=cut)
        warnings = (*withdrawn, *judge(segment, problem, quality, clock.ended))
        if period_frames := facts.get("period_frames"):
            repeats = describe_cycle(period_frames, facts["speed_changes"], segment.substep_ns * T_m)
            warnings = (*warnings, repeats)
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
            error=video_error,
            ended=clock.ended,
            believed=checked.believed,
            masked=problem.masked_by,
            warnings=(*warnings, *checked.warnings, *unresolved, *name_gaps(bands_hz), *clock.shortcuts),
            parameters={
                "spatial_merge": options.spatial_merge,
                "temporal_merge": T_m,
                "dtype": problem.arrays.dtype,
                **self.solver.model_dump(mode="json"),
                **facts,
                "resolved_hz": resolved_hz,
                "resolved_bands_hz": bands_hz,
            },
        )
