"""What moves as one is followed by a volume, if that predicts the held-out blocks better than one at rest.

Its path is read off a video: that of a first volume, of one of changing brightness, of a cycle, or of the
many cosines at a glance.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from acquire.arrays import host
from acquire.recon.bends import FAINT, drifting, find_bends
from acquire.recon.candidates import COSINES, GROUND, PACE_STEP
from acquire.recon.drift import fastest
from acquire.recon.rotation import turning
from acquire.recon.workbench import FIRST_ITERATIONS, HOPELESS, NEXT_ITERATIONS, SEARCH_SHARE

if TYPE_CHECKING:
    from acquire.recon.candidates import Candidate
    from acquire.recon.estimates import InBand
    from acquire.recon.workbench import Trial

OUTDONE = 0.6
"""Largest error of a prior, relative to another, with which it goes first: of the cosines at a glance, which
are then continued before the others are searched, and of a rival of what follows, which then goes no
further. The glance of lamps has 0.25 to 0.55."""
FOLLOWED = 0.95
"""Largest error of a volume that follows what moves, relative to one at rest after as many iterations, for
which it goes on: text, bodies that cross the field and wheels have 0.5 to 0.94, what swings or is moved by
hand 0.4 to 0.88, and a splash, whose picture would be 1.0 to 1.7 dB worse, 0.97 to 1.1."""
ROUGH = 1.2
"""Largest error of a first trial on a path that bends, relative to one at rest, for which a better path is
looked for: pendulums have up to 1.05."""
INSTANTS = 96
"""Number of instants of the cosines' video in which a path that bends is looked for."""


def following(volume: Trial, rival: float) -> Trial | None:
    """The volume, following what drifts or turns in it, if that predicts better; None if it does not."""
    found = None
    for path in (drifting, turning):
        candidate = path(volume)
        followed = None if candidate is None else _on_found_path(volume, candidate, rival)
        if followed is not None:
            volume = found = followed
    return found


def following_faint(volume: Trial, cosines: InBand, rival: float) -> Trial | None:
    """The volume, following what it shows only faintly on a path that bends; None if that does not help.

    Small things that move fast are seen in the video of the cosines, if these predict far better.
    """
    candidate = drifting(volume, FAINT)
    if candidate is not None and len(candidate.drift) > 2:
        return _on_found_path(volume, candidate, rival)
    if volume.bench.error(cosines.predict()) > OUTDONE * volume.error:
        return None
    matrix, theta = host(cosines.basis.matrix()), host(cosines.solver.theta)
    moments = ((np.arange(INSTANTS) + 0.5) / INSTANTS * matrix.shape[1]).astype(int)
    path = find_bends(np.tensordot(matrix[:, moments].T, theta, axes=1), None, adds_up=FAINT)
    return None if path is None else _on_found_path(volume, replace(volume.candidate, drift=path), rival)


def _on_found_path(volume: Trial, candidate: Candidate, rival: float) -> Trial | None:
    """A volume that follows a candidate's path; None if it does not predict better than one at rest."""
    if volume.bench.clock.spent(SEARCH_SHARE):
        return None
    if len(candidate.drift) > 2:
        best, at_rest = _on_bends(volume, candidate, rival)
    else:
        best, at_rest = _on_path(volume, candidate, rival), volume
    if best.error > FOLLOWED * at_rest.error:
        return None
    return best if rival < OUTDONE * best.error else _along(best)


