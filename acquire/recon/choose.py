"""The default solver: it chooses the prior that predicts the held-out blocks best, then uses all samples.

    still      one frame, total variation                         for rest, or light too weak for more
    volume     few cosines, total variation of a volume           for motion; also before a still ground, and
                                                                  times a free brightness
    cycle      harmonics of a period, total variation of a cycle  for motion that repeats
    smooth     few cosines, quadratic, then with their spectrum   for flow
    cosines    the whole band, total variation of coefficients    for lamps, then as patterns and curves

Where a still explains most of the lines and a volume is not clearly better, the cosines start from the still:
lines carry no information about sub-steps without light, so that a start from zero leaves the code in the
video. A stronger prior is preferred unless a weaker one is clearly better, because the noise that a weak
prior admits hardly shows in the lines, which are sums. Nothing here uses the truth, and no weight is fixed:
those in the code are starting points of searches.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from acquire.arrays import host
from acquire.recon.basis import LearnedBasis
from acquire.recon.blinking import (
    AT_REST,
    FIRST_LOOK_SHARE,
    FREER,
    GLANCE,
    LONGER_LOOK,
    complete_look,
    glance,
    glance_at_band,
    refine,
    solve_in_cosines,
)
from acquire.recon.candidates import (
    CALM,
    GROUNDED,
    SMOOTH,
    STILL,
    VOLUME,
)
from acquire.recon.cycle import TRIED_CHANGES, find_period
from acquire.recon.estimates import Preferred, Refined
from acquire.recon.following import OUTDONE, better, following, following_faint, moving_in, or_turning
from acquire.recon.given import Given
from acquire.recon.holdout import HeldOut
from acquire.recon.patterns import find_patterns, has_clear_patterns
from acquire.recon.reuse import reuse_choice
from acquire.recon.solver import Preset, Solver
from acquire.recon.spectrum import learn_spectrum
from acquire.recon.still import best_still, change_bench, weighted_like
from acquire.recon.workbench import (
    BRIGHTER,
    FIRST_ITERATIONS,
    GAIN_OF_WEAKER,
    HOPELESS,
    SEARCH_SHARE,
    Workbench,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from acquire.arrays import Array
    from acquire.lines import Segment
    from acquire.recon.clock import IterationClock
    from acquire.recon.estimates import Estimate, InBand
    from acquire.recon.options import SolveOptions
    from acquire.recon.problem import Problem
    from acquire.recon.workbench import Trial

ITERATIONS_PER_TRIAL = 10
"""Iterations of a preset for each trial of a search."""
EVIDENT = 0.55
"""Largest error of a smooth volume, relative to a first volume and to one of changing brightness, for which
it is evident that something flows."""
FAR_FROM_REST = 0.33
"""Largest error of a smooth volume, relative to a still's, for which something flows: flames and waves have
0.11 to 0.31, and a flash before a still, light that flickers, bodies and wheels 0.35 and more."""
FAR = 1.25
"""Largest error of a smooth volume or a still, relative to the volume's, for which it is searched further."""
FINEST_COSINES, QUICK = 54, 0.87
"""Number of cosines in which a smooth volume is tried again, and its largest error, relative to that in the
first number, for which nothing flows: something moves too fast for these. Flames and waves, which are
complete in 24, have 0.91 to 1.08, and balls that hop across the field 0.55 to 0.82, but in short ranges up to
0.97: some of these are missed."""
NEED_NO_MORE = 0.2
"""Error of a smooth volume, relative to a still's, below which a budget is not spent on trying it again,
unless the cosines at a glance predict better. Such balls have 0.23 to 0.5, and on 96 stages 0.16 to 0.24, of
which the cosines have 0.6 to 0.8. Flames have 0.08 to 0.19, and the cosines 1.0 to 1.5 of that: they lose up
to 1 dB in 10 s, of which this takes 0.7."""
SMOOTHER = 0.85
"""Largest error of a smooth volume, relative to the volume's, for which it is preferred: a quadratic prior
admits more noise that does not show."""
FLOWS = 0.9
"""Largest error of a smooth volume, relative to the best of the others, all after their first trials, for
which these are not searched further: flames and waves have 0.35 to 0.86, and a few flames 1.04. Of what is
no `FAR_FROM_REST`, some have 0.6 to 0.9, too."""
MOVING = 0.97
"""Largest error of a volume, relative to a still's, for which it is preferred; the change from a still equals
the still where its prior is strong, and need only be better."""
REPEATS = 0.8
"""Largest error of a cycle, relative to the volume's, the still's and the cosines' at a glance, for which it
is a candidate: a video that repeats itself claims more than any other. Motion that repeats has 0.4 to 0.7,
text that scrolls 0.9."""
NEARLY = 8
"""Largest number of trials of a cycle that predicts better than all others, but not far better."""
CLOSE, NOT_FAR = 1.1, 2.0
"""Largest error of the cosines, relative to the best trial's, for which they are continued, and for which
they are if clear patterns were found, or if only a glance was taken."""


