"""The hypothesis that explains a segment's lines best, and whether any does.

How well arms foretell each other under a code that has nothing to do with the lines tells what agreement
comes of itself: two blurred pictures of one scene agree a little. A code that deserves to be believed makes
them agree several times better, in one orientation and not in the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from acquire.recon.gaussian import Prior
from acquire.recon.hypotheses import TURNS, Evidence, Hypothesis, Witness, compare

if TYPE_CHECKING:
    from collections.abc import Callable

DELAYS = (0, 3, -3, 6, -6, 10, -10)
"""Sub-steps that are tried at first, both arms alike: pictures agree a little when they are this far off."""
FARTHEST = 24
STRANGERS = 4
"""Random codes that say what agreement comes of itself."""
LEAST_CONTRAST = 10.0
VERIFIED_ALONE, VERIFIED, BEYOND = 4.0, 2.0, 3.0
"""Agreement of the arms at which a code is believed; less is enough where it also explains each arm's lines
better than wrong codes do, by so many of their standard deviations."""
DOUBTFUL = 3.0
"""Agreement below which a code is foreign; between this and belief, nothing is claimed."""
OTHER_SUBSTEPS = (1, 2, 3, 4, 5, 6)
USUAL = Prior(0.06, 0.3, 3.0, 1e-2)
"""Under which they are looked through, before the best has a prior that suits it."""
APART, APART_SHARE = 15.0, 0.15
"""Log likelihood, and share of the gain, by which delays that differ between the arms have to be better than
a common one: smooth scenes fit a little better a little off."""
CLEAR, CLEAR_SHARE, CLEAR_ERRORS = 12.0, 0.11, 0.3
"""Of two hypotheses the better is clearly so beyond this log likelihood, beyond this share of what it gains
by the other arm's word, and beyond so many standard errors over the blocks of lines. Small delays, and arms
turned before a scene that looks the same turned, come to 0.09 where all is right."""


class Standing(StrEnum):
    """What the evidence says of the segment as it is described."""

    RIGHT = "right"
    NAMED = "named"
    UNCLEAR = "cannot tell"
    UNEXPLAINED = "unexplained"


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A hypothesis with its evidence.

    ``contrast``: gain of its orientation over the others'; ``agreement``: that, or the gain, over what wrong
    codes reach;
    ``beyond``: own evidence over that of wrong codes, in their standard deviations.
    """

    hypothesis: Hypothesis
    evidence: Evidence
    contrast: float = 0.0
    agreement: float = 0.0
    beyond: float = 0.0

    @property
    def gain(self) -> float:
        return float(self.evidence.mutual.sum())

    @property
    def total(self) -> float:
        return float(self.evidence.total.sum())

    @property
    def verified(self) -> bool:
        """The lines follow this code."""
        alone = self.agreement >= VERIFIED_ALONE
        return alone or (self.agreement >= VERIFIED and self.beyond >= BEYOND)


@dataclass(frozen=True, slots=True, eq=False)
class Inquiry:
    """What was found: what is ``said`` of the segment, and the best ``candidates``, best first."""

    standing: Standing
    said: Candidate
    candidates: tuple[Candidate, ...]

    @property
    def best(self) -> Candidate:
        return self.candidates[0]

    @property
    def rival(self) -> Candidate | None:
        """Another that is as likely as the best and says as little."""
        for each in self.candidates[1:]:
            alike = each.hypothesis.inverted == self.best.hypothesis.inverted
            simple = each.hypothesis.changes <= self.best.hypothesis.changes
            if alike and simple and each.verified and not clearly(self.best, each):
                return each
        return None


def inquire(witness: Witness) -> Inquiry:
    """Try code, inversion, delays and orientations, and where none explains the lines, other S."""
    inquiry = _inquire(witness, None)
    if inquiry.standing is not Standing.UNEXPLAINED:
        return inquiry
    others = [Hypothesis(substeps=each) for each in OTHER_SUBSTEPS if each != witness.substeps]
    witness.prior = USUAL
    substeps = max(others, key=lambda each: _contrast(witness, each).contrast).substeps
    other = _inquire(witness, substeps)
    # nothing else may be wrong with it: with all delays to choose from, chance finds something
    explained = other.best.agreement >= VERIFIED_ALONE and other.best.hypothesis.changes == 0
    if explained and other.best.gain > inquiry.best.gain + CLEAR:
        return replace(other, standing=Standing.NAMED, said=inquiry.said)
    return inquiry


def _inquire(witness: Witness, substeps: int | None) -> Inquiry:
    """Of one S: the code as it is and, where that might be it, inverted, under the prior that suits it."""
    said, straight = _search(witness, Hypothesis(substeps=substeps))
    best = straight[0]
    opposites = [replace(each.hypothesis, inverted=True) for each in (best, said)]
    inverted = max(
        (Candidate(each, witness.evidence(each)) for each in opposites), key=lambda each: each.total
    )
    if best.verified and inverted.total < best.total:
        return Inquiry(_standing(said, straight), said, (*straight, inverted))
    _, others = _search(witness, Hypothesis(substeps=substeps, inverted=True))
    first, second = (straight, others) if straight[0].total >= others[0].total else (others, straight)
    return Inquiry(_standing(said, (*first, *second)), said, (*first, *second))


def _standing(said: Candidate, found: tuple[Candidate, ...]) -> Standing:
    best = found[0]
    if not best.verified:
        foreign = (
            max(best.agreement, said.agreement) < DOUBTFUL and max(best.beyond, said.beyond) < VERIFIED_ALONE
        )
        return Standing.UNEXPLAINED if foreign else Standing.UNCLEAR
    if best.hypothesis == said.hypothesis:
        return Standing.RIGHT
    if clearly(best, said):
        return Standing.NAMED
    return Standing.RIGHT if said.verified and said.gain >= best.gain else Standing.UNCLEAR


