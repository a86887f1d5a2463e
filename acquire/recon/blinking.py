"""Scenes that blink: first cosines of the whole band, then patterns and curves if a few hold the scene.

    cosines ── few patterns? ── yes ─▶ patterns and curves at full resolution (`settling`)
                └────────────── no ──▶ more iterations in the cosines

Nothing here uses the truth: the held-out samples judge what is found.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from acquire.arrays import host
from acquire.recon.admm import AdmmParameters
from acquire.recon.aliasing import unresolved_hz
from acquire.recon.bandwidth import (
    FASTEST_SHARE,
    MARGIN,
    fastest_lamp,
    is_large,
    light_beyond,
)
from acquire.recon.basis import TemporalBasis, cosine_hz, reachable, resized
from acquire.recon.beside_motion import beside_motion, find_lamps
from acquire.recon.cosines import (
    FEW_FRAMES,
    LAMPS_SHARE,
    TENTATIVE_SHARE,
    UNSEARCHED_SHARE,
    begin_in_cosines,
    find_band,
)
from acquire.recon.estimates import InBand, Refined
from acquire.recon.patterns import PARAMETERS, ROUND, Refinement, find_patterns, has_clear_patterns
from acquire.recon.pursuit import pursue, widened
from acquire.recon.settling import (
    BETTER_BESIDE_MOTION,
    SOON_EXPLAINED,
    better_than,
    early_error,
    has_time,
    settle,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from acquire.arrays import Array
    from acquire.recon.estimates import Estimate
    from acquire.recon.given import Given
    from acquire.recon.patterns import Patterns

GLANCE, FIRST_LOOK, LONGER_LOOK = 20, 60, 90
"""Number of iterations in the cosines before they are compared with other priors (and before it is decided
whether few frames explain the lines), and before patterns are looked for; the last if patterns are in
doubt."""
# A longer look at 146 cosines (Fig. 9, one code) left 10 s no time to drop four superfluous patterns, which
# cost 7 dB.
FIRST_LOOK_SHARE, LONGER_SHARE = 0.7, 0.4
"""Upper limit on the first look's share of the budget, and the share after which it is not made longer."""
BEYOND_S = 2e-6
"""Time per line and frame of the search for light beyond the band, which is skipped if less is left."""
WIDER_SHARE = 0.5
"""Share of the budget after which nothing is solved again in a wider band."""
EXPLAINED_BY_NOISE, LEAST_MISSED = 1.15, 0.01
"""Held-out error relative to the noise above which a lamp may hide that the band mimics, and the error itself
if the noise is unknown; the search for it takes a tenth of the time. One of 20 kHz leaves 1.25 and more."""
PLAIN_ITERATIONS = 90
"""Number of iterations for scenes without patterns: more of them fit what voxels cannot represent."""
AT_REST = 0.1
"""Relative prediction error below which they do, and below which cosines start from a still."""
FREER = 0.85
"""Largest error of cosines that are no patterns, relative to that of a still, a volume or fewer cosines, for
which they are preferred: they admit the most noise. With equal errors a volume is 2 to 8 dB better."""
WEIGHT_PER_NOISE = 0.17
"""λ of the first round relative to the lines' noise."""
NOISE_SHARE = 0.7
"""Share of noise in the first look's prediction error, for cameras whose noise is unknown."""


def solve_in_cosines(given: Given) -> Estimate:
    """Solve in cosines, then as patterns and curves if the scene consists of a few."""
    return refine(given, first_look(given))


def first_look(given: Given, still: Array | None = None) -> InBand:
    """A first look in the requested or estimated band, from the coefficients (1, n′, n′) of a still."""
    first = _solve_glance(given, find_band(given), still)
    complete_look(given, first)
    return first


def glance(given: Given, still: Array | None = None) -> InBand:
    """The first iterations of a first look, after which it can be compared with other priors."""
    lamps = _look_for_lamps(given, still)
    return glance_at_band(given, still) if lamps is None else lamps


def glance_at_band(given: Given, still: Array | None = None) -> InBand:
    """A glance at all cosines of the requested or estimated band, whether there are lamps or not."""
    given.clock.reset()  # the limit holds for each stage
    return _solve_glance(given, find_band(given), still)


def _look_for_lamps(given: Given, still: Array | None) -> InBand | None:
    """A first look in the slow cosines and those of lamps; None if there is no lamp, or no time."""
    clock, (spatial_merge, temporal_merge) = given.clock, given.merges
    if clock.spent(UNSEARCHED_SHARE):
        return None

    def iterations(look: InBand, most: int) -> Iterator[int]:
        most = min(most, _at_most(FIRST_LOOK, given) - clock.done)
        return clock.run(most, "first look", FIRST_LOOK_SHARE, look.video)

    def search() -> int:
        if not is_large(given.segment.geometry, spatial_merge):
            return 0
        hurry, affords = partial(clock.spent, TENTATIVE_SHARE), partial(clock.affords, share=LAMPS_SHARE)
        return fastest_lamp(given.segment, given.problem, temporal_merge, hurry, affords)

    return pursue(given, iterations, search, still)


