"""A segment's description held against its lines, in words: what is wrong, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.cores import limit_threads
from acquire.recon.balance import balance_of
from acquire.recon.hypotheses import Hypothesis, Turn, Witness, compare
from acquire.recon.sanity import Suspicion, black_level_off, suspicions, unusable
from acquire.recon.search import Candidate, Inquiry, Standing, inquire

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.lines import Segment

FEWEST_LINES, FEWEST_STAGES = 24, 4
"""Of fewer, nothing is claimed."""
TURNED = {
    Turn(pixels=True): "arm B is mirrored: its pixels are in the other order, or arm A's rows are",
    Turn(rows=True): "arm A is mirrored: its pixels are in the other order, or arm B's rows are",
    Turn(rows=True, pixels=True): "the arms are swapped, or one of them is turned by 180 degrees",
}
UNEXPLAINED = "the code does not explain the lines: another seed, another run's code, or far off"
UNEXPLAINED_HINT = (
    "the code's seed, start and kind; `acquire diagnose` of another stretch; S and M of the rig"
)


@dataclass(frozen=True, slots=True)
class Row:
    """One hypothesis of the table: how much likelier than what is said, in standard errors too, and how many
    times better the arms agree than under codes that have nothing to do with them."""

    name: str
    likelier: float
    errors: float
    agreement: float


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """``standing`` of the description; ``sentence`` for people; ``hypothesis`` where one is named or right.

    ``alternative`` is another that cannot be told from it.
    """

    standing: Standing
    sentence: str
    rows: tuple[Row, ...] = ()
    suspicions: tuple[Suspicion, ...] = ()
    hypothesis: Hypothesis | None = None
    alternative: Hypothesis | None = None

    @property
    def wrong(self) -> bool:
        """Something is wrong for certain."""
        return self.standing in (Standing.NAMED, Standing.UNEXPLAINED) or bool(self.suspicions)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What a user should know."""
        named = (self.sentence,) if self.standing in (Standing.NAMED, Standing.UNEXPLAINED) else ()
        return (*named, *(each.words for each in self.suspicions))

    def to_dict(self) -> dict[str, Any]:
        return {
            "standing": str(self.standing),
            "sentence": self.sentence,
            "suspicions": [{"kind": each.kind, "words": each.words} for each in self.suspicions],
            "hypotheses": [
                {
                    "name": row.name,
                    "log_likelihood": round(row.likelier, 1),
                    "standard_errors": round(row.errors, 2),
                    "agreement": round(row.agreement, 2),
                }
                for row in self.rows
            ],
        }


def diagnose(segment: Segment, bits: Callable[[int, int], NDArray[np.uint8]] | None = None) -> Diagnosis:
    """What of code, delays, orientation, S, levels and gains the lines bear out.

    ``bits(start, length)`` gives the code from the segment's first bit on, also beyond the segment.
    """
    nothing = unusable(segment)
    if nothing:
        return Diagnosis(Standing.UNCLEAR, "the lines cannot be held against their code", (), tuple(nothing))
    if segment.geometry.lines < FEWEST_LINES or segment.geometry.stages < FEWEST_STAGES:
        few = f"{segment.geometry.lines} lines of {segment.geometry.stages} pixels are too few to tell"
        return Diagnosis(Standing.UNCLEAR, few)
    # matrices are small: more threads would wait for each other
    with limit_threads(1):
        found = _asked(Witness(segment, bits))
    return replace(found, suspicions=(*found.suspicions, *_unequal(segment), *black_level_off(segment)))


def _unequal(segment: Segment) -> list[Suspicion]:
    """Arms that get different shares of the light, whatever the code."""
    balance = balance_of([segment])
    if balance is None or not balance.clear:
        return []
    return [Suspicion("gain_ratio", f"{balance.words}: gains or beam splitter")]


