"""Search for the hypothesis that explains a segment's lines best, and the decision whether any does.

Random codes, which have nothing to do with the lines, show how well the arms predict each other by chance:
two blurred pictures of one scene agree a little. The right code makes them agree several times better, in one
orientation and not in the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from acquire.recon.gaussian import Prior
from acquire.recon.hypotheses import TURNS, Evidence, Hypothesis, LineModel, compare

if TYPE_CHECKING:
    from collections.abc import Callable

DELAYS = (0, 3, -3, 6, -6, 10, -10)
"""Delays in sub-steps to start from, equal for both arms: pictures agree a little when they are this far
off."""
FARTHEST_DELAY = 24
"""Longest delay of an arm that is tried, in sub-steps."""
RANDOM_CODES = 4
"""Number of random codes that show the agreement by chance."""
LEAST_CONTRAST = 10.0
"""Least contrast and gain that are attributed to chance: a few random codes may show too little of it."""
VERIFIED_ALONE, VERIFIED, BEYOND = 4.0, 2.0, 3.0
"""Agreement of the arms at which a code is verified; the second is enough if the code also explains each
arm's own lines better than random codes do, by the third in their standard deviations."""
FOREIGN = 3.0
"""Agreement below which a code is foreign; from here to verification, nothing is claimed."""
OTHER_SUBSTEPS = (1, 2, 3, 4, 5, 6)
USUAL_PRIOR = Prior(0.06, 0.3, 3.0, 1e-2)
"""Prior for the comparison of other S, before the best of them gets a prior that suits it."""
APART, APART_SHARE = 15.0, 0.15
"""Log likelihood, and share of the gain, by which delays that differ between the arms must exceed a common
one: smooth scenes fit slightly better slightly off."""
CLEAR, CLEAR_SHARE, CLEAR_ERRORS = 12.0, 0.11, 0.3
"""Log likelihood, share of the gain from the other arm, and standard errors over the blocks of lines by which
a hypothesis is clearly better than another. For right descriptions, small delays, and turned arms of a scene
that looks the same turned, reach a share of 0.09."""


class Standing(StrEnum):
    """Verdict on the segment's description."""

    RIGHT = "right"
    NAMED = "named"
    UNCLEAR = "cannot tell"
    UNEXPLAINED = "unexplained"


@dataclass(frozen=True, slots=True, eq=False)
class WeighedHypothesis:
    """A hypothesis with its evidence.

    ``contrast``: gain of its orientation over the median of the others; ``agreement``: contrast or gain,
    relative to that of random codes; ``beyond``: own evidence over that of random codes, in their standard
    deviations.
    """

    hypothesis: Hypothesis
    evidence: Evidence
    contrast: float = 0.0
    agreement: float = 0.0
    beyond: float = 0.0

    @property
    def gain(self) -> float:
        """Mutual evidence: what each arm's lines gain from the other's."""
        return float(self.evidence.mutual.sum())

    @property
    def total(self) -> float:
        """Log likelihood: own and mutual evidence of all lines."""
        return float(self.evidence.total.sum())

    @property
    def verified(self) -> bool:
        """Whether the lines follow this code."""
        alone = self.agreement >= VERIFIED_ALONE
        return alone or (self.agreement >= VERIFIED and self.beyond >= BEYOND)


@dataclass(frozen=True, slots=True, eq=False)
class Inquiry:
    """Result of a search: the segment as ``described``, and the best ``candidates``, best first."""

    standing: Standing
    described: WeighedHypothesis
    candidates: tuple[WeighedHypothesis, ...]

    @property
    def best(self) -> WeighedHypothesis:
        return self.candidates[0]

    @property
    def rival(self) -> WeighedHypothesis | None:
        """Another candidate as likely as the best one that changes as little of the description."""
        for each in self.candidates[1:]:
            same_code = each.hypothesis.inverted == self.best.hypothesis.inverted
            simple = each.hypothesis.changes <= self.best.hypothesis.changes
            if same_code and simple and each.verified and not clearly(self.best, each):
                return each
        return None