def refine(given: Given, first: InBand) -> Estimate:
    """Refine a first look, and solve again in a wider band if the lines show light beyond this one."""
    segment, problem = given.segment, given.problem
    found = _refine_once(given, first)
    if not given.clock.affords(BEYOND_S * segment.geometry.lines * first.basis.frames):
        return found
    seen = light_beyond(segment, problem, found.predict(), given.options.temporal_merge, first.basis.cosines)
    if seen is not None:
        first, found = _followed(given, first, found, seen, alone=isinstance(found, Refined))
    hidden = _hidden_lamp(given, first, found)
    if hidden is not None:
        _, found = _followed(given, first, found, hidden, alone=True)
    return found


def _followed(
    given: Given, first: InBand, found: Estimate, cosine: int, *, alone: bool
) -> tuple[InBand, Estimate]:
    """A look that holds a cosine beyond the band, ``alone`` or with all that are slower, and its result.

    The ``first`` look and what was ``found`` in it are returned if the other predicts no better.
    """
    clock, options = given.clock, given.options
    lamp_hz = cosine * cosine_hz(given.segment.substep_ns * options.temporal_merge, first.basis.frames)
    faster = f"the lines contain light of about {lamp_hz:.3g} Hz, faster than the band of the video"
    if options.bandwidth is not None or clock.spent(WIDER_SHARE):
        remedy = "a higher bandwidth" if options.bandwidth is not None else "more time or a higher bandwidth"
        clock.shortcuts.append(f"{faster}: {remedy} shows it")
        return first, found
    clock.reset()
    if alone:
        look = widened(given, first, cosine)
    else:
        # The constant cosine is a still, of which the wider band is to find the change.
        still, count = first.solver.theta[:1, ...], round(MARGIN * (cosine + 1))
        look = _solve_glance(given, count, still)
    complete_look(given, look)
    wider = _refine_once(given, look)
    before, after = (given.problem.prediction_error(each.predict()) for each in (found, wider))
    # The noise that many cosines admit hardly shows in the lines, and patterns admit little of it.
    if after < (1 if isinstance(wider, Refined) else FREER) * before:
        return look, wider
    if after < before:
        clock.shortcuts.append(f"{faster}, which a higher bandwidth shows with more noise")
    return first, found


def _hidden_lamp(given: Given, first: InBand, found: Estimate) -> int | None:
    """The cosine of a lamp that the band mimics, if more is left of the lines than their noise."""
    predicted, noise, temporal_merge = found.predict(), given.noise, given.options.temporal_merge
    left = EXPLAINED_BY_NOISE * noise if noise < np.inf else LEAST_MISSED  # NaN if it is unknown
    if given.options.bandwidth is not None or given.clock.spent(WIDER_SHARE):
        return None  # nothing would be solved again: `detect_unresolved_light` reports it at the end
    if not given.problem.prediction_error(predicted) > left:
        return None
    frame_ns = given.segment.substep_ns * temporal_merge
    resolved_hz = first.basis.cosines * cosine_hz(frame_ns, first.basis.frames)
    found_hz = unresolved_hz(given, predicted, found.video(), resolved_hz)
    if found_hz is None:
        return None
    cosine = round(found_hz / cosine_hz(frame_ns, first.basis.frames))
    # Frames may be too slow for it.
    most = reachable(first.basis.frames, temporal_merge, FASTEST_SHARE)
    return cosine if cosine < most else None


def _refine_once(given: Given, first: InBand) -> Estimate:
    """Patterns and curves, or more iterations in the cosines if the scene does not consist of a few."""
    refined = None if given.options.denoiser else _in_patterns(given, first)
    if refined is not None:
        return refined
    for _ in given.clock.run(PLAIN_ITERATIONS - given.clock.done, "solve", video=first.video):
        first.solver.step()
    return first