def clearly(one: Candidate, other: Candidate) -> bool:
    """Whether the evidence for ``one`` is clearly better."""
    more, errors = _better(one, other)
    return more > max(CLEAR, CLEAR_SHARE * one.gain) and errors > CLEAR_ERRORS and one.total > other.total


def _better(one: Candidate, other: Candidate) -> tuple[float, float]:
    """By how much, and in standard errors. What the arms say on their own counts where codes differ in more
    than their place: a delay is to an arm alone a scene that lies off, and what it says of that is chance."""
    a, b = one.hypothesis, other.hypothesis
    if (a.inverted, a.substeps) == (b.inverted, b.substeps):
        return compare(one.evidence.mutual, other.evidence.mutual)
    return compare(one.evidence.total, other.evidence.total)


def _search(witness: Witness, plain: Hypothesis) -> tuple[Candidate, tuple[Candidate, ...]]:
    """The plain hypothesis, and the best orientations with their delays, best first."""
    witness.settle(plain)
    strangers = Strangers.of(witness, plain)
    said = strangers.judged(_contrast(witness, plain))
    found = []
    for start in _first_look(witness, plain)[:2]:
        climbed = _climb(witness, start.hypothesis)
        found.append(said if climbed == plain else strangers.judged(_contrast(witness, climbed)))
    return said, _simplest_first(found)


def _simplest_first(found: list[Candidate]) -> tuple[Candidate, ...]:
    """Best first; of those that cannot be told apart, the one that says least against the description."""
    best = max(found, key=lambda each: each.gain)
    equal = [each for each in found if each is best or not clearly(best, each)]
    first = min(equal, key=lambda each: (each.hypothesis.changes, -each.gain))
    return first, *sorted((each for each in found if each is not first), key=lambda each: -each.gain)


@dataclass(frozen=True, slots=True)
class Strangers:
    """What codes reach that have nothing to do with the lines: contrast, gain, own evidence, its spread."""

    contrast: float
    gain: float
    own: float
    spread: float

    @classmethod
    def of(cls, witness: Witness, plain: Hypothesis) -> Strangers:
        found = [_contrast(witness, replace(plain, strange=number)) for number in range(1, STRANGERS + 1)]
        own = np.array([each.evidence.own.sum() for each in found])
        contrast = max(each.contrast for each in found)
        gain = max(each.gain for each in found)
        floor = LEAST_CONTRAST
        return cls(max(contrast, floor), max(gain, floor), float(own.mean()), float(own.std(ddof=1)))

    def judged(self, candidate: Candidate) -> Candidate:
        beyond = (float(candidate.evidence.own.sum()) - self.own) / max(self.spread, 1e-9)
        # a scene that looks the same turned has no contrast, and yet the arms agree on it
        agreement = max(candidate.contrast / self.contrast, candidate.gain / self.gain)
        return replace(candidate, agreement=agreement, beyond=beyond)


def _first_look(witness: Witness, plain: Hypothesis) -> list[Candidate]:
    """The best delay of each orientation, best first."""
    across = [turn for turn in TURNS if turn.across]
    best: dict[object, Candidate] = {}
    for delay in DELAYS:
        tried = [replace(plain, late=(delay, delay), turn=turn) for turn in across]
        found = _with_contrast([Candidate(each, witness.evidence(each)) for each in tried])
        for each in found:
            turn = each.hypothesis.turn
            if turn not in best or each.gain > best[turn].gain:
                best[turn] = each
    return sorted(best.values(), key=lambda each: -each.gain)


def _contrast(witness: Witness, hypothesis: Hypothesis) -> Candidate:
    turns = [hypothesis.turn, *(turn for turn in TURNS if turn.across and turn != hypothesis.turn)]
    tried = [replace(hypothesis, turn=turn) for turn in turns]
    found = _with_contrast([Candidate(each, witness.evidence(each)) for each in tried])
    return max(found, key=lambda each: each.gain) if hypothesis.strange else found[0]


def _with_contrast(found: list[Candidate]) -> list[Candidate]:
    """Each against the median of the others."""
    gains = np.array([each.gain for each in found])
    return [
        replace(each, contrast=each.gain - float(np.median(np.delete(gains, i))))
        for i, each in enumerate(found)
    ]


def _climb(witness: Witness, start: Hypothesis) -> Hypothesis:
    """The delays about ``start`` for which the arms foretell each other best: common, then each arm's."""

    def gain(late: tuple[int, int]) -> float:
        if late not in known:
            known[late] = float(witness.evidence(replace(start, late=late)).mutual.sum())
        return known[late]

    known: dict[tuple[int, int], float] = {}
    common = _uphill(gain, start.late, ((3, 3), (1, 1)))
    apart = _uphill(gain, common, ((3, 0), (0, 3), (1, 0), (0, 1)))
    limit = gain(common) + max(APART, APART_SHARE * gain(apart))
    return replace(start, late=apart if gain(apart) > limit else common)


def _uphill(
    gain: Callable[[tuple[int, int]], float], start: tuple[int, int], steps: tuple[tuple[int, int], ...]
) -> tuple[int, int]:
    best, moved = start, True
    while moved:
        near = [(best[0] + sign * a, best[1] + sign * b) for a, b in steps for sign in (1, -1)]
        near = [each for each in near if max(map(abs, each)) <= FARTHEST]
        better = max(near, key=gain, default=best)
        moved = gain(better) > gain(best)
        best = better if moved else best
    return best
