"""Where candidates for the prior are tried: solved for a while, and scored by the held-out blocks.

A search changes one thing of a candidate at a time (weight λ, pace μ, number of cosines), and each trial
begins where the best ended. A scene whose brightness changes as a whole is tried as a volume times that.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from acquire.arrays import host
from acquire.forward import merge_video
from acquire.recon.admm import Admm, AdmmParameters
from acquire.recon.band import band_operator
from acquire.recon.basis import TemporalBasis, resized
from acquire.recon.brightness import fit_brightness
from acquire.recon.tv import FrameTv
from acquire.recon.volume import Smooth, VolumeTv

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from acquire.arrays import Array
    from acquire.lines import Segment
    from acquire.recon.clock import IterationClock
    from acquire.recon.denoisers import Denoiser
    from acquire.recon.holdout import HeldOut
    from acquire.recon.options import SolveOptions
    from acquire.recon.problem import Operator, Problem

FIRST_ITERATIONS, NEXT_ITERATIONS = 30, 25
"""Of a trial from nothing, and of one that begins where another ended."""
LAST_ITERATIONS = 15
"""Of the best, with all samples."""
SEARCH_SHARE = 0.6
"""Of a budget, the most that the search may take."""
STILL_STEPS, STILL_SHARE = 60, 0.02
"""Gradient steps at most, and the share of the residual at which they end, for one frame."""
COSINES = (8, 12, 16, 24, 36, 54)
LEAST_PACE, LARGEST_PACE = 0.25, 64.0
LEAST_WEIGHT, LARGEST_WEIGHT = 1e-7, 1e3
WEIGHT_STEP, PACE_STEP = 10**0.5, 4.0
LEAST_GAIN = 0.02
"""Relative gain of the prediction below which a weaker prior is no better; a stronger one need only be as
good."""
BRIGHT_STILLS, BRIGHT_ROUNDS = 2, 8
"""Fits of a scene's brightness beside a still, and beside a volume."""
BRIGHTER = 0.85
"""Of a still's error, what one of changing brightness must reach to be followed up."""
USUAL_FRAMES, USUAL_ENERGY = 980, 7.1e-3
"""Of Fig. 9's voxels, in which the weights of candidates are told."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A prior and how much of it: K cosines, weight λ, pace μ of a volume's time.

    ``change``: of what changes beside the best still; ``fine``: solved at N_m = 1, and merged; ``robust``:
    samples that are missed by far count for less.
    """

    prior: Literal["still", "smooth", "volume"]
    coefficients: int
    weight: float
    pace: float = 0.0
    brightness: bool = False
    change: bool = False
    fine: bool = False
    robust: bool = False