def _solve_glance(given: Given, count: int, still: Array | None) -> InBand:
    """Solve in ``count`` cosines; few frames get lower penalties if they turn out to explain the lines.

    From zero, the smallest video that explains the lines contains the code, since they carry no information
    about sub-steps without light, and total variation ignores flat light. From a still, the solver finds the
    smallest change that explains them.
    """
    problem, frames = given.problem, given.video_shape[0]
    basis = TemporalBasis(frames, min(frames, count), problem.arrays)
    start = None if still is None else resized(still, basis)
    if given.options.initial is not None:
        # The start is in the solvers' units, as `_Run.in_scene_units` undoes at the end.
        start = basis.analyze(problem.arrays.asarray(given.options.initial / problem.scale))
    estimate = begin_in_cosines(given, basis, start)
    for _ in given.clock.run(_at_most(GLANCE, given), "first look", FIRST_LOOK_SHARE, estimate.video):
        estimate.solver.step()
    few = 1 < frames <= FEW_FRAMES
    if few and problem.prediction_error(estimate.predict()) < AT_REST:
        # Freed of the high penalties, few frames at rest reached 36 dB instead of 21.
        estimate = begin_in_cosines(given, basis, estimate.solver.theta, explained=True)
    return estimate


def complete_look(given: Given, first: InBand) -> None:
    """Continue a first look until it shows whether the scene is a sum of a few patterns."""
    clock = given.clock
    for look in (FIRST_LOOK, LONGER_LOOK):
        rest = _at_most(look, given) - clock.done
        for _ in clock.run(rest, "first look", FIRST_LOOK_SHARE, first.video):
            first.solver.step()
        if has_clear_patterns(first) or clock.spent(LONGER_SHARE):
            break


def _at_most(look: int, given: Given) -> int:
    """Number of iterations of a first look, which leaves some for what follows it."""
    return min(look, -(-4 * given.options.iterations // 5))


def _in_patterns(given: Given, first: InBand) -> Estimate | None:
    """Patterns and curves from a first look; None if the scene does not consist of a few.

    If it is in doubt whether it does, or if they predict worse than the look, something may move beside them.
    """
    segment, problem, clock = given.segment, given.problem, given.clock
    # Curves are fitted at the end of a round: less than a round gains nothing.
    if clock.done >= clock.iterations or not clock.affords(ROUND * clock.longest_s):
        return None
    theta = host(first.solver.theta)
    basis = TemporalBasis(first.basis.frames, first.basis.cosines, problem.arrays)
    parameters = _for_noise(given, first)

    def begin(kind: Callable[..., Refinement], found: Patterns) -> Refinement:
        curves = host(first.basis.spread(problem.arrays.asarray(found.curves)))
        return kind(given, basis, replace(found, curves=curves), parameters)

    alone = find_patterns(theta)
    usual = None if alone is None else partial(begin, Refinement, alone)
    rivals: list[Callable[[], Refinement]] = []
    # Each refinement of a large segment holds a video's worth of memory.
    if not is_large(segment.geometry, given.options.spatial_merge):
        rivals = [partial(begin, beside_motion, each) for each in find_lamps(theta, first.basis)]
    error, noise = problem.prediction_error(first.predict()), given.noise
    explained = max(SOON_EXPLAINED * noise, LEAST_MISSED) if noise < np.inf else LEAST_MISSED  # NaN: unknown
    clock.reset()  # the limit holds for each stage: the first look takes longer where patterns are in doubt
    refinement = None if usual is None else usual()
    if rivals and not has_clear_patterns(first) and has_time(clock):
        refinement = _perhaps_beside_motion(given, refinement, rivals, min(error, explained))
        rivals = []
    if refinement is not None:
        refinement = settle(given, refinement)
        left = problem.prediction_error(refinement.predict())
        if rivals and left > min(error, explained) and has_time(clock):
            other = better_than(given, left, rivals)
            if other is not None:
                other = settle(given, other)
                refinement = other if problem.prediction_error(other.predict()) < left else refinement
    # Without held-out samples both are NaN.
    if refinement is None or error < problem.prediction_error(refinement.predict()):
        return None
    return Refined(refinement, basis.count)


def _perhaps_beside_motion(
    given: Given,
    usual: Refinement | None,
    rivals: Sequence[Callable[[], Refinement]],
    enough: float,
) -> Refinement | None:
    """Patterns beside something that moves if they are better than the ``usual`` ones, else these.

    They are not tried if the usual ones soon predict to ``enough``.
    """
    soon = np.inf if usual is None else early_error(given, usual)
    other = better_than(given, BETTER_BESIDE_MOTION * soon, rivals) if soon > enough else None
    given.clock.reset()
    return usual if other is None else other


def _for_noise(given: Given, first: InBand) -> AdmmParameters:
    """Parameters of the patterns, with a λ that is at first proportional to the noise, if there is some.

    Without held-out samples and known noise the NaN leaves the weight as it is.
    """
    noise = given.noise
    # The noise is infinite for lines without light, and NaN if it is unknown.
    if not noise < np.inf:
        noise = NOISE_SHARE * given.problem.prediction_error(first.predict())
    # The constant comes first: `max` returns it if the other is NaN.
    return replace(PARAMETERS, tv_weight=max(PARAMETERS.tv_weight, WEIGHT_PER_NOISE * noise))
