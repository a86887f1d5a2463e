"""The refinement of patterns and curves from its first round to its last.

    doubtful patterns and a dark ground on trial ─▶ λ is lowered until noise is fitted ─▶ both once more
    ─▶ λ is held

The first look distinguishes patterns from its own errors only by energy, and may find too many. Superfluous
ones fit noise: the picture loses 2 to 10 dB while the lines are explained. The held-out samples end the
refinement, and the round that predicted them best is the result: at full resolution there is no model error
to fit, so that they are predicted better as long as the picture improves. Next to the noise they rise and
fall by more than λ changes them; there the used samples tell that it is fitted, and λ should be larger.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from acquire.recon.darkness import gains_darkness, in_pixels, lit_pixels, with_light_missing
from acquire.recon.patterns import NEEDED, ROUND, SUPERFLUOUS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from acquire.recon.clock import IterationClock
    from acquire.recon.given import Given
    from acquire.recon.patterns import Refinement

LEAST_PROGRESS = 0.003
"""Smallest relative gain of the held-out prediction for which a round counts as an improvement."""
LEAST_PROGRESS_HELD = 5e-4
"""`LEAST_PROGRESS` once λ is held: next to the noise, what is still gained is small."""
LOOSENED_IN_VAIN, PATIENCE = 3, 6
"""Number of rounds without improvement after which λ is no longer lowered, because noise is being fitted, and
that end a refinement."""
TIGHTER = 2.0
"""λ from then on, relative to that of the best round, which lagged behind the λ that it was given; and the
step to the λ that is tried next."""
BEYOND_CHANCE = 2.0
"""Standard errors of the held-out RMS by which a round must be worse to count as clearly so. By as much it
rises and falls from round to round, and of λ that predict equally well the largest fits the least noise."""
LONG = 60
"""Number of iterations from which a refinement lets doubtful patterns go only after a trial. A shorter one
has no time for that, nor to recover from patterns that fit noise."""
FIRST_ROUND = 20.0
"""Time that the first round may take, relative to the longest iteration of the first look. It ends with a fit
of the curves, which may take as long as ten to twenty of these; one that ends before gains nothing."""
BETTER_BESIDE_MOTION = 0.85
"""Largest error of patterns beside motion, relative to that of patterns alone, for which they are preferred:
lamps beside a dot have 0.4, lamps alone 0.9 and more."""
ONE_MORE = 0.9
"""The same of one pattern more: with a lamp's it is 0.4 to 0.88, with others 0.83 and more. One too many may
still be left out later; one too few is never found."""
EARLY_ROUNDS = 2
"""Number of rounds before the first trial, in which both sides are refined for as many: what is superfluous
mostly shows. The held-out error still rises and falls by a fifth."""
SOON_EXPLAINED = 1.5
"""Held-out error of patterns after their first rounds, relative to the noise, up to which they explain the
lines: nothing moves beside them, and what is superfluous shows."""
TRIAL_AFTER, TRIAL_ROUNDS = 8, 5
"""Number of rounds before the second trial if no noise is fitted, and those of the fewer patterns until they
must predict better: first they have to take up the light of the others."""

DARK_ROUNDS, DARK_TRIALS = 3, 2
"""Number of rounds on a dark ground after which the lines show light that is missing, and of times that the
pixels with such light are lit."""
MOST_DOUBT = 0.06
"""Chance error of the held-out RMS up to which a dark ground is tried: 550 samples held out. With 73, on 8
stages, trials cost up to 2.3 dB."""


def settle(given: Given, refinement: Refinement) -> Refinement:
    """Refine until the held-out samples are predicted no better, or the clock ends it: the best state."""
    clock, course = given.clock, _Course(given, refinement)
    # Rounds in which it was compared with others count, but the course begins with one of its own.
    early = max(1, EARLY_ROUNDS - refinement.rounds)
    course.refine_until_idle(clock, LOOSENED_IN_VAIN, early * ROUND)
    course.continue_with(_without_superfluous(given, course.refinement))
    course.try_dark_ground()
    if course.refine_until_idle(clock, LOOSENED_IN_VAIN, TRIAL_AFTER * ROUND):
        course.hold(course.likely_weight)
    course.continue_with(_without_doubtful(given, course.refinement))
    # λ is not held yet if no noise was fitted within `TRIAL_AFTER` rounds.
    if course.refinement.loosens and course.refine_until_idle(clock, LOOSENED_IN_VAIN):
        course.hold(course.likely_weight)
    course.try_dark_ground()
    while course.refine_until_idle(clock, PATIENCE):
        if course.recent >= (1 - LEAST_PROGRESS) * course.before:
            clock.converged()
            break
        # The used samples decide: the held-out ones rise and fall by more than λ changes them.
        step = TIGHTER if course.fits_noise else 1 / TIGHTER
        course.hold(step * course.refinement.parameters.tv_weight)
    return course.at_best()


class _Course:
    """A refinement from round to round, and the state that predicted the held-out samples best.

    ``recent`` is the least error since λ was last held, ``before`` that of the time before; ``fits_noise``
    tells whether the last round met the used samples more closely than their noise allows, if it is known.
    """

    def __init__(self, given: Given, refinement: Refinement) -> None:
        self.refinement, self._given, self._problem = refinement, given, given.problem
        self._noise, self.fits_noise = given.noise, False
        self.recent = self.before = np.inf
        self._best, self._kept, self._idle = np.inf, (refinement, refinement.found), 0
        self._loosened = [(np.inf, refinement.parameters.tv_weight)]
        # An RMS of N values has a relative standard error of 1/√(2N).
        self._doubt = BEYOND_CHANCE / np.sqrt(2 * max(1, given.problem.held_out.sum()))

    def refine_until_idle(self, clock: IterationClock, patience: int, most: int | None = None) -> bool:
        """Refine until this many rounds in turn gain nothing; False if it ends before, after ``most``."""
        steps = clock.run(most or clock.iterations, "refine", video=self.refinement.video, first=FIRST_ROUND)
        for _ in steps:
            weight = self.refinement.parameters.tv_weight
            self.refinement.step()
            if self.refinement.at_round_end:
                predicted = self.refinement.predict()
                error = self._problem.prediction_error(predicted)
                self.fits_noise = self._problem.misfit(predicted) < self._noise
                # Without held-out samples the error is NaN, which never counts as idle.
                least_gain = LEAST_PROGRESS if self.refinement.loosens else LEAST_PROGRESS_HELD
                self._idle = self._idle + 1 if error >= (1 - least_gain) * self.recent else 0
                self.recent = min(self.recent, error)
                # A NaN, without held-out samples, makes the last round the best.
                if not error >= self._best:
                    self._best, self._kept = error, (self.refinement, self.refinement.found)
                if self.refinement.loosens:
                    self._loosened.append((error, weight))
                in_vain = 1 if self.fits_noise and self.refinement.loosens else patience
                if self._idle >= in_vain:
                    return True
        return False

    @property
    def likely_weight(self) -> float:
        """The λ to hold: `TIGHTER` than the best round's, or the largest that predicted no worse."""
        least, best_weight = min(self._loosened)
        as_good = [weight for error, weight in self._loosened if error <= (1 + self._doubt) * least]
        return max(TIGHTER * best_weight, *as_good)

    def hold(self, weight: float) -> None:
        """Continue with this λ, which is no longer lowered."""
        self.refinement.hold(weight)
        self.before, self.recent, self._idle = self.recent, np.inf, 0

    def continue_with(self, refinement: Refinement) -> None:
        """Continue with another refinement, whose state is the best from now on if it predicts as well."""
        if refinement is not self.refinement:
            self.refinement, self.recent, self._idle = refinement, np.inf, 0
            error = self._problem.prediction_error(refinement.predict())
            # A NaN, without held-out samples, makes it the best, too.
            if not error > (1 + self._doubt) * self._best:
                self._best, self._kept = error, (refinement, refinement.found)

    def try_dark_ground(self) -> None:
        """Continue with a dark ground if it predicts well enough."""
        if self._doubt <= MOST_DOUBT:
            enough = (1 + self._doubt) * self._best
            self.continue_with(_on_dark_ground(self._given, self.refinement, enough))

    def at_best(self) -> Refinement:
        """The refinement, returned to its best round."""
        refinement, found = self._kept
        refinement.return_to(found)
        return refinement