def inquire(model: LineModel) -> Inquiry:
    """Try the code, its inversion, delays and orientations, and other S if none explains the lines."""
    inquiry = _inquire(model, None)
    if inquiry.standing is not Standing.UNEXPLAINED:
        return inquiry
    others = [Hypothesis(substeps=each) for each in OTHER_SUBSTEPS if each != model.substeps]
    model.prior = USUAL_PRIOR
    substeps = max(others, key=lambda each: _contrast(model, each).contrast).substeps
    other = _inquire(model, substeps)
    # With another S, no other change is accepted: with all delays to choose from, chance finds something.
    explained = other.best.agreement >= VERIFIED_ALONE and other.best.hypothesis.changes == 0
    if explained and other.best.gain > inquiry.best.gain + CLEAR:
        return replace(other, standing=Standing.NAMED, described=inquiry.described)
    return inquiry


def _inquire(model: LineModel, substeps: int | None) -> Inquiry:
    """Search under one S: the code as it is and, unless that is clear, inverted, with suitable priors."""
    described, straight = _search(model, Hypothesis(substeps=substeps))
    best = straight[0]
    opposites = [replace(each.hypothesis, inverted=True) for each in (best, described)]
    inverted = max(
        (WeighedHypothesis(each, model.evidence(each)) for each in opposites), key=lambda each: each.total
    )
    if best.verified and inverted.total < best.total:
        found = (*straight, inverted)
    else:
        _, others = _search(model, Hypothesis(substeps=substeps, inverted=True))
        first, second = (straight, others) if straight[0].total >= others[0].total else (others, straight)
        found = (*first, *second)
    return Inquiry(_standing(described, found), described, found)


def _standing(described: WeighedHypothesis, found: tuple[WeighedHypothesis, ...]) -> Standing:
    best = found[0]
    if not best.verified:
        agreement = max(best.agreement, described.agreement)
        foreign = agreement < FOREIGN and max(best.beyond, described.beyond) < VERIFIED_ALONE
        return Standing.UNEXPLAINED if foreign else Standing.UNCLEAR
    if best.hypothesis == described.hypothesis:
        return Standing.RIGHT
    if clearly(best, described):
        return Standing.NAMED
    return Standing.RIGHT if described.verified and described.gain >= best.gain else Standing.UNCLEAR


def clearly(one: WeighedHypothesis, other: WeighedHypothesis) -> bool:
    """Whether the evidence for ``one`` is clearly better."""
    more, errors = advantage(one, other)
    return more > max(CLEAR, CLEAR_SHARE * one.gain) and errors > CLEAR_ERRORS and one.total > other.total


def advantage(one: WeighedHypothesis, other: WeighedHypothesis) -> tuple[float, float]:
    """Log likelihood by which ``one`` is likelier than ``other``, and the same in standard errors.

    The arms' own evidence counts only if the codes differ in more than their delay: to an arm alone, a delay
    is a displaced scene, and its preference for one of them is chance.
    """
    a, b = one.hypothesis, other.hypothesis
    if (a.inverted, a.substeps) == (b.inverted, b.substeps):
        return compare(one.evidence.mutual, other.evidence.mutual)
    return compare(one.evidence.total, other.evidence.total)


def _search(model: LineModel, plain: Hypothesis) -> tuple[WeighedHypothesis, tuple[WeighedHypothesis, ...]]:
    """The plain hypothesis, and the best orientations with their delays, best first.

    Among candidates that are not clearly different, the one that changes least of the description is first.
    """
    model.fit_prior(plain)
    # This comes after the prior: agreement by chance depends on it.
    chance = ByChance.of(model, plain)
    described = chance.judged(_contrast(model, plain))
    found = []
    # Two are tried: at delays three apart, or turned scenes that look alike, the right orientation may be
    # second.
    for start in _first_look(model, plain)[:2]:
        climbed = _climb(model, start.hypothesis)
        found.append(described if climbed == plain else chance.judged(_contrast(model, climbed)))
    best = max(found, key=lambda each: each.gain)
    equal = [each for each in found if each is best or not clearly(best, each)]
    first = min(equal, key=lambda each: (each.hypothesis.changes, -each.gain))
    others = sorted((each for each in found if each is not first), key=lambda each: -each.gain)
    return described, (first, *others)