STILL = Candidate("still", 1, 2e-3)
SMOOTH = Candidate("smooth", 24, 3e-3, 1.0)
VOLUME = Candidate("volume", 24, 2e-3, 4.0)
CALM = Candidate("volume", 24, 2e-3, 16.0)


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A candidate as far as it has been solved; ``errors`` are those of the held-out blocks.

    ``coefficients`` (K, n′, n′) are those of the voxels that were asked for, ``bench`` is where it was tried.
    """

    bench: Workbench
    candidate: Candidate
    admm: Admm
    denoiser: Denoiser
    basis: TemporalBasis
    operator: Operator
    brightness: NDArray[Any] | None
    errors: NDArray[np.float64]
    error: float

    @property
    def coefficients(self) -> Array:
        theta, beside = self.bench.merged(self.admm.theta), self.bench.beside
        return theta if beside is None else theta + resized(beside, self.basis)


@dataclass(slots=True)
class Notes:
    """What all workbenches of one problem have in common: a record of candidates, and the best so far."""

    record: list[dict[str, Any]] = field(default_factory=list)
    best: Trial | None = None


class Workbench:
    """Tries candidates on one problem and keeps a record of them; ``fine``: at N_m = 1, and merged."""

    def __init__(
        self,
        segment: Segment,
        problem: Problem,
        options: SolveOptions,
        clock: IterationClock,
        held_out: HeldOut,
        notes: Notes | None = None,
        *,
        fine: bool = False,
        still: Trial | None = None,
    ) -> None:
        self._segment, self.problem, self.clock, self.held_out = segment, problem, clock, held_out
        self._options, self._notes = options, notes or Notes()
        self.fine, self.still = fine, still
        self.beside = None if still is None else still.coefficients
        self._merges = (1 if fine else options.spatial_merge, options.temporal_merge)
        self.merge = options.spatial_merge if fine else 1
        self.frames, self._side, _ = segment.geometry.video_shape(*self._merges)
        self._brightness: NDArray[Any] | None = None
        self._operators: dict[tuple[int, bool], Operator] = {}  # neighbours mostly share one
        self._response = self._energy_of_a_voxel() / USUAL_ENERGY

    @property
    def record(self) -> list[dict[str, Any]]:
        return self._notes.record

    def on(self, problem: Problem, *, fine: bool | None = None, still: Trial | None = None) -> Workbench:
        """Another for the same lines: with other weights, ``fine``, or of what changes beside a ``still``."""
        kept = self._segment, problem, self._options, self.clock, self.held_out, self._notes
        return Workbench(*kept, fine=self.fine if fine is None else fine, still=still)

    def merged(self, theta: Array) -> Array:
        """Coefficients of the voxels that were asked for."""
        if self.merge == 1:
            return theta
        return self.problem.arrays.asarray(merge_video(host(theta), self.merge, 1))

    def brighten(self, still: Trial, cosines: int, most: float = np.inf) -> Trial | None:
        """A calm volume times the brightness of the whole scene, found in turn; None where there is none.

        It is not followed up from an error of more than ``most``.
        """
        if self.clock.spent(SEARCH_SHARE):
            return None
        lit = still
        for _ in range(BRIGHT_STILLS):
            self._fit_brightness(lit, cosines)
            lit = self.attempt(replace(still.candidate, brightness=True), FIRST_ITERATIONS)
            if not lit.error < BRIGHTER * still.error:
                return None
        best = lit = self.attempt(replace(self.fitting(CALM), brightness=True), FIRST_ITERATIONS, lit)
        for _ in range(BRIGHT_ROUNDS if lit.error < most else 0):
            self._fit_brightness(lit, cosines)
            lit = self.attempt(lit.candidate, NEXT_ITERATIONS, lit)
            if not lit.error < (1 - LEAST_GAIN) * best.error:
                break
            best = lit
        self._brightness = best.brightness
        self._operators = {key: kept for key, kept in self._operators.items() if not key[1]}
        return best

    def _fit_brightness(self, trial: Trial, cosines: int) -> None:
        """The brightness that goes with a trial's video from now on."""
        video = np.maximum(self.video(trial), 0)
        light = np.ones(self.frames) if trial.brightness is None else trial.brightness
        found = light * fit_brightness(self._segment, self.problem, video, self._merges, cosines)
        self._brightness = found / found.mean()
        self._operators = {key: kept for key, kept in self._operators.items() if not key[1]}

    def fitting(self, candidate: Candidate) -> Candidate:
        """The candidate with no more cosines than there are frames.

        To a video of few frames all that changes within one is noise: the search begins at a larger weight,
        which few trials would not reach.
        """
        larger = max(1.0, VOLUME.coefficients / self.frames) ** 2
        cosines = min(candidate.coefficients, self.frames)
        return replace(candidate, coefficients=cosines, weight=larger * candidate.weight)

    def attempt(self, candidate: Candidate, iterations: int, start: Trial | None = None) -> Trial:
        """Solve a candidate for so many iterations, or as many as there is time for, from ``start``."""
        basis = TemporalBasis(self.frames, candidate.coefficients, self.problem.arrays)
        brightness = self._brightness if candidate.brightness else None
        operator = self._operator(basis, brightness)
        shape, denoiser = (basis.count, self._side, self._side), _denoiser(candidate)
        admm = Admm(
            self.problem.masked(operator),
            self.problem.used_samples,
            shape,
            basis,
            parameters(candidate, self.frames, self._response),
            start=None if start is None else resized(self._start(start), basis),
            denoiser=denoiser,
            beside=self._beside(basis),
        )
        same = start is not None and start.bench.fine == self.fine and start.bench.beside is self.beside
        if start is not None and same and start.candidate.coefficients == candidate.coefficients:
            admm.resume(start.admm)
            if isinstance(denoiser, VolumeTv) and isinstance(start.denoiser, VolumeTv):
                denoiser.resume(start.denoiser)
        trial = Trial(self, candidate, admm, denoiser, basis, operator, brightness, np.zeros(0), np.inf)
        began = self.clock.seconds
        for _ in self.clock.attempt(iterations, "choose", SEARCH_SHARE):
            admm.step()
        errors = self.note(asdict(trial.candidate), self.predict(trial), began)
        trial = replace(trial, errors=errors, error=self.held_out.relative(errors))
        if self._notes.best is None or trial.error < self._notes.best.error:
            self._notes.best = trial
            self.clock.show("choose", partial(self.video, trial))
        return trial

    def note(
        self, candidate: dict[str, Any], predicted: NDArray[Any], began: float | None = None
    ) -> NDArray[np.float64]:
        """The errors of a prediction, and a record of it."""
        errors = self.held_out.errors(predicted)
        seconds = {} if began is None else {"seconds": self.clock.seconds - began}
        self.record.append(candidate | {"error": self.held_out.relative(errors)} | seconds)
        return errors

    def error(self, predicted: NDArray[Any]) -> float:
        """Relative error of the held-out blocks."""
        return self.held_out.relative(self.held_out.errors(predicted))

    def video(self, trial: Trial) -> NDArray[Any]:
        """Of a trial, dimensionless."""
        video = host(trial.basis.synthesize(trial.coefficients))
        light = trial.brightness
        return video if light is None else video * light[:, None, None].astype(video.dtype)

    def predict(self, trial: Trial) -> NDArray[Any]:
        """The lines of a trial, as `Problem.samples`."""
        return self.problem.lines_of(host(trial.operator.forward(trial.admm.theta)))

    def _start(self, trial: Trial) -> Array:
        """A trial's coefficients in the voxels of this bench."""
        theta = trial.coefficients
        if self.beside is not None:
            return theta - resized(self.beside, trial.basis)
        if not self.fine:
            return theta
        if trial.bench.fine:
            return trial.admm.theta
        n, merge = self._side, self._options.spatial_merge
        held = host(theta).repeat(merge, axis=1).repeat(merge, axis=2)[:, :n, :n]
        return self.problem.arrays.asarray(held)

    def climb(self, best: Trial, trials: int) -> Trial:
        """Change one thing of a candidate at a time, in steps, for as long as the prediction gets better."""
        seen = {best.candidate}
        moving = True
        while moving:
            moving = False
            for step in self._steps(best.candidate):
                while (candidate := step(best.candidate)) is not None and candidate not in seen:
                    if len(seen) > trials or self.clock.spent(SEARCH_SHARE):
                        return best
                    seen.add(candidate)
                    found = self.attempt(candidate, NEXT_ITERATIONS, best)
                    gain = 0.0 if _stronger(candidate, best.candidate) else LEAST_GAIN
                    if not found.error < (1 - gain) * best.error:
                        break
                    best, moving = found, True
        return best

    def _steps(self, candidate: Candidate) -> Sequence[Callable[[Candidate], Candidate | None]]:
        """Ways to change a candidate; each gives None where there is nowhere to go."""
        factor = WEIGHT_STEP**2 if candidate.prior == "smooth" else WEIGHT_STEP
        weights = [partial(_weighed, by) for by in (1 / factor, factor)]
        if candidate.prior == "still":
            return weights
        stride = PACE_STEP if candidate.prior == "volume" else 2.0
        paces = [partial(_paced, by) for by in (1 / stride, stride)]
        return [*weights, *paces, partial(self._resized, 1), partial(self._resized, -1)]

    def _resized(self, by: int, candidate: Candidate) -> Candidate | None:
        sizes = sorted({min(count, self.frames) for count in COSINES})
        at = sizes.index(candidate.coefficients) + by
        return replace(candidate, coefficients=sizes[at]) if 0 <= at < len(sizes) else None

    def finish(self, best: Trial) -> Chosen:
        """The best with all samples, which none were kept back for; on the bench where it was tried."""
        if best.bench is not self:
            return best.bench.finish(best)
        whole = self.problem.whole()
        admm = Admm(
            whole.masked(best.operator),
            whole.used_samples,
            best.admm.theta.shape,
            best.basis,
            parameters(best.candidate, self.frames, self._response),
            denoiser=best.denoiser,
            beside=self._beside(best.basis),
        )
        admm.resume(best.admm)
        last = replace(best, admm=admm)
        self.clock.begin_anew()
        for _ in self.clock.run(LAST_ITERATIONS, "solve", video=partial(self.video, last)):
            admm.step()
        if self.clock.ended == "done":
            self.clock.converged()
        return Chosen(self, last)

    def _beside(self, basis: TemporalBasis) -> Array | None:
        return None if self.beside is None else resized(self.beside, basis)

    def _energy_of_a_voxel(self) -> float:
        """Σ of squares of the lines' response to a voxel in the middle, as the solvers have it."""
        still = TemporalBasis(self.frames, 1, self.problem.arrays)
        point = np.zeros((1, self._side, self._side))
        point[0, self._side // 2, self._side // 2] = 1
        lines = host(self._operator(still, None).forward(self.problem.arrays.asarray(point)))
        return float(np.square(lines / self.problem.norm, dtype=np.float64).sum()) or USUAL_ENERGY

    def _operator(self, basis: TemporalBasis, brightness: NDArray[Any] | None) -> Operator:
        key, segment = (basis.count, brightness is not None), self._segment
        if key not in self._operators:
            code: NDArray[Any] = segment.code
            if brightness is not None:
                code = code * np.repeat(brightness, self._merges[1])[: len(code)]
            self._operators[key] = band_operator(
                segment.geometry, code, basis, *self._merges, segment.alignment, segment.blur
            )
        return self._operators[key]


class Chosen:
    """The candidate that was chosen, as an estimate."""

    def __init__(self, bench: Workbench, trial: Trial) -> None:
        self._bench, self._trial = bench, trial
        self.held_out_error: float | None = trial.error

    def predict(self) -> NDArray[Any]:
        return self._bench.predict(self._trial)

    def video(self) -> NDArray[Any]:
        return self._bench.video(self._trial)

    def facts(self) -> dict[str, Any]:
        chosen = asdict(self._trial.candidate)
        chosen["temporal_coefficients"] = chosen.pop("coefficients")
        return chosen | {"candidates": self._bench.record}

    def onward(self, problem: Problem, heavier: float = 1.0, *, still: bool = False) -> Onwards:
        beside = self._bench.still if still else None
        return Onwards(
            self._bench,
            _on(self._trial, problem, heavier),
            None if beside is None else _on(beside, problem, heavier),
        )


class Onwards:
    """A trial that goes on, and the still that it changes beside, if that does: most of the picture is it."""

    def __init__(self, bench: Workbench, trial: Trial, still: Trial | None) -> None:
        self._bench, self._trial, self._still = bench, trial, still

    def step(self) -> None:
        self._trial.admm.step()
        if self._still is not None:
            self._still.admm.step()

    def video(self) -> NDArray[Any]:
        if self._still is None:
            return self._bench.video(self._trial)
        bench = self._bench.on(self._bench.problem, still=self._still)
        return bench.video(replace(self._trial, bench=bench))


def _on(trial: Trial, problem: Problem, heavier: float) -> Trial:
    own = trial.bench.problem
    problem = replace(problem, known=own.known, doubt=own.doubt)
    operator = problem.masked(trial.operator)
    return replace(trial, admm=trial.admm.on(operator, problem.used_samples, heavier))


def _denoiser(candidate: Candidate) -> Denoiser:
    if candidate.prior == "still":
        return FrameTv(10)
    return VolumeTv(candidate.pace) if candidate.prior == "volume" else Smooth(candidate.pace)


def _stronger(one: Candidate, other: Candidate) -> bool:
    """Whether one candidate leaves the video less freedom than another that differs in one thing."""
    return one.weight > other.weight or one.pace > other.pace or one.coefficients < other.coefficients


def rounded(weight: float) -> float:
    """To three digits, so that a search knows where it has been."""
    return float(f"{weight:.3g}")


def _weighed(by: float, candidate: Candidate) -> Candidate | None:
    weight = rounded(candidate.weight * by)
    return replace(candidate, weight=weight) if LEAST_WEIGHT <= weight <= LARGEST_WEIGHT else None


def _paced(by: float, candidate: Candidate) -> Candidate | None:
    pace = candidate.pace * by
    return replace(candidate, pace=pace) if LEAST_PACE <= pace <= LARGEST_PACE else None


def parameters(candidate: Candidate, frames: int, response: float) -> AdmmParameters:
    """The solver's. λ grows with the coefficients, which do with the root of the frames, and both λ and ρ
    with the lines' ``response`` to a voxel, so that a candidate means the same whatever the voxels."""
    w, extent = candidate.weight, (frames / USUAL_FRAMES) ** 0.5
    if candidate.prior == "still":
        # all sub-steps add up in one frame: its mean light outweighs a detail thousands of times, and small
        # penalties with data steps made to the end are what lets details through
        weight, penalty, steps = w * extent, 0.1 * w, STILL_STEPS
    elif candidate.prior == "smooth":
        weight, penalty, steps = w, 2e-3, 2
    else:
        weight, penalty, steps = w * extent, 2e-3 * (w / 1e-3) ** 0.5, 2
    weight, penalty = response * weight, response * penalty
    return AdmmParameters(
        tv_weight=weight,
        tv_penalty=penalty,
        sign_penalty=0.3 * penalty,
        gradient_steps=steps,
        gradient_share=0.0 if steps < STILL_STEPS else STILL_SHARE,
        preconditioned=True,
    )