def _without_superfluous(given: Given, refinement: Refinement) -> Refinement:
    """The refinement without superfluous patterns, and without doubtful ones if a trial does as well.

    Both sides of the trial are refined for as many rounds. Until the lines are nearly explained only a trial
    decides: beside all that is left of them, the lack of a lamp hardly shows.
    """
    clock, tolerated = given.clock, 1.0
    if given.problem.prediction_error(refinement.predict()) <= SOON_EXPLAINED * given.noise:
        refinement, tolerated = _restricted(refinement, SUPERFLUOUS), SUPERFLUOUS
    fewer = _restricted(refinement)
    if fewer is refinement or clock.iterations < LONG or not clock.affords(LONG * clock.mean_s):
        return fewer
    early_error(given, fewer)
    early_error(given, refinement)
    # Neither has anything left to explain if both meet the noise. A NaN, without held-out samples, stays one.
    most = tolerated * max(refinement.excess(), 0.0)
    return fewer if fewer.excess() <= most else refinement


def _without_doubtful(given: Given, refinement: Refinement) -> Refinement:
    """The refinement without doubtful patterns if the others soon predict the held-out samples better."""
    error, fewer = given.problem.prediction_error(refinement.predict()), _restricted(refinement)
    if fewer is refinement:
        return refinement
    return fewer if _refine(given, fewer, TRIAL_ROUNDS) < error else refinement


