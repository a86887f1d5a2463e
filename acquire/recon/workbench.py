"""Trials of candidate priors: each is solved for some iterations and scored by the held-out blocks.

A search changes one parameter of a candidate at a time (weight λ, pace μ, number of cosines), and each trial
starts from the best one so far. A scene whose brightness changes as a whole is tried as a volume times that
brightness.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.arrays import host
from acquire.forward import merge_video
from acquire.recon.admm import Admm
from acquire.recon.band import segment_operator
from acquire.recon.basis import CyclicBasis, TemporalBasis, resized
from acquire.recon.bends import drifting
from acquire.recon.brightness import fit_brightness
from acquire.recon.candidates import CALM, CYCLE, USUAL_ENERGY, VOLUME, Candidate, parameters
from acquire.recon.chosen import ChosenEstimate
from acquire.recon.cycle import FEWEST_HARMONICS, better_speed, most_harmonics
from acquire.recon.rotation import turning
from acquire.recon.volume import VolumeTv

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.arrays import Array
    from acquire.recon.basis import Basis
    from acquire.recon.denoisers import Denoiser
    from acquire.recon.given import Given
    from acquire.recon.holdout import HeldOut
    from acquire.recon.problem import Operator, Problem

FIRST_ITERATIONS, NEXT_ITERATIONS = 30, 25
"""Number of iterations of a trial that starts from zero, and of one that continues another."""
LAST_ITERATIONS = 15
"""Number of final iterations of the best candidate, with all samples."""
SEARCH_SHARE = 0.6
"""Upper limit on the search's share of the budget."""
GAIN_OF_WEAKER = 0.02
"""Relative gain of the prediction that a weaker prior needs to be preferred; a stronger one needs none."""
BRIGHT_ROUNDS, BRIGHT_ITERATIONS = 3, 8
"""Number of fits of the whole scene's brightness that are judged together, each in turn with so many
iterations of a volume: with more, the volume adapts to a wrong brightness, which then looks nearly right."""
WIDER = 0.9
"""Largest error of a brightness of twice as many cosines, relative to that before, for which it is preferred:
it also follows the errors of the volume. One that gained 4 % was wrong by 12 %, where it had been by 6 %."""
PURSUED = 0.95
"""Largest error after such rounds, relative to that before, for which they go on while others predict better.
"""
BRIGHTER = 0.9
"""Largest error of a volume of changing brightness, relative to that of a constant one, for which it is
preferred."""
MOST_ROUNDS, MOST_CHANGES, LONG_STRIDE = 12, 3, 4.0
"""Largest number of fits of a speed or path, in turn with what moves; number of changes of a cycle's; and how
much farther than the fit says the speed is moved at first: a cycle adapts to a wrong one, which then looks
nearly right."""
WORTH_A_ROUND, MUCH_A_ROUND = 0.99, 0.9
"""Largest error, relative to that before, with which the same kind of fit goes on: near a rival's, and far
from it. A wrong change of speed loses 10 to 50 % in a round, and what does not repeat nothing."""
NEARLY_REPEATS, NO_CYCLE = 1.3, 4.0
"""Largest error of a cycle, relative to a rival's, that is near: a tenth of a cycle too many makes 0.8 out of
0.6, and sometimes 1.15. The other is that for which its first trial goes on: bright lines on dark ground
begin at up to 2.8 and end at 0.7, and a fan whose speed changes begins at 2.4 and ends at 0.8."""
PARTS = (3, 2)
"""Parts of a period that are tried, each as long as it helps."""
PROBE, HOPELESS, TOO_BRIGHT = 10, 2.5, 4.0
"""Number of iterations after which a trial ends whose error is this many times that of a rival: the cosines'
lead is 4 and more for lamps, and 1.3 to 2 for a flame or a scene that flickers as a whole. With the first
brightness, which is fitted to a picture, the latter have up to 2.6 times a rival's."""
STEADY_BRIGHTNESS = 0.03
"""Standard deviation of a brightness that is left to the other priors."""


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A candidate and its solution so far; ``errors`` are those of the held-out blocks, ``error`` of all.

    ``coefficients`` (K, n′, n′) are those of the requested voxels; ``bench`` is where it was tried.
    """

    bench: Workbench
    candidate: Candidate
    admm: Admm
    denoiser: Denoiser
    basis: TemporalBasis | CyclicBasis
    operator: Operator
    brightness: NDArray[Any] | None
    errors: NDArray[np.float64]
    error: float

    @property
    def coefficients(self) -> Array:
        theta, background = self.bench.merged(self.admm.theta), self.bench.background
        return theta if background is None else theta + resized(background, self.basis)


@dataclass(slots=True)
class Shared:
    """State shared by all workbenches of one reconstruction: the record of candidates and the best so far."""

    record: list[dict[str, Any]] = field(default_factory=list)
    best: Trial | None = None


class Workbench:
    """Tries candidates on one problem and keeps a record of them.

    ``fine``: they are solved at N_m = 1 and merged. ``still``: they are the change relative to that trial,
    whose coefficients are the ``background``.
    """

    def __init__(
        self,
        given: Given,
        held_out: HeldOut,
        shared: Shared | None = None,
        *,
        fine: bool = False,
        still: Trial | None = None,
    ) -> None:
        self.given, self.held_out, self._shared = given, held_out, shared or Shared()
        self.problem, self.clock = given.problem, given.clock
        self.fine, self.still = fine, still
        self.background = None if still is None else still.coefficients
        spatial_merge, temporal_merge = given.merges
        self._merges = (1 if fine else spatial_merge, temporal_merge)
        self.merge = spatial_merge if fine else 1
        self.frames, self._side, _ = given.segment.geometry.video_shape(*self._merges)
        self._brightness: NDArray[Any] | None = None  # of the next trials; a trial keeps its own
        self._bright_cosines = self.frames
        # Successive trials mostly share one.
        self._operators: dict[tuple[int, bool, tuple[float, ...]], Operator] = {}

        # This is the energy of the normalised lines' response to steady light in the voxel in the middle of
        # the picture.
        constant = TemporalBasis(self.frames, 1, self.problem.arrays)
        point = np.zeros((1, self._side, self._side))
        point[0, self._side // 2, self._side // 2] = 1
        lines = host(self._operator(constant, None).forward(self.problem.arrays.asarray(point)))
        energy = float(np.square(lines / self.problem.norm, dtype=np.float64).sum()) or USUAL_ENERGY
        self._response = energy / USUAL_ENERGY

    @property
    def record(self) -> list[dict[str, Any]]:
        """What was tried, as JSON: prior, weight and held-out error of each candidate, in order."""
        return self._shared.record

    def with_problem(
        self, problem: Problem, *, fine: bool | None = None, still: Trial | None = None
    ) -> Workbench:
        """Another bench for the same lines: with other weights, ``fine``, or for changes from a ``still``."""
        given, fine = replace(self.given, problem=problem), self.fine if fine is None else fine
        return Workbench(given, self.held_out, self._shared, fine=fine, still=still)

    def merged(self, theta: Array) -> Array:
        """Coefficients of the requested voxels."""
        if self.merge == 1:
            return theta
        return self.problem.arrays.asarray(merge_video(host(theta), self.merge, 1))

    def brighten(
        self, video: NDArray[Any], cosines: int, rival: float, candidate: Candidate | None = None
    ) -> Trial | None:
        """Fit the brightness of the whole scene and a volume in turn; None if the brightness is steady.

        The first fit is to a ``video`` (frames, n′, n′) without changes of brightness, such as the time mean
        of another. The volume is a calm one if no ``candidate`` is given.
        """
        if self.clock.spent(SEARCH_SHARE):
            return None
        self._bright_cosines = min(cosines, self.frames)
        self._fit_brightness(video, self._bright_cosines)
        if self._brightness is None or self._brightness.std() < STEADY_BRIGHTNESS:  # its mean is 1
            return None
        candidate = replace(candidate or self.fitting(CALM), brightness=True)
        best = self.probe(candidate, rival, TOO_BRIGHT)
        return self.alternate(best, rival) if best.error < TOO_BRIGHT * rival else best

    def follow_brightness(self, best: Trial) -> Trial:
        """Fit the brightness and a volume in turn, and then one of twice as many cosines, if that pays.

        The error has to fall to `WIDER` times its value.
        """
        best = self.alternate(best)
        while self._bright_cosines < self.frames:
            cosines, self._bright_cosines = self._bright_cosines, min(self.frames, 2 * self._bright_cosines)
            wider = self.alternate(best)
            if wider.error >= WIDER * best.error:
                self._bright_cosines = cosines
                break
            best = wider
        self.use_brightness(best.brightness)
        return best

    def alternate(self, best: Trial, rival: float = 0) -> Trial:
        """Fit the brightness, a volume and its path, if it follows one, in turn as long as this pays.

        With a ``rival``, they end where they predict better, and have to improve clearly until then.
        """
        latest = best
        for _ in range(MOST_ROUNDS):
            before = best.error
            candidate = _path_again(latest) or latest.candidate
            for _ in range(BRIGHT_ROUNDS):
                if self.clock.spent(SEARCH_SHARE):
                    break
                unlit = host(latest.basis.synthesize(latest.coefficients))
                self._fit_brightness(np.maximum(unlit, 0), self._bright_cosines)
                latest = self.attempt(candidate, BRIGHT_ITERATIONS, latest)
                best = min(best, latest, key=_error)
            if best.error < rival or best.error >= (PURSUED if rival else WORTH_A_ROUND) * before:
                break
        self.use_brightness(best.brightness)
        return best

    def repeat(self, period_frames: float, speed_changes: tuple[float, ...], rival: float) -> Trial:
        """Try a cycle of about this period, or of a part of it, since a multiple of a period is one, too."""
        best = self._cycle(period_frames, speed_changes, rival)
        for part in PARTS:
            while best.error < NEARLY_REPEATS * rival and not self.clock.spent(SEARCH_SHARE):
                shorter, changes = best.candidate.period_frames / part, best.candidate.speed_changes
                if most_harmonics(shorter, changes) < FEWEST_HARMONICS:
                    break
                found = self._cycle(shorter, changes, best.error)
                if found.error > best.error:
                    break
                best = found
        return best

    def _cycle(self, period_frames: float, speed_changes: tuple[float, ...], rival: float) -> Trial:
        """A cycle, whose speed is fitted to the lines if it may yet predict better than a rival."""
        harmonics = min(CYCLE.coefficients // 2, most_harmonics(period_frames, speed_changes))
        cycle = replace(
            CYCLE,
            coefficients=2 * harmonics + 1,
            period_frames=period_frames,
            speed_changes=speed_changes,
        )
        found = self.probe(self.fitting(cycle), rival, NO_CYCLE)
        if found.error > NO_CYCLE * rival:
            return found
        return self.follow_speed(found, NEARLY_REPEATS * rival)

    def follow_speed(self, best: Trial, near: float = np.inf) -> Trial:
        """Fit the speed and the cycle in turn as long as this improves the prediction.

        While its error is larger than ``near``, it has to improve much in every round.
        """
        stride, order = LONG_STRIDE, len(best.candidate.speed_changes)
        for _ in range(MOST_ROUNDS):
            basis, far = best.basis, best.error > near
            # The comb's period is not wrong by as much as that.
            order = max(order, 1) if far else order
            if self.clock.spent(SEARCH_SHARE) or not isinstance(basis, CyclicBasis):
                break
            operator = partial(self._new_operator, None)
            period, changes = better_speed(
                self.problem, best.admm.theta, basis, operator, stride=stride, order=order
            )
            moved = replace(best.candidate, period_frames=period, speed_changes=changes)
            found = self.attempt(moved, PROBE, best)
            gained = found.error < WORTH_A_ROUND * best.error
            enough = found.error < MUCH_A_ROUND * best.error if far else gained
            # Changes of speed that are not worth a round stay out of the result.
            if gained or (found.error < best.error and len(changes) == len(best.candidate.speed_changes)):
                best = found
            if enough:
                continue
            if far or (stride == 1 and order == MOST_CHANGES):
                break
            stride, order = (1.0, order) if stride > 1 else (LONG_STRIDE, MOST_CHANGES)
        return best

    def follow_path(self, best: Trial) -> Trial:
        """Find the velocity or the turn again in the better video, as long as the prediction improves."""
        for _ in range(MOST_ROUNDS):
            moved = _path_again(best)
            if moved is None or self.clock.spent(SEARCH_SHARE):
                break
            found = self.attempt(moved, NEXT_ITERATIONS, best)
            gained = found.error < WORTH_A_ROUND * best.error
            best = min(best, found, key=_error)
            if not gained:
                break
        return best

    def _fit_brightness(self, video: NDArray[Any], cosines: int) -> None:
        """In the next trials, use the brightness with which a video of a constant one explains the lines."""
        self.use_brightness(fit_brightness(self.given.segment, self.problem, video, self._merges, cosines))

    def use_brightness(self, brightness: NDArray[Any] | None) -> None:
        self._brightness = brightness
        # Operators that contain the former brightness are out of date.
        self._operators = {key: kept for key, kept in self._operators.items() if not key[1]}

    def fitting(self, candidate: Candidate) -> Candidate:
        """Adapt a candidate to the number of frames: no more cosines than that, and a larger weight for few.

        Changes within a frame act as noise on a video of few frames: the search starts from a larger weight,
        which it would not reach in a few trials.
        """
        larger = max(1.0, VOLUME.coefficients / self.frames) ** 2  # +1.0 dB on average of 84 cases
        cosines = min(candidate.coefficients, self.frames)
        return replace(candidate, coefficients=cosines, weight=larger * candidate.weight)

    def attempt(
        self,
        candidate: Candidate,
        iterations: int,
        start: Trial | None = None,
        denoiser: Denoiser | None = None,
    ) -> Trial:
        """Solve a candidate from ``start`` for this many iterations, or as many as there is time for.

        ``denoiser`` is one that depends on more than the candidate.
        """
        basis = candidate.basis(self.frames, self.problem.arrays)
        brightness = self._brightness if candidate.brightness else None
        operator = self._operator(basis, brightness)
        shape, denoiser = (basis.count, self._side, self._side), denoiser or candidate.denoiser()
        admm = Admm(
            self.problem.masked(operator),
            self.problem.used_samples,
            shape,
            basis,
            parameters(candidate, self.frames, self._response),
            start=None if start is None else resized(self._start(start), basis),
            denoiser=denoiser,
            background=self._background(basis),
        )
        # Multipliers and w fit only as many unknowns of the same kind.
        if (
            start is not None
            and start.bench.fine == self.fine
            and start.bench.background is self.background
            and start.candidate.prior == candidate.prior
            and start.candidate.coefficients == candidate.coefficients
        ):
            admm.resume(start.admm)
            if isinstance(denoiser, VolumeTv) and isinstance(start.denoiser, VolumeTv):
                denoiser.resume(start.denoiser)
        trial = Trial(
            bench=self,
            candidate=candidate,
            admm=admm,
            denoiser=denoiser,
            basis=basis,
            operator=operator,
            brightness=brightness,
            errors=np.zeros(0),
            error=np.inf,
        )
        began = self.clock.seconds
        for _ in self.clock.attempt(iterations, "choose", SEARCH_SHARE):
            admm.step()
        errors = self.record_errors(asdict(trial.candidate), self.predict(trial), began)
        trial = replace(trial, errors=errors, error=self.held_out.relative(errors))
        if self._shared.best is None or trial.error < self._shared.best.error:
            self._shared.best = trial
            self.clock.show("choose", partial(self.video, trial))
        return trial

    def probe(
        self, candidate: Candidate, rival: float, hopeless: float = HOPELESS, start: Trial | None = None
    ) -> Trial:
        """Solve a candidate; it ends early if its error is ``hopeless`` times that of a rival."""
        first = self.attempt(candidate, PROBE, start)
        if first.error > hopeless * rival:
            return first
        return self.attempt(candidate, FIRST_ITERATIONS - PROBE, first)

    def record_errors(
        self, candidate: dict[str, Any], predicted: NDArray[Any], began: float | None = None
    ) -> NDArray[np.float64]:
        """Record a candidate with its held-out error, and return the errors of the blocks."""
        errors = self.held_out.errors(predicted)
        seconds = {} if began is None else {"seconds": self.clock.seconds - began}
        self.record.append(candidate | {"error": self.held_out.relative(errors)} | seconds)
        return errors

    def error(self, predicted: NDArray[Any]) -> float:
        """Relative error of the held-out blocks."""
        return self.held_out.relative(self.held_out.errors(predicted))

    def video(self, trial: Trial) -> NDArray[Any]:
        """The dimensionless video of a trial."""
        video = host(trial.basis.synthesize(trial.coefficients))
        light = trial.brightness
        return video if light is None else video * light[:, None, None].astype(video.dtype)

    def predict(self, trial: Trial) -> NDArray[Any]:
        """The lines of a trial, as `Problem.samples`."""
        return self.problem.lines_of(host(trial.operator.forward(trial.admm.theta)))

    def _start(self, trial: Trial) -> Array:
        """A trial's coefficients in the voxels of this bench, without its background."""
        theta = trial.coefficients
        if self.background is not None:
            return theta - resized(self.background, trial.basis)
        if not self.fine:
            return theta
        if trial.bench.fine:
            return trial.admm.theta
        n, merge = self._side, self.given.options.spatial_merge
        held = host(theta).repeat(merge, axis=1).repeat(merge, axis=2)[:, :n, :n]
        return self.problem.arrays.asarray(held)

    def climb(self, best: Trial, trials: int) -> Trial:
        """Hill-climb from a trial: change one parameter at a time while the prediction improves.

        It ends after ``trials`` candidates or when the search's share of the budget is spent.
        """
        tried = {best.candidate}
        improved = True
        while improved:
            improved = False
            for step in best.candidate.steps(self.frames):
                while (candidate := step(best.candidate)) is not None and candidate not in tried:
                    if len(tried) > trials or self.clock.spent(SEARCH_SHARE):
                        return best
                    tried.add(candidate)
                    found = self.attempt(candidate, NEXT_ITERATIONS, best)
                    gain = 0.0 if candidate.is_stronger_than(best.candidate) else GAIN_OF_WEAKER
                    if not found.error < (1 - gain) * best.error:
                        break
                    best, improved = found, True
        return best

    def finish(self, best: Trial) -> ChosenEstimate:
        """Solve the best trial with all samples, none held out, on the bench where it was tried."""
        if best.bench is not self:
            return best.bench.finish(best)
        problem = self.problem.with_all_samples()
        admm = Admm(
            problem.masked(best.operator),
            problem.used_samples,
            best.admm.theta.shape,
            best.basis,
            parameters(best.candidate, self.frames, self._response),
            denoiser=best.denoiser,
            background=self._background(best.basis),
        )
        admm.resume(best.admm)
        last = replace(best, admm=admm)
        self.clock.reset()  # whatever the search took
        for _ in self.clock.run(LAST_ITERATIONS, "solve", video=partial(self.video, last)):
            admm.step()
        if self.clock.ended == "done":  # all that a choice needs: not a run that was cut short
            self.clock.converged()
        return ChosenEstimate(self, last)

    def _background(self, basis: Basis) -> Array | None:
        return None if self.background is None else resized(self.background, basis)

    def _operator(self, basis: TemporalBasis | CyclicBasis, brightness: NDArray[Any] | None) -> Operator:
        motion = (basis.period_frames, *basis.speed_changes) if isinstance(basis, CyclicBasis) else ()
        key = (basis.count, brightness is not None, motion)
        if key not in self._operators:
            self._operators[key] = self._new_operator(brightness, basis)
        return self._operators[key]

    def _new_operator(self, brightness: NDArray[Any] | None, basis: Basis) -> Operator:
        segment = self.given.segment
        code: NDArray[Any] = segment.code
        if brightness is not None:
            code = code * np.repeat(brightness, self._merges[1])[: len(code)]
        return segment_operator(segment, basis, *self._merges, code=code)


def _path_again(trial: Trial) -> Candidate | None:
    """The candidate on the path that its video shows now; None if it follows none, or the path is found."""
    if trial.candidate.rotation:
        return turning(trial)
    return drifting(trial) if trial.candidate.drift else None


def _error(trial: Trial) -> float:
    return trial.error