def _on_bends(volume: Trial, candidate: Candidate, rival: float) -> tuple[Trial, Trial]:
    """The best trial on a path that bends, and one at rest in as many cosines after as many iterations.

    The first path is a rough one, on which little adds up, and what moves on it is often small. Only on a
    better path and in enough cosines does it show whether that moves. At rest, these help, too.
    """
    bench = volume.bench
    grounds = (replace(candidate, ground=ground) for ground in (0.0, GROUND))
    found = min((bench.probe(each, min(volume.error, rival)) for each in grounds), key=_error)
    if found.error > ROUGH * volume.error or bench.clock.spent(SEARCH_SHARE):
        return volume, volume
    still = replace(volume.candidate, ground=found.candidate.ground)
    at_rest = volume if still == volume.candidate else bench.attempt(still, FIRST_ITERATIONS)
    again = drifting(found) or found.candidate
    count = _enough_cosines(found, again)
    found = bench.attempt(replace(again, coefficients=count), NEXT_ITERATIONS, found)
    at_rest = bench.attempt(replace(still, coefficients=count), NEXT_ITERATIONS, at_rest)
    # More cosines show more of the path.
    finer = drifting(found)
    if finer is not None and len(finer.drift) > len(found.candidate.drift):
        found = better(found, finer)
        if found.error > OUTDONE * at_rest.error:  # else more iterations at rest would decide nothing
            at_rest = better(at_rest, at_rest.candidate)
    return found, min(at_rest, volume, key=_error)


def moving_in(bright: Trial) -> Trial:
    """A volume of changing brightness, or one that also follows what moves as one, if it predicts better."""
    bench, best = bright.bench, bright
    for path in (drifting, turning):
        candidate = path(bright)
        if candidate is None or bench.clock.spent(SEARCH_SHARE):
            continue
        bench.use_brightness(bright.brightness)
        grounds = (replace(candidate, ground=ground) for ground in (0.0, GROUND))
        found = min((bench.probe(each, bright.error) for each in grounds), key=_error)
        if found.error < HOPELESS * bright.error:
            best = min(best, bench.alternate(found), key=_error)
    bench.use_brightness(best.brightness)
    return best


def or_turning(cycle: Trial, rival: float) -> Trial:
    """The cycle, or the same that follows what turns in it, if that predicts better."""
    candidate = turning(cycle)
    if candidate is None or cycle.bench.clock.spent(SEARCH_SHARE):
        return cycle
    found = _on_path(cycle, candidate, rival)
    # A cycle at rest has had many rounds to fit its speed, and needs no head start.
    return found if found is cycle else min(cycle, found.bench.follow_path(found), key=_error)


def _on_path(at_rest: Trial, candidate: Candidate, rival: float) -> Trial:
    """The better one of a trial and of a candidate with and without a ground.

    Each starts from zero: a step from one to the other hardly arrives there.
    """
    found = at_rest
    for ground in (0.0, GROUND):
        probed = at_rest.bench.probe(replace(candidate, ground=ground), min(found.error, rival))
        found = min(found, probed, key=_error)
    return found


def _along(found: Trial) -> Trial:
    """A volume that follows what moves, on a better path and in enough cosines.

    Weights are searched for later: those that suit a wrong path are wrong.
    """
    found = found.bench.follow_path(found)
    count = _enough_cosines(found, found.candidate)
    if count > found.candidate.coefficients:
        found = better(found, replace(found.candidate, coefficients=count))
    # What is followed is often nearly at rest. A search arrives there after both weights, for which a budget
    # may leave no time; without one, it does so by itself.
    calmer = found.candidate.with_pace(PACE_STEP) if found.bench.clock.has_budget else None
    return found if calmer is None else better(found, calmer)


def _enough_cosines(trial: Trial, candidate: Candidate) -> int:
    """How many cosines a trial takes on a candidate's path.

    A picture of n′ pixels that moves by v sides turns its finest wave v·n′/2 times, which takes v·n′ cosines.
    With fewer, a search finds calmer volumes better, and never arrives there.
    """
    # The rim of a picture whose sides are 1 moves by π turns.
    turns = [np.pi * abs(turn) for turn in candidate.rotation[:1]]
    finest = max(turns or [fastest(candidate.drift)]) * trial.admm.theta.shape[1]
    return min(next((each for each in COSINES if each >= finest), COSINES[-1]), trial.bench.frames)


def better(found: Trial, candidate: Candidate) -> Trial:
    """The better one of a trial and of a candidate that continues it, if there is time for it."""
    if found.bench.clock.spent(SEARCH_SHARE):
        return found
    return min(found, found.bench.attempt(candidate, NEXT_ITERATIONS, found), key=_error)


def _error(trial: Trial) -> float:
    return trial.error