def _on_dark_ground(given: Given, refinement: Refinement, enough: float) -> Refinement:
    """The refinement with a dark ground beside the lamps, if its held-out error soon is ``enough``.

    It need not predict better: noise that may become light predicts as well, at the expense of the lamps.
    """
    clock, dark, lit = given.clock, refinement, lit_pixels(refinement.found)
    for _ in range(DARK_TRIALS):
        affordable = not clock.spent(1) and clock.affords(DARK_ROUNDS * ROUND * clock.mean_s)
        if not (affordable and gains_darkness(refinement.unknowns, lit)):
            break
        dark = dark.restricted(dark.found, in_pixels(given, refinement.unknowns, lit))
        dark.loosens = False
        error, held = _refine(given, dark, DARK_ROUNDS), lit
        lit = with_light_missing(given, dark, held)
        if error <= enough:
            if not np.array_equal(lit, held):
                dark = dark.restricted(dark.found, in_pixels(given, refinement.unknowns, lit))
            dark.loosens = refinement.loosens
            return dark
    return refinement


def has_time(clock: IterationClock) -> bool:
    """Whether there is time to try refinements."""
    return clock.iterations >= LONG and clock.affords(LONG * clock.longest_s)


def early_error(given: Given, refinement: Refinement) -> float:
    """The held-out error after the first rounds."""
    return _refine(given, refinement, EARLY_ROUNDS)


def better_than(given: Given, bound: float, rivals: Sequence[Callable[[], Refinement]]) -> Refinement | None:
    """The best of refinements with more and more patterns, if its early error is below a ``bound``.

    The first one that does not predict clearly better than the one before it ends the search: one pattern too
    many takes what moves for a lamp, and predicts a little better for it.
    """
    best, least, before = None, bound, np.inf
    for begin in rivals:
        refinement = begin()
        error = early_error(given, refinement)
        if error > ONE_MORE * before:
            break
        best, least = (refinement, error) if error < least else (best, least)
        before = error
    given.clock.reset()
    return best


def _refine(given: Given, refinement: Refinement, rounds: int) -> float:
    """Refine for some rounds and return the held-out error."""
    for _ in given.clock.run(rounds * ROUND, "refine", video=refinement.video, first=FIRST_ROUND):
        refinement.step()
    return given.problem.prediction_error(refinement.predict())


def _restricted(refinement: Refinement, rise: float = NEEDED) -> Refinement:
    needed = refinement.needed(rise)
    return refinement if needed is refinement.found else refinement.restricted(needed)