@dataclass(frozen=True, slots=True)
class ByChance:
    """What random codes reach: contrast, gain, own evidence and its standard deviation."""

    contrast: float
    gain: float
    own: float
    spread: float

    @classmethod
    def of(cls, model: LineModel, plain: Hypothesis) -> ByChance:
        """Try `RANDOM_CODES` random codes in place of the code; all else is as in ``plain``."""
        found = [
            _contrast(model, replace(plain, random_code=number)) for number in range(1, RANDOM_CODES + 1)
        ]
        own = np.array([each.evidence.own.sum() for each in found])
        # This is the most that chance reached, not its mean: a code has to be clear of all of them.
        contrast = max(each.contrast for each in found)
        gain = max(each.gain for each in found)
        floor = LEAST_CONTRAST
        return cls(max(contrast, floor), max(gain, floor), float(own.mean()), float(own.std(ddof=1)))

    def judged(self, candidate: WeighedHypothesis) -> WeighedHypothesis:
        """The candidate with its agreement, and its own evidence, relative to chance."""
        beyond = (float(candidate.evidence.own.sum()) - self.own) / max(self.spread, 1e-9)
        # A scene that looks the same turned has no contrast, and yet the arms agree on it.
        agreement = max(candidate.contrast / self.contrast, candidate.gain / self.gain)
        return replace(candidate, agreement=agreement, beyond=beyond)


def _first_look(model: LineModel, plain: Hypothesis) -> list[WeighedHypothesis]:
    """The best delay of each orientation, best first."""
    across = [turn for turn in TURNS if turn.across]
    best: dict[object, WeighedHypothesis] = {}
    for delay in DELAYS:
        tried = [replace(plain, late=(delay, delay), turn=turn) for turn in across]
        found = _with_contrast([WeighedHypothesis(each, model.evidence(each)) for each in tried])
        for each in found:
            turn = each.hypothesis.turn
            if turn not in best or each.gain > best[turn].gain:
                best[turn] = each
    return sorted(best.values(), key=lambda each: -each.gain)


def _contrast(model: LineModel, hypothesis: Hypothesis) -> WeighedHypothesis:
    """The hypothesis with its contrast to other orientations; a random code in its best orientation."""
    turns = [hypothesis.turn, *(turn for turn in TURNS if turn.across and turn != hypothesis.turn)]
    tried = [replace(hypothesis, turn=turn) for turn in turns]
    found = _with_contrast([WeighedHypothesis(each, model.evidence(each)) for each in tried])
    return max(found, key=lambda each: each.gain) if hypothesis.random_code else found[0]


def _with_contrast(found: list[WeighedHypothesis]) -> list[WeighedHypothesis]:
    """Each candidate with its gain over the median of the others."""
    gains = np.array([each.gain for each in found])
    return [
        replace(each, contrast=each.gain - float(np.median(np.delete(gains, i))))
        for i, each in enumerate(found)
    ]


def _climb(model: LineModel, start: Hypothesis) -> Hypothesis:
    """The delays near ``start`` with which the arms predict each other best: common, then one per arm."""

    def gain(late: tuple[int, int]) -> float:
        if late not in known:
            known[late] = float(model.evidence(replace(start, late=late)).mutual.sum())
        return known[late]

    # Both climbs try some of the same delays.
    known: dict[tuple[int, int], float] = {}
    common = _uphill(gain, start.late, ((3, 3), (1, 1)))
    apart = _uphill(gain, common, ((3, 0), (0, 3), (1, 0), (0, 1)))
    limit = gain(common) + max(APART, APART_SHARE * gain(apart))
    return replace(start, late=apart if gain(apart) > limit else common)


def _uphill(
    gain: Callable[[tuple[int, int]], float], start: tuple[int, int], steps: tuple[tuple[int, int], ...]
) -> tuple[int, int]:
    """Climb from ``start`` by any of the ``steps``, in either direction, while the gain increases."""
    best, improved = start, True
    while improved:
        near = [(best[0] + sign * a, best[1] + sign * b) for a, b in steps for sign in (1, -1)]
        near = [each for each in near if max(map(abs, each)) <= FARTHEST_DELAY]
        better = max(near, key=gain, default=best)
        improved = gain(better) > gain(best)
        best = better if improved else best
    return best