class AdmmSolver(Solver):
    """Ridge ADMM with the prior that predicts best; the held-out samples may end it early."""

    iterations: ClassVar[Mapping[Preset, int]] = {"fast": 40, "balanced": 150, "best": 300}
    goes_on: ClassVar[bool] = True
    takes: ClassVar[frozenset[str]] = frozenset({"initial", "denoiser", "choice"})

    def solve(
        self, segment: Segment, problem: Problem, options: SolveOptions, clock: IterationClock
    ) -> Estimate:
        """Solve with the prior that predicts best.

        If the options give a bandwidth, weight, denoiser or start, the cosines are solved for without a
        choice.
        """
        given, held_out = Given(segment, problem, options, clock), HeldOut(problem, segment.geometry)
        fixed = (options.denoiser, options.tv_weight, options.bandwidth, options.initial)
        if not held_out or any(each is not None for each in fixed):
            return solve_in_cosines(given)
        bench = Workbench(given, held_out)
        trials = max(4, options.iterations // ITERATIONS_PER_TRIAL)
        if options.choice is not None:
            reused = reuse_choice(bench, trials)
            if reused is not None:
                return reused
        if bench.frames == 1:
            still = bench.attempt(STILL, FIRST_ITERATIONS)
            return bench.finish(best_still(still, trials, merge=options.spatial_merge))
        volume = bench.attempt(bench.fitting(VOLUME), FIRST_ITERATIONS)
        if clock.spent(SEARCH_SHARE):
            clock.shortcuts.append(f"{clock.cause} left no time to try more than one kind of motion")
            return bench.finish(volume)
        tried = _Tried(volume, bench.attempt(bench.fitting(STILL), FIRST_ITERATIONS))
        return _choose(bench, tried, glance(given, _start(bench, tried)), trials)


def _start(bench: Workbench, tried: _Tried) -> Array | None:
    """Coefficients from which the cosines start; None if they start from zero."""
    volume, plain = tried.volume, tried.plain
    at_rest = plain.error < AT_REST and not bench.held_out.clearly_less(volume.errors, plain.errors)
    return plain.coefficients if at_rest else None


def _choose(bench: Workbench, tried: _Tried, cosines: InBand, trials: int) -> Estimate:
    """Compare a first volume with a still, a glance at the cosines and the other priors; solve with the best.

    Scenes that blink need most of a budget for the cosines, and others need it for the search: a glance
    decides which comes first. Many cosines take ten times as long as a trial of the others.
    """
    given, clock = bench.given, bench.clock
    # The time is taken now, because the trials below forget how long the cosines' iterations are.
    rest_s = (LONGER_LOOK - GLANCE) * clock.longest_s
    errors = bench.record_errors({"prior": "cosines"} | cosines.facts(), cosines.predict())
    at_a_glance, clear = bench.held_out.relative(errors), has_clear_patterns(cosines)
    lamps = isinstance(cosines.basis, LearnedBasis) and tried.best.error > HOPELESS * at_a_glance
    # Evident lamps need the time for themselves.
    followed = None if clear or lamps else _try_motion(bench, tried, cosines, at_a_glance)
    if not (clear or tried.flows):
        tried.cycle = _cycle(bench, cosines, min(at_a_glance, tried.best.error), lamps=lamps)
    tried.followed = followed  # from now on: a cycle at rest competes with what is at rest
    ahead, refined = at_a_glance <= OUTDONE * tried.best.error, None
    if ahead:
        complete_look(given, cosines)
        if find_patterns(host(cosines.solver.theta)) is not None:
            refined = refine(given, cosines)
            if (clear or isinstance(refined, Refined)) and _wins(bench, refined, tried.best):
                return Preferred(refined, bench.record)
        if lamps and not isinstance(refined, Refined) and (whole := _no_lamps(bench, tried, cosines)):
            return _choose(bench, _Tried(tried.volume, tried.plain), whole, trials)
    best = _search(bench, tried, trials, bench.error(cosines.predict()) if ahead else np.inf)
    near = at_a_glance < NOT_FAR * best.error and clock.affords(rest_s, FIRST_LOOK_SHARE)
    if not ahead and near:
        complete_look(given, cosines)
    if refined is None and (ahead or near) and _worth_refining(bench, cosines, best):
        refined = refine(given, cosines)
    if refined is not None and _wins(bench, refined, best):
        return Preferred(refined, bench.record)
    return bench.finish(best)


def _no_lamps(bench: Workbench, tried: _Tried, cosines: InBand) -> InBand | None:
    """A glance at the whole band, if it predicts better than the cosines of lamps; None if it does not.

    A crank that turns fast looks like lamps at first: it has a few rhythms, too. But it has all harmonics of
    them, its places are no patterns, and no period shows in the cosines that lamps would have.
    """
    if bench.clock.spent(SEARCH_SHARE):
        return None
    whole = glance_at_band(bench.given, _start(bench, tried))
    return whole if bench.error(whole.predict()) < FREER * bench.error(cosines.predict()) else None


def _try_motion(bench: Workbench, tried: _Tried, cosines: InBand, at_a_glance: float) -> Trial | None:
    """Try what flows, what moves as one and what flickers; return the volume that follows what moves.

    These are tried even where cosines are ahead: a scene that flickers gains 6.6 to 15 dB by this, a flame up
    to 7, and what moves or turns by a path or a cycle.
    """
    # From zero, most flames on 80 stages and more have 3 times the cosines' error after a few iterations,
    # though they end below it. From the volume, which has most of their light, they have less at once.
    rival = min(at_a_glance, tried.best.error)
    tried.smooth = bench.probe(bench.fitting(SMOOTH), rival, start=tried.volume)
    enough = min(at_a_glance, NEED_NO_MORE * tried.plain.error) if bench.clock.has_budget else 0.0
    if enough < tried.smooth.error < tried.least_of_flow(tried.volume):
        _look_for_quick(bench, tried, tried.smooth)
    rival = min(at_a_glance, tried.smooth.error)
    followed = None if tried.flows else following(tried.volume, rival)
    if followed is not None and followed.error < rival:
        return _in_its_light(followed, cosines.basis.cosines)
    # What flickers may seem to move. The first cosine is constant, so that this is the mean over time.
    picture = (cosines.basis.matrix()[0, 0] * host(cosines.solver.theta[0, ...])).clip(0)
    still = np.broadcast_to(picture, (bench.frames, *picture.shape))
    tried.bright = bright = bench.brighten(still, cosines.basis.cosines, min(rival, tried.best.error))
    if bright is not None and bright is tried.best:
        tried.bright = moving_in(bright)
    elif followed is None and not tried.flows:
        followed = following_faint(tried.volume, cosines, rival)
    return followed


def _look_for_quick(bench: Workbench, tried: _Tried, smooth: Trial) -> None:
    """Take more cosines for the volume and the smooth one, if something moves too fast for the first number.

    In too few, all volumes are blurred, a smooth one the least: that looks like something that flows.
    """
    candidate = bench.fitting(replace(SMOOTH, coefficients=FINEST_COSINES))
    if candidate.coefficients <= smooth.candidate.coefficients or bench.clock.spent(SEARCH_SHARE):
        return
    finer = bench.attempt(candidate, FIRST_ITERATIONS)
    tried.quick = finer.error < QUICK * smooth.error
    if tried.quick:
        tried.smooth = finer
        volume = bench.attempt(bench.fitting(replace(VOLUME, coefficients=FINEST_COSINES)), FIRST_ITERATIONS)
        tried.volume = min(tried.volume, volume, key=_error)


def _in_its_light(followed: Trial, cosines: int) -> Trial:
    """What moves as one, or the same times a changing brightness in so many cosines, if that predicts better.

    The brightness is first fitted to what does not change on the way, as the mean over time is at rest.
    """
    bench, coefficients = followed.bench, host(followed.coefficients)
    constant = np.zeros_like(coefficients)
    constant[0] = coefficients[0]
    video = host(followed.basis.synthesize(bench.problem.arrays.asarray(constant)))
    lit = bench.brighten(np.maximum(video, 0), cosines, followed.error, followed.candidate)
    return lit if lit is not None and lit.error < BRIGHTER * followed.error else followed


def _cycle(bench: Workbench, cosines: InBand, rival: float, *, lamps: bool) -> Trial | None:
    """The video as a cycle, if it repeats and predicts far better than a rival; less is tried for lamps."""
    # Evident lamps need the time that changes of speed take, which is 3 % of 10 s.
    repeats = find_period(cosines.solver.theta, cosines.basis, (0.0,) if lamps else TRIED_CHANGES)
    if repeats is None or bench.clock.spent(SEARCH_SHARE):
        return None
    cycle = bench.repeat(*repeats, rival)
    if REPEATS * rival <= cycle.error < rival:
        cycle = or_turning(cycle, rival)
        # Sharp edges that move take more harmonics than a first trial has. Lamps are better off in patterns.
        finer = None if lamps else cycle.candidate.with_coefficients(1, bench.frames)
        cycle = cycle if finer is None else better(cycle, finer)
        if not lamps and REPEATS * rival <= cycle.error < rival:
            cycle = bench.climb(cycle, NEARLY)
    return cycle if cycle.error < REPEATS * rival else None


@dataclass
class _Tried:
    """First trials: a volume, a still and, unless patterns are clear, a smooth volume, one of changing
    brightness (None if the brightness is steady), a volume that follows what moves as one (None if nothing
    does) and a cycle (None if nothing repeats).

    ``quick``: something moves too fast for the first number of cosines, so that nothing flows.
    """

    volume: Trial
    plain: Trial
    smooth: Trial | None = None
    bright: Trial | None = None
    followed: Trial | None = None
    cycle: Trial | None = None
    quick: bool = False

    def least_of_flow(self, *others: Trial | None) -> float:
        """The error below which a smooth volume shows that something flows, beside these and a still."""
        if self.quick:
            return 0.0
        return min(FLOWS * self.best_of(self.plain, *others).error, FAR_FROM_REST * self.plain.error)

    @property
    def flows(self) -> bool:
        """Whether a smooth volume outdoes others so far that no other motion need be tried."""
        if self.smooth is None or self.smooth.error >= self.least_of_flow():
            return False
        return self.smooth.error < EVIDENT * self.best_of(self.volume, self.bright).error

    @property
    def flickers(self) -> bool:
        """Whether a changing brightness outdoes others so far that no other motion need be tried."""
        if self.bright is None:
            return False
        return self.bright.error < OUTDONE * self.best_of(self.volume, self.followed, self.cycle).error

    @property
    def best(self) -> Trial:
        others = self.plain, self.smooth, self.bright, self.followed, self.cycle
        return self.best_of(self.volume, *others)

    @staticmethod
    def best_of(first: Trial, *others: Trial | None) -> Trial:
        """The best of these, of which some may not have been tried."""
        return min((first, *(trial for trial in others if trial is not None)), key=_error)


def _wins(bench: Workbench, refined: Estimate, best: Trial) -> bool:
    """Whether patterns predict clearly better than the best trial, and cosines that are none much better.

    What happens in a few blocks of lines only, as a flash, is not clear by its standard error.
    """
    errors = bench.record_errors({"prior": "patterns"} | refined.facts(), refined.predict())
    clear = bench.held_out.clearly_less(errors, best.errors)
    much = bench.held_out.relative(errors) < FREER * best.error
    if isinstance(refined, Refined):
        return clear or much
    return clear and (much or best.candidate.prior == SMOOTH.prior)


def _search(bench: Workbench, tried: _Tried, trials: int, rival: float) -> Trial:
    """The best of stills, volumes, smooth volumes and volumes of changing brightness.

    Of candidates that are far from the error of a ``rival``, only the first trials are made.
    """
    smooth = tried.smooth or bench.attempt(bench.fitting(SMOOTH), FIRST_ITERATIONS)
    settled = tried.flows or tried.flickers
    volume = tried.volume if settled else _best_volume(bench, tried, min(rival, smooth.error))
    if smooth.error < min(tried.least_of_flow(volume, tried.bright), FAR * rival):
        return learn_spectrum(smooth)
    plain = still = tried.plain
    bright = tried.bright
    # To a brightness, a flash in front of a still is the flash of everything.
    changes = bright is not None and bench.held_out.clearly_less(bright.errors, plain.errors)
    if bright is not None and changes and bright.error < BRIGHTER * volume.error:
        volume = bright
    # Where much moves, a still is not searched further, and is no ground for a change.
    if plain.error < FAR * volume.error:
        still, volume = _with_change(bench, plain, volume, trials)
    if volume.error < FAR * rival:
        volume = volume.bench.climb(volume, trials)
        if volume.candidate.brightness:
            volume = volume.bench.follow_brightness(volume)
        elif volume.candidate.drift or volume.candidate.rotation:
            volume = volume.bench.follow_path(volume)
        if volume.candidate.period_frames:
            volume = volume.bench.follow_speed(volume)
    if not tried.quick and smooth.error < FAR * min(volume.error, rival):
        smooth = bench.climb(smooth, trials)
    # The gain has to be beyond chance, which is worth 5 dB where something flashes. This is not required of
    # other volumes, since ten blocks reject some of these that are 2 dB better.
    smoother = not tried.quick and smooth.error < SMOOTHER * volume.error
    flows = smoother and bench.held_out.clearly_less(smooth.errors, still.errors)
    moving = learn_spectrum(smooth) if flows else volume
    most = 1 - GAIN_OF_WEAKER if moving.candidate.change else MOVING
    return moving if moving.error < most * still.error else still


def _with_change(bench: Workbench, plain: Trial, volume: Trial, trials: int) -> tuple[Trial, Trial]:
    """The best still, and the better one of a volume and of a change relative to that still."""
    explains = plain.error < AT_REST
    merge = bench.given.options.spatial_merge
    still = best_still(plain, trials, merge=merge) if explains else bench.climb(plain, trials)
    if bench.clock.spent(SEARCH_SHARE):
        return still, volume
    candidate = replace(weighted_like(still, bench.fitting(VOLUME)), change=True)
    if not volume.candidate.period_frames:  # else it follows its own cycle
        candidate = candidate.with_path_of(volume.candidate)
    change = change_bench(bench, still).attempt(candidate, FIRST_ITERATIONS)
    return still, min((volume, change), key=_error)


def _best_volume(bench: Workbench, tried: _Tried, rival: float) -> Trial:
    """The best of volumes at rest, volumes that follow what moves, and cycles, each after a first trial."""
    cycle = tried.cycle
    if cycle is not None and not cycle.candidate.rotation:
        cycle = or_turning(cycle, rival)
    volume = tried.followed or cycle
    if volume is not None:
        return min(volume, cycle or volume, key=_error)
    calm = bench.attempt(bench.fitting(CALM), FIRST_ITERATIONS, tried.plain)
    grounded = bench.attempt(bench.fitting(GROUNDED), FIRST_ITERATIONS)
    volume = min(tried.volume, calm, grounded, key=_error)
    if volume is tried.volume and tried.smooth is not None:
        return volume  # what moves in it was looked for
    # The motion may show in a better video, though not in the first.
    return following(volume, rival) or volume


def _worth_refining(bench: Workbench, cosines: InBand, best: Trial) -> bool:
    """Whether the first look in the cosines may still win, after more iterations or as patterns."""
    error = bench.error(cosines.predict())
    if error < CLOSE * best.error:
        return True
    return error <= NOT_FAR * best.error and has_clear_patterns(cosines)


def _error(trial: Trial) -> float:
    return trial.error