def _asked(witness: Witness) -> Diagnosis:
    inquiry = inquire(witness)
    hypothesis = inquiry.best.hypothesis
    rows = tuple(_rows(witness, inquiry))
    sentence = sentence_of(inquiry)
    if inquiry.standing is Standing.UNEXPLAINED:
        return Diagnosis(inquiry.standing, sentence, rows)
    if inquiry.standing is Standing.UNCLEAR:
        return Diagnosis(inquiry.standing, sentence, rows, (), inquiry.said.hypothesis, hypothesis)
    witness.settle(hypothesis)
    found = tuple(suspicions(witness, hypothesis))
    rival = inquiry.rival if inquiry.standing is Standing.NAMED else None
    return Diagnosis(
        inquiry.standing, sentence, rows, found, hypothesis, None if rival is None else rival.hypothesis
    )


def sentence_of(inquiry: Inquiry) -> str:
    """The standing in words."""
    if inquiry.standing is Standing.UNEXPLAINED:
        return UNEXPLAINED
    if inquiry.standing is Standing.RIGHT:
        return "the lines are what their description says: code, its place and the arms' orientation"
    if inquiry.standing is Standing.UNCLEAR and inquiry.best.hypothesis == inquiry.said.hypothesis:
        return "cannot tell: the lines follow a code, but the scene does not show the arms' place"
    words = name_of(inquiry.best.hypothesis)
    if inquiry.standing is Standing.NAMED:
        rival = inquiry.rival
        return words if rival is None else f"{words}; or, as likely, {name_of(rival.hypothesis)}"
    return f"cannot tell whether all is as said, or {words}"


def name_of(hypothesis: Hypothesis) -> str:
    """A hypothesis in words."""
    parts = []
    if hypothesis.substeps is not None:
        parts.append(f"the lines have {hypothesis.substeps} sub-steps (S)")
    if hypothesis.inverted:
        parts.append("the code is inverted: light is on where it says off")
    parts += _delay(*hypothesis.late)
    if hypothesis.turn in TURNED:
        parts.append(TURNED[hypothesis.turn])
    return "; ".join(parts) or "as said"


def _delay(a: int, b: int) -> list[str]:
    if a == b == 0:
        return []
    if a == b:
        return [f"the lines are {_late(a)} against the code"]
    each = [f"arm {arm}'s are {_late(by)}" for arm, by in (("A", a), ("B", b)) if by]
    return [
        f"of the lines, {' and '.join(each)} against the code, or its image lies off by as many fine pixels"
    ]


def _late(by: int) -> str:
    return f"{abs(by)} sub-step{'s' if abs(by) > 1 else ''} {'late' if by > 0 else 'early'}"


def _rows(witness: Witness, inquiry: Inquiry) -> list[Row]:
    """What was tried and is worth telling: each fault on its own, and what was found."""
    said = inquiry.said
    S, plain = witness.substeps, said.hypothesis
    tried = [replace(plain, late=(by, by)) for by in (1, -1, S, -S)]
    tried += [replace(plain, turn=turn) for turn in TURNED]
    tried.append(replace(plain, inverted=True))
    found = {candidate.hypothesis: candidate for candidate in inquiry.candidates}
    witness.settle(plain)
    for each in tried:
        found.setdefault(each, Candidate(each, witness.evidence(each)))
    found[plain] = said
    rows = [_row(candidate, said) for candidate in found.values()]
    return sorted(rows, key=lambda row: -row.likelier)


def _row(candidate: Candidate, said: Candidate) -> Row:
    one, other = candidate.evidence, said.evidence
    same = candidate.hypothesis.inverted == said.hypothesis.inverted
    same = same and candidate.hypothesis.substeps == said.hypothesis.substeps
    more, errors = (
        (0.0, 0.0)
        if candidate is said
        else compare(one.mutual, other.mutual)
        if same
        else compare(one.total, other.total)
    )
    return Row(name_of(candidate.hypothesis), more, errors, candidate.agreement)


def put_right(segment: Segment, turn: Turn) -> Segment:
    """The segment with its arms turned back, so that the forward model holds for it."""
    if turn.rows and turn.pixels:
        return segment.swapped()
    if not (turn.rows or turn.pixels):
        return segment
    return segment.mirrored(0 if turn.rows else 1)
